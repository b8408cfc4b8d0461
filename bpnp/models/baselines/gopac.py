"""GOPAC: the camera that sees most points, by branch and bound over its centre and, for each centre, over its rotation
(Campbell et al., Globally-optimal inlier set maximisation, ICCV 2017).
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from bpnp.checks import check_positive
from bpnp.layers.pnp import weighted_pnp
from bpnp.loops.parallel import NEVER, Deadline
from bpnp.models.baselines.branch_and_bound import (
    Boxes,
    BranchAndBound,
    Found,
    best_first,
    rotation_uncertainty,
    split,
    translation_uncertainty,
)

CHUNK = 2**22  # angles computed at a time
ROUNDING = 1e-9  # of a cosine
SMALLEST_TURN = 1e-3  # half side of the smallest cubes of rotation vectors, radians
SMALLEST_PLACE = 1e-3  # half side of the smallest boxes of camera centres, in root mean square radii of the scene


class GOPAC(BranchAndBound):
    """Branch and bound on the number of inlying image points; exact, feasible for small problems only.

    `residual` of the pose is the share of image points without a partner; `converged` is the certificate that no pose
    has more inliers.

    Args:
        angle: largest angle between an inlier's ray and its scene point, radians.
        max_boxes: most boxes, inner ones included; null for as many as the time allows.
        time_limit: seconds a problem, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("gopac",)

    def __init__(self, *, angle: float = 0.005, max_boxes: int | None = None, time_limit: float | None = 30.0) -> None:
        super().__init__(max_boxes, time_limit)
        check_positive(angle=angle)
        self.angle = angle

    def search(self, rays: Tensor, points: Tensor, domain: Boxes, away: float, deadline: Deadline) -> Found:
        del away
        found = maximise_inliers(rays, points, domain, angle=self.angle, max_boxes=self.max_boxes, deadline=deadline)
        return found._replace(value=1 - found.value / len(rays))


def maximise_inliers(
    rays: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
    domain: Boxes,
    *,
    angle: float,
    max_boxes: int | float = math.inf,
    deadline: Deadline = NEVER,
) -> Found:
    """Most rays within `angle` (radians) of a point: max nu(R, c) = sum_i max_j [angle(f_i, R (p_j - c)) <= angle].

    The outer search is over the camera centre c in the one box of the domain; for each box two inner searches over R:
    at its centre, for a better pose, which is refined, and with every angle widened by the uncertainty psi_t(p_j),
    for whether the box can hold one. Boxes under SMALLEST_PLACE are not split: their bound may stay above the count.
    """
    best: tuple[Tensor | None, Tensor, int] = (None, domain.place[0], 0)
    inner = 1

    def expand(box: Boxes) -> tuple[Boxes, Tensor, int | float]:
        nonlocal best, inner
        children = split(box, torch.zeros_like(box.turn_half, dtype=torch.bool))
        bounds = []
        for place, moving in zip(children.place, translation_uncertainty(children, points), strict=True):
            reach = torch.full_like(moving, angle)
            here = best_rotation(rays, points, place, reach, domain, floor=best[2], deadline=deadline)
            if here.rotation is not None:
                best = _refined(rays, points, here.rotation, place, angle)
            wide = (reach + moving).clamp_max(math.pi)
            there = best_rotation(rays, points, place, wide, domain, floor=best[2], first=True, deadline=deadline)
            inner += here.boxes + there.boxes
            bounds.append(there.bound)
        return children, rays.new_tensor(bounds), best[2]

    left, outer = best_first(
        domain,
        rays.new_full((1,), len(rays)),
        expand,
        at_once=1,
        small=lambda boxes: boxes.place_half.amax(-1) < SMALLEST_PLACE,
        until=lambda done: deadline.passed() or done + inner >= max_boxes,
    )
    bound = max(best[2], left)
    return Found(*best, bound, outer + inner, best[2] >= bound)


def _refined(rays: Tensor, points: Tensor, rotation: Tensor, place: Tensor, angle: float) -> tuple[Tensor, Tensor, int]:
    """The pose and its number of inliers; refined by the weighted PnP layer unless that loses inliers."""
    near = within(rays, points, rotation, place, angle)
    count = int(near.any(-1).sum())
    inputs = near.to(rays), rays, points, rotation, -rotation @ place
    turned, shift, stats = weighted_pnp(*(x.unsqueeze(0) for x in inputs))
    if bool(stats.converged[0]):
        moved = -turned[0].mT @ shift[0]
        if (refined := int(within(rays, points, turned[0], moved, angle).any(-1).sum())) >= count:
            return turned[0], moved, refined
    return rotation, place, count


def best_rotation(
    rays: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
    place: Float[Tensor, "3"],
    reach: Float[Tensor, " n"],
    domain: Boxes,
    *,
    floor: int,
    first: bool = False,
    deadline: Deadline = NEVER,
) -> Found:
    """Most rays f_i with some angle(f_i, R (p_j - c)) <= reach_j, over the rotations of a domain, at one centre c.

    Boxes that cannot have more than `floor` rays are dropped. first: stop at the first rotation that has. Boxes under
    SMALLEST_TURN are not split; they, and those left at the deadline, keep the bound above the count.
    """
    directions = normalize(points - place, dim=-1)
    count, rotation = floor, None

    def expand(parents: Boxes) -> tuple[Boxes, Tensor, int | float]:
        nonlocal count, rotation
        children = split(parents, torch.ones_like(parents.turn_half, dtype=torch.bool))
        cosine = (rays @ children.rotation) @ directions.mT  # (b, m, n)
        widened = (reach + rotation_uncertainty(children).unsqueeze(-1)).clamp_max(math.pi)
        reached = (cosine >= reach.cos() - ROUNDING).any(-1).sum(-1)
        reachable = (cosine >= (widened.cos() - ROUNDING).unsqueeze(1)).any(-1).sum(-1).to(rays)
        i = int(reached.argmax())
        if int(reached[i]) > count:
            count, rotation = int(reached[i]), children.rotation[i]
        return children, reachable, count

    left, boxes = best_first(
        domain,
        rays.new_full((1,), len(rays)),
        expand,
        at_once=max(1, CHUNK // (8 * len(rays) * len(directions))),
        small=lambda boxes: boxes.turn_half < SMALLEST_TURN,
        until=lambda _: deadline.passed() or (first and rotation is not None),
    )
    return Found(rotation, place, count, max(count, left), boxes, count >= left)


def within(rays: Tensor, points: Tensor, rotation: Tensor, place: Tensor, angle: float) -> Bool[Tensor, "m n"]:
    """Whether angle(f_i, R (p_j - c)) <= `angle`."""
    return (rays @ rotation) @ normalize(points - place, dim=-1).mT >= math.cos(angle) - ROUNDING
