import pytest
import torch

from bpnp.layers.plan import Plan, times, transpose_times


@pytest.mark.parametrize("shape", [(20_000, 3), (3, 20_000)])
def test_long_sums_keep_their_digits(shape: tuple[int, int]) -> None:
    """Sums of thousands of terms to the rounding of their result, as float64 gives them."""
    torch.manual_seed(3)
    matrix = torch.rand(2, *shape)
    x, y = torch.rand(2, shape[1]), torch.rand(2, shape[0])
    exact = (matrix.double() @ x.double().unsqueeze(-1)).squeeze(-1)
    assert ((times(matrix, x) - exact).abs() / exact).max() < 4e-7
    exact = (y.double().unsqueeze(-2) @ matrix.double()).squeeze(-2)
    assert ((transpose_times(matrix, y) - exact).abs() / exact).max() < 4e-7


def test_products_are_those_of_the_matrix() -> None:
    kernel, alpha, beta = (torch.rand(*shape, dtype=torch.float64) for shape in ((3, 5, 7), (3, 5), (3, 7)))
    plan, matrix = Plan(kernel, alpha, beta), torch.diag_embed(alpha) @ kernel @ torch.diag_embed(beta)
    torch.testing.assert_close(plan.formed(), matrix)
    torch.testing.assert_close(plan.times(beta), (matrix @ beta.unsqueeze(-1)).squeeze(-1))
    torch.testing.assert_close(plan.transpose_times(alpha), (matrix.mT @ alpha.unsqueeze(-1)).squeeze(-1))
    torch.testing.assert_close(plan.row_sums(), matrix.sum(-1))
    torch.testing.assert_close(plan.col_sums(), matrix.sum(-2))
    torch.testing.assert_close(plan.samples(torch.tensor([2, 0])).formed(), matrix[[2, 0]])


@pytest.mark.parametrize("level", [0.5, 1e-12])
def test_the_degree_is_the_diagonal_of_the_laplacian(level: float) -> None:
    """Down to plans that are permutations up to 1e-12, where 1 - P^2 / r has no digits; the other terms are summed."""
    eye = torch.eye(6, dtype=torch.float64)
    matrix = ((1 - level) * eye + level * torch.rand(2, 6, 6, dtype=torch.float64)) / 6
    rows, cols = matrix.sum(-1), matrix.sum(-2)
    linked = matrix.mT @ (matrix / rows.unsqueeze(-1))
    others = (linked * (1 - eye)).sum(-1)
    found = Plan.of(matrix).degree(rows, cols)
    torch.testing.assert_close(found, others, rtol=1e-9 if level == 0.5 else 1e-3, atol=0)
