"""GOPAC: the pose with most inliers, by nested branch and bound (Campbell et al., ICCV 2017)."""

import heapq
import itertools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.checks import check_positive
from bpnp.compilation import NEVER, Deadline
from bpnp.geometry import bearings
from bpnp.layers.pnp import weighted_pnp
from bpnp.models.baselines.branch_and_bound.boxes import (
    Boxes,
    Found,
    join,
    rotation_uncertainty,
    split,
    take_best,
    translation_uncertainty,
    unit_scene,
    whole_domain,
)
from bpnp.models.baselines.single_pairs import Answer, PairSolver, SinglePair, weak_perspective_distance

DOMAIN = 1.5  # half side of the cube of camera centres, weak-perspective distances
CHUNK = 2**22  # angles computed at a time
ROUNDING = 1e-9  # of a cosine
SMALLEST = 1e-3  # half side of the smallest boxes of camera centres, in root mean square radii of the scene


def maximise_inliers(
    rays: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
    domain: Boxes,
    *,
    angle: float,
    max_boxes: int | None = None,
    deadline: Deadline = NEVER,
) -> Found:
    """Most rays within `angle` (radians) of a point: max nu(R, c) = sum_i max_j [angle(f_i, R (p_j - c)) <= angle].

    Outer search over the camera centre c in the one box of the domain, most promising box first; for each box two inner
    searches over R: at its centre, for a better pose, and with every angle widened by the box's uncertainty psi_t(p_j),
    for whether the box can hold one. A better pose is refined by the weighted PnP layer on its inliers. Boxes under
    SMALLEST are not split: where one might hold more than the best pose, the bound stays above the count.
    """
    rotation, place, count, done = None, domain.place[0], 0, 1
    order = itertools.count()
    queue = [(-len(rays), next(order), domain)]
    unresolved = 0
    while queue and -queue[0][0] > count:
        if deadline.passed() or (max_boxes is not None and done >= max_boxes):
            break
        _, _, box = heapq.heappop(queue)
        children = split(box, torch.zeros_like(box.turn_half, dtype=torch.bool))
        uncertainty = translation_uncertainty(children, points)
        for k in range(len(children.turn_half)):
            child = children.pick(torch.tensor([k], device=points.device))
            directions = torch.nn.functional.normalize(points - child.place[0], dim=-1)
            reach = torch.full_like(points[:, 0], angle)
            here = best_rotation(rays, directions, reach, domain, floor=count, deadline=deadline)
            if here.rotation is not None:
                rotation, place, count = _refined(rays, points, here.rotation, child.place[0], angle)
            wide = (reach + uncertainty[k]).clamp_max(math.pi)
            there = best_rotation(rays, directions, wide, domain, floor=count, first=True, deadline=deadline)
            done += 1 + here.boxes + there.boxes
            if there.bound > count:
                if float(child.place_half.max()) < SMALLEST:
                    unresolved = max(unresolved, there.bound)
                else:
                    heapq.heappush(queue, (-there.bound, next(order), child))
    left = -queue[0][0] if queue else 0
    bound = max(count, left, unresolved)
    return Found(rotation, place, count, bound, done, count >= bound)


def _refined(rays: Tensor, points: Tensor, rotation: Tensor, place: Tensor, angle: float) -> tuple[Tensor, Tensor, int]:
    """The pose and its number of inliers; refined by the weighted PnP layer unless that loses inliers."""
    count = count_inliers(rays, points, rotation, place, angle)
    directions = torch.nn.functional.normalize(points - place, dim=-1)
    inlier = ((rays @ rotation) @ directions.mT >= math.cos(angle)).to(rays)
    weights = (inlier / inlier.sum().clamp_min(1)).unsqueeze(0)
    translation = -rotation @ place
    turned, shift, stats = weighted_pnp(
        weights, rays.unsqueeze(0), points.unsqueeze(0), rotation.unsqueeze(0), translation.unsqueeze(0)
    )
    if bool(stats.converged[0]):
        moved = -turned[0].mT @ shift[0]
        if (refined := count_inliers(rays, points, turned[0], moved, angle)) >= count:
            return turned[0], moved, refined
    return rotation, place, count


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


class GOPAC(PairSolver):
    """Branch and bound on the number of inlying image points; exact, feasible for small problems only.

    The camera centre is searched in a cube around the scene's centre, the rotation everywhere. `residual` of the pose
    is the share of image points without a partner; `converged` is the certificate that no pose has more inliers.

    Args:
        angle: largest angle between an inlier's ray and its scene point, radians.
        max_boxes: most boxes, inner ones included; null for as many as the time allows.
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("gopac",)

    def __init__(self, *, angle: float = 0.005, max_boxes: int | None = None, time_limit: float | None = 30.0) -> None:
        super().__init__(time_limit)
        check_positive(angle=angle)
        self.angle, self.max_boxes = angle, max_boxes

    def solve(self, pair: SinglePair, deadline: Deadline) -> Answer:
        points, centre, radius = unit_scene(pair.points3d)
        domain = whole_domain(points, DOMAIN * weak_perspective_distance(pair.points2d, points))
        found = maximise_inliers(
            bearings(pair.points2d), points, domain, angle=self.angle, max_boxes=self.max_boxes, deadline=deadline
        )
        return found.answer(centre, radius, residual=1 - found.value / len(pair.points2d))
