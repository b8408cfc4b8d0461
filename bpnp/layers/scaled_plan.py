"""Transport plan as a kernel between two scalings, and its products with vectors."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

SHORT_SUM = 2048  # terms that are summed in float32
CACHE = 2**23  # bytes of plans processed together on a CPU, so that later products read them from its cache
CACHED = 128  # rows squared at a time, so that they stay in the cache of a core
LOST = 100.0  # a difference of this many units of rounding has no correct digits


@dataclass(frozen=True)
class Plan:
    """Transport plan P = diag(alpha) K diag(beta), (b, m, n)."""

    kernel: Float[Tensor, "b m n"]  # K
    alpha: Float[Tensor, "b m"]  # row scalings
    beta: Float[Tensor, "b n"]  # column scalings

    @classmethod
    def of(cls, kernel: Float[Tensor, "b m n"]) -> "Plan":
        """Return the plan P = K."""
        b, m, n = kernel.shape
        return cls(kernel, kernel.new_ones(b, m), kernel.new_ones(b, n))

    def times(self, b: Float[Tensor, "b n"]) -> Float[Tensor, "b m"]:
        """Return P b."""
        return self.alpha * times(self.kernel, self.beta * b)

    def transpose_times(self, a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
        """Return P^T a."""
        return self.beta * transpose_times(self.kernel, self.alpha * a)

    def row_sums(self) -> Float[Tensor, "b m"]:
        """Return P 1."""
        return self.alpha * times(self.kernel, self.beta)

    def col_sums(self) -> Float[Tensor, "b n"]:
        """Return P^T 1."""
        return self.beta * transpose_times(self.kernel, self.alpha)

    def dense(self) -> Float[Tensor, "b m n"]:
        """Return P as a tensor (b, m, n)."""
        return self.kernel * self.alpha.unsqueeze(-1) * self.beta.unsqueeze(-2)

    def samples(self, some: Int[Tensor, " s"]) -> "Plan":
        """Return the plan of some samples, or this plan if `some` has the length of the batch."""
        if len(some) == len(self.kernel):
            return self
        return Plan(self.kernel[some], self.alpha[some], self.beta[some])

    def degree(self, rows: Float[Tensor, "b m"], cols: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Return the diagonal of diag(cols) - P^T diag(1 / rows) P, for the row and column sums of P.

        It is cols - sum_i P^2 / rows, at least the rounding error of `cols`. Where P is nearly a permutation this
        difference has no correct digits; then the dense P gives the sum of the positive terms P (1 - P / rows).
        """
        weight = divide(torch.ones_like(rows), rows)
        parts = zip(self.kernel.split(CACHED, -2), (self.alpha**2 * weight).split(CACHED, -1), strict=True)
        squares = torch.stack([transpose_times(part.square(), scale) for part, scale in parts]).sum(0)
        degree = cols - self.beta**2 * squares
        weak = (degree < LOST * torch.finfo(cols.dtype).eps * cols).any(-1)
        if bool(weak.any()):
            plan = self.dense()
            exact = (plan * (1 - plan * weight.unsqueeze(-1))).sum(-2)
            degree = torch.where(weak.unsqueeze(-1), exact, degree)
        # A column whose links are below rounding still has an equation; zero would remove it.
        return torch.maximum(degree, torch.finfo(cols.dtype).eps * cols)


def cached_parts(*values: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Split the samples of tensors, first a matrix (b, m, n), into groups that fit in a CPU's cache; one on a GPU."""
    matrices = values[0]
    size = max(1, CACHE // matrices[0].nbytes) if matrices.is_cpu else len(matrices)
    return zip(*(value.split(size) for value in values), strict=True)


def times(matrix: Float[Tensor, "b m n"], b: Float[Tensor, "b n"]) -> Float[Tensor, "b m"]:
    """Return M b.

    It is computed as b^T M^T: in torch 2.13 on the CPU, a batched product with a column takes eight times as long.
    """
    if _is_long(matrix):
        return _long_product(matrix.mT, b)
    return (b.unsqueeze(-2) @ matrix.mT).squeeze(-2)


def transpose_times(matrix: Float[Tensor, "b m n"], a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    """Return M^T a."""
    return _long_product(matrix, a) if _is_long(matrix) else (a.unsqueeze(-2) @ matrix).squeeze(-2)


def divide(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Return the quotient, zero where the denominator is not positive (at padded points, whose sum is zero)."""
    return torch.where(denominator > 0, numerator / denominator, 0)


def _is_long(matrix: Tensor) -> bool:
    return matrix.dtype == torch.float32 and max(matrix.shape[-2:]) > 2 * SHORT_SUM


def _long_product(matrix: Float[Tensor, "b m n"], a: Float[Tensor, "b m"]) -> Float[Tensor, "b n"]:
    """Return M^T a with short float32 sums added up in float64; one float32 sum of 15,000 terms is wrong by 1e-6."""
    parts = zip(matrix.split(SHORT_SUM, -2), a.split(SHORT_SUM, -1), strict=True)
    total = torch.stack([(vector.unsqueeze(-2) @ rows).squeeze(-2) for rows, vector in parts])
    return total.sum(0, dtype=torch.float64).to(matrix.dtype)
