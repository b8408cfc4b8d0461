"""P3P on tensors: poses of samples of three matches."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.search.propose.minimal_solvers import p3p_poses


class P3P(NamedTuple):
    """Poses of three matches, camera = R p + t; up to four for each sample."""

    rotation: Float[Tensor, "*b 4 3 3"]  # NaN in an empty slot
    translation: Float[Tensor, "*b 4 3"]  # NaN in an empty slot
    valid: Bool[Tensor, "*b 4"]  # False for an empty slot


def p3p(bearings: Float[Tensor, "*b 3 3"], points3d: Float[Tensor, "*b 3 3"]) -> P3P:
    """Solve d_i f_i = R p_i + t, d_i > 0, for triples of matches; see `p3p_poses` for the method.

    Rays f_i have any length, points p_i any scale and offset. Poses have the type and device of `points3d` and are
    computed in float64 on the CPU. The four slots have no order.

    >>> import torch
    >>> from bpnp.layers.ransac.minimal_solvers import p3p
    >>> points3d = torch.eye(3)
    >>> camera = points3d + torch.tensor([0.0, 0.0, 5.0])
    >>> solution = p3p(camera, points3d)
    >>> rotation_is_found = (solution.rotation - torch.eye(3)).abs().amax((-2, -1)) < 1e-5
    >>> bool((rotation_is_found & solution.valid).any())
    True
    """
    rays, points = (values.detach().double().cpu().numpy().reshape(-1, 3, 3) for values in (bearings, points3d))
    found = torch.from_numpy(p3p_poses(rays, points)).reshape(*points3d.shape[:-2], 4, 4, 3).to(points3d)
    rotation, translation = found[..., :3, :], found[..., 3, :]
    return P3P(rotation, translation, rotation[..., 0, 0].isfinite())


def poses_of_triples(rays: Float[Tensor, "b h 3 3"], points3d: Float[Tensor, "b h 3 3"]) -> Float[Tensor, "b s 3 4"]:
    """Solve all triples (h) of each sample, and pack the poses [R | t] into s = 2 h + 2 slots.

    Slots without a pose are NaN and last. A triple has fewer than two solutions on average; those beyond the s-th are
    dropped.
    """
    solution = p3p(rays, points3d)
    poses = torch.cat([solution.rotation, solution.translation.unsqueeze(-1)], -1).flatten(1, 2)
    filled = solution.valid.flatten(1).byte().argsort(dim=1, descending=True, stable=True)
    return take(poses, filled[:, : 2 * points3d.shape[1] + 2])


def take(values: Tensor, index: Int[Tensor, "b k"]) -> Tensor:
    """Return values[b, index[b, i], ...] for every sample b."""
    trailing = values.shape[2:]
    return values.gather(1, index.view(*index.shape, *(1 for _ in trailing)).expand(*index.shape, *trailing))
