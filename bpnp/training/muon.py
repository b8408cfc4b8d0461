"""Muon: gradient steps with orthogonal matrices, for the hidden layers of a network (Jordan et al., 2024).

`torch.optim.Muon` (torch 2.9 and later) trains matrices alone, one at a time in bfloat16. With it a step of a
BPnPNet takes 93 ms of one core that multiplies bfloat16, 376 with AVX-512 alone and 4,900 with AVX2; here 190 to 205.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Adam

from bpnp.checks import check_within

SMALLEST_SIDE = 16  # matrices with a shorter side are inputs or outputs; Adam trains them
MOMENTUM = 0.95
# a x + b x^3 + c x^5 maps singular values in (0, 1] to about 1 (0.7 to 1.2) within five steps (Jordan et al.).
POLYNOMIAL, STEPS = (3.4445, -4.7750, 2.0315), 5
SMALLEST = 1e-7  # added to the norm of a gradient, which may be zero


def orthogonalise(matrices: Float[Tensor, "k r c"]) -> Float[Tensor, "k r c"]:
    """Return approximately the nearest matrices with orthonormal rows or columns, by Newton-Schulz iteration.

    Singular vectors are kept; singular values become 0.7 to 1.2, those near zero less. For a matrix U S V^T, the exact
    result is U V^T. The arithmetic is float32 or better: in bfloat16, many CPUs take ten times as long.
    """
    a, b, c = POLYNOMIAL
    tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.mT if tall else matrices
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    x = x / (torch.linalg.matrix_norm(x, keepdim=True) + SMALLEST)
    for _ in range(STEPS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.mT if tall else x).to(matrices.dtype)


class Muon(Adam):
    """Muon for the matrices of the hidden layers, Adam for all other parameters.

    Each step moves a matrix by an orthogonal one: by the momentum of its gradient with all singular values set to
    about one. The packaged `paper-lc` and `paper-lclp` were trained with it (docs/model-card.md).

    Args:
        params: Parameters of a module. Those with two dimensions of 16 or more count as matrices.
        lr: Learning rate of the matrices, about the singular values of a step. A matrix with more rows r than columns c
            moves by sqrt(r / c) times as much.
        adam_lr: Learning rate of the others.

    Raises:
        ValueError: A learning rate is negative.

    Example:
        >>> from torch import nn
        >>> from bpnp.training import Muon
        >>> optimizer = Muon(nn.Linear(32, 32).parameters(), lr=0.01)
        >>> [len(group["params"]) for group in optimizer.param_groups]  # the weight; the bias
        [1, 1]

    With the command line: `bpnp fit --config procedural --optimizer bpnp.training.Muon --optimizer.lr 0.01`.
    """

    def __init__(self, params: Iterable[nn.Parameter], lr: float = 0.01, adam_lr: float = 1e-3) -> None:
        check_within(0, math.inf, lr=lr, adam_lr=adam_lr)
        parameters = [parameter for parameter in params if parameter.requires_grad]
        matrices = [one for one in parameters if one.ndim == 2 and min(one.shape) >= SMALLEST_SIDE]
        chosen = {id(one) for one in matrices}
        others = [one for one in parameters if id(one) not in chosen]
        groups = [{"params": matrices, "lr": lr, "muon": True}, {"params": others, "lr": adam_lr, "muon": False}]
        super().__init__([group for group in groups if group["params"]], lr=adam_lr)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Perform one step: of Muon for the matrices, of Adam for the others.

        Args:
            closure: Function that computes the gradients again and returns the loss.

        Returns:
            Its result, or None without one.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        gradients: list[tuple[Tensor, Tensor]] = []
        for group in (each for each in self.param_groups if each["muon"]):
            alike: dict[tuple[Any, ...], list[tuple[Tensor, Tensor]]] = {}
            for one in group["params"]:
                if one.grad is not None:
                    alike.setdefault((one.shape, one.dtype, one.device), []).append((one, one.grad))
            for same in alike.values():
                self._move(same, group["lr"])
                gradients += same
        for one, _ in gradients:
            one.grad = None  # Adam leaves it out
        super().step()
        for one, gradient in gradients:
            one.grad = gradient
        return loss

    def _move(self, same: list[tuple[Tensor, Tensor]], lr: float) -> None:
        """Move matrices of one shape, given with their gradients."""
        directions = []
        for one, gradient in same:
            if not (state := self.state[one]):
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(one))  # Adam expects a step
            momentum = state["momentum"]
            momentum.lerp_(gradient, 1 - MOMENTUM)
            directions.append(torch.lerp(gradient, momentum, MOMENTUM))  # Nesterov's
        rows, columns = same[0][0].shape
        scale = max(1.0, rows / columns) ** 0.5
        for (one, _), direction in zip(same, orthogonalise(torch.stack(directions)), strict=True):
            one.sub_(direction, alpha=lr * scale)
