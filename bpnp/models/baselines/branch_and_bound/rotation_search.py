"""The rotation under which most rays are close to a direction, by branch and bound: the inner search of GOPAC."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.compilation import NEVER, Deadline
from bpnp.models.baselines.branch_and_bound.boxes import Boxes, join, rotation_uncertainty, split, take_best

CHUNK = 2**22  # angles computed at a time
ROUNDING = 1e-9  # of a cosine


class BestRotation(NamedTuple):
    """`rotation` has `reached` rays within reach; None if none with more than the floor was found. No rotation of the
    domain has more than `bound`."""

    rotation: Float[Tensor, "3 3"] | None
    reached: int
    bound: int
    boxes: int


def best_rotation(
    rays: Float[Tensor, "m 3"],
    directions: Float[Tensor, "n 3"],
    reach: Float[Tensor, " n"],
    domain: Boxes,
    *,
    floor: int,
    first: bool = False,
    smallest: float = 1e-3,
    deadline: Deadline = NEVER,
) -> BestRotation:
    """Most rays f_i with some angle(f_i, R d_j) <= reach_j, over the rotations of a domain.

    Only rotations with more than `floor` rays are of interest: boxes that cannot have more are dropped. `first`: stop
    at the first of these. Boxes of half side below `smallest` (radians) are not split; they, and the boxes left at the
    deadline, keep the bound above the count.
    """
    pending = domain
    bounds = rays.new_full((len(pending.turn),), len(rays))
    count, rotation, unresolved, done = floor, None, floor, 0
    part = max(1, CHUNK // (8 * len(rays) * len(directions)))
    while len(bounds) and not deadline.passed():
        parents, others, rest = take_best(pending, bounds, part)
        children = split(parents, torch.ones_like(parents.turn_half, dtype=torch.bool))
        reached, reachable = _counts(rays, directions, reach, children)
        done += len(reached)
        i = int(reached.argmax())
        if int(reached[i]) > count:
            count, rotation = int(reached[i]), children.rotation[i]
        pending, bounds = join([others, children]), torch.cat([bounds[rest], reachable])
        if first and rotation is not None:
            break
        small = (pending.turn_half < smallest) & (bounds > count)
        unresolved = max(unresolved, int(bounds[small].max())) if bool(small.any()) else unresolved
        kept = (bounds > count) & ~small
        pending, bounds = pending.pick(kept), bounds[kept]
    left = int(bounds.max()) if len(bounds) else 0
    return BestRotation(rotation, count, max(count, unresolved, left), done)


def _counts(rays: Tensor, directions: Tensor, reach: Tensor, boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Rays within reach under the rotation at each box's centre, and a bound for all rotations of the box."""
    cosine = (rays @ boxes.rotation) @ directions.mT  # (b, m, n)
    exact = cosine >= (reach.cos() - ROUNDING)
    widened = (reach + rotation_uncertainty(boxes).unsqueeze(-1)).clamp_max(math.pi).cos() - ROUNDING
    possible = cosine >= widened.unsqueeze(1)
    return exact.any(-1).sum(-1).to(rays), possible.any(-1).sum(-1).to(rays)


def count_inliers(
    rays: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
    rotation: Float[Tensor, "3 3"],
    place: Float[Tensor, "3"],
    angle: float,
) -> int:
    """nu(R, c): rays f_i with some angle(f_i, R (p_j - c)) <= `angle`."""
    directions = torch.nn.functional.normalize(points - place, dim=-1)
    return int(((rays @ rotation) @ directions.mT >= math.cos(angle) - ROUNDING).any(-1).sum())
