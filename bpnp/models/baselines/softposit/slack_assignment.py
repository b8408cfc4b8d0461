"""Sinkhorn's balancing of a matrix with a slack row and column, as SoftPOSIT has it."""

import torch
from jaxtyping import Float
from torch import Tensor


def slack_scalings(
    kernel: Float[Tensor, "s m n"], *, slack: float, tolerance: float = 1e-3, max_iterations: int = 60
) -> tuple[Float[Tensor, "s m"], Float[Tensor, "s n"]]:
    """u and v such that u_j K_jk v_k with the slack entries sums to one over every real row and every real column.

    All slack entries start as `slack` and only follow their own row or column. Where K_jk is the largest of its row and
    of its column and beats the slack, the slacks of both keep their first ratio to the entry, so that a good match
    cannot be lost to them. Stops when the sums of all rows are off by less than `tolerance` together, in every sample.
    """
    best3d, best2d = kernel.max(2), kernel.max(1)
    rows = torch.arange(kernel.shape[1], device=kernel.device)
    kept2d = (best2d.indices.gather(1, best3d.indices) == rows) & (best3d.values > slack)
    columns = torch.arange(kernel.shape[2], device=kernel.device)
    kept3d = (best3d.indices.gather(1, best2d.indices) == columns) & (best2d.values > slack)
    u, v = torch.ones_like(best3d.values), torch.ones_like(best2d.values)
    total = _product(kernel, v) + slack
    for _ in range(max_iterations):
        u = 1 / total
        partner = torch.where(kept3d, u.gather(1, best2d.indices), 1)
        v = 1 / (_product(kernel.mT, u) + slack * partner)
        total = _product(kernel, v) + slack * torch.where(kept2d, v.gather(1, best3d.indices), 1)
        if bool(((u * total - 1).abs().sum(-1) < tolerance).all()):
            break
    return u, v


def _product(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
