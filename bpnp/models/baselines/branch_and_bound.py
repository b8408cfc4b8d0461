"""Branch and bound over camera poses, and GOPAC.

A pose is camera = R (p - c) with R in a cube of rotation vectors and the camera centre c in a cuboid. Uncertainty
angles bound how far a direction rotates within a box (Campbell et al., Globally-optimal inlier set maximisation, ICCV
2017).
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from bpnp.checks import check_positive
from bpnp.geometry import bearings
from bpnp.layers.pnp import weighted_pnp
from bpnp.models.baselines.single_problem import Answer, SingleProblem, SingleSolver, weak_perspective_distance
from bpnp.runtime import Deadline

DOMAIN = 1.5  # half side of the cube of camera centres, weak-perspective distances
CHUNK = 2**22  # angles computed at a time
ROUNDING = 1e-9  # rounding error of a cosine
SMALLEST_ROTATION = 1e-3  # half side of the smallest cubes of rotation vectors, radians
SMALLEST_CENTRE = 1e-3  # half side of the smallest boxes of camera centres, in root mean square radii of the scene


class Boxes(NamedTuple):
    """Boxes of poses: centres and half sides. The cubes of rotation vectors cover the ball of radius pi."""

    rotvec: Float[Tensor, "b 3"]  # centres of the rotation vectors, radians
    rotvec_half: Float[Tensor, " b"]  # half sides of their cubes, radians
    centre: Float[Tensor, "b 3"]  # centres of the camera centres
    centre_half: Float[Tensor, "b 3"]  # half sides of their cuboids

    @property
    def rotation(self) -> Float[Tensor, "b 3 3"]:
        """Rotations at the centres of the boxes (b, 3, 3)."""
        return roma.rotvec_to_rotmat(self.rotvec)

    def pick(self, index: Tensor) -> "Boxes":
        """Return the boxes at the given indices."""
        return Boxes(*(values[index] for values in self))


class BestPose(NamedTuple):
    """Best pose of a search, camera = R (p - c)."""

    rotation: Float[Tensor, "3 3"] | None  # R, None if there is no pose
    centre: Float[Tensor, "3"]
    value: float  # value of the pose, smaller is better
    bound: float  # lower bound of the value over all poses of the domain
    boxes: int
    certified: bool  # no pose of the domain is better, by more than the allowed gap


class BranchAndBound(SingleSolver):
    """Base of searches over all rotations and over camera centres in a cube around the scene's centroid.

    The half side of the cube is 1.5 times the weak-perspective distance (`weak_perspective_distance`).

    Args:
        max_boxes: Largest number of boxes, None for no limit.
        time_limit: Seconds for each problem, None for no limit.
    """

    def __init__(self, max_boxes: int | None, time_limit: float | None) -> None:
        super().__init__(time_limit)
        self.max_boxes = math.inf if max_boxes is None else max_boxes

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        """Normalise the scene, search, and return the pose in scene axes; arguments as for `SingleSolver.solve`."""
        scene_centre = problem.points3d.mean(0)
        radius = root_mean_square((problem.points3d - scene_centre).norm(dim=-1))
        points = (problem.points3d - scene_centre) / radius
        camera_distance = weak_perspective_distance(problem.points2d, points)
        zero = points.new_zeros(1, 3)
        domain = Boxes(zero, points.new_full((1,), math.pi), zero, points.new_full((1, 3), DOMAIN * camera_distance))
        found = self.search(bearings(problem.points2d), points, domain, camera_distance, deadline)
        if found.rotation is None:
            return Answer(iterations=found.boxes)
        translation = -found.rotation @ (radius * found.centre + scene_centre)
        return Answer((found.rotation, translation), found.boxes, found.value, found.certified)

    def search(
        self,
        rays: Float[Tensor, "m 3"],
        points: Float[Tensor, "n 3"],
        domain: Boxes,
        camera_distance: float,
        deadline: Deadline,
    ) -> BestPose:
        """Return the best pose, whose value is its residual, for a scene of root mean square radius 1 at the origin.

        Args:
            rays: Bearings (m, 3).
            points: Scene points (n, 3).
            domain: One box that holds all poses to search.
            camera_distance: Weak-perspective distance of the camera.
            deadline: Time limit.
        """
        raise NotImplementedError


def root_mean_square(distances: Float[Tensor, " k"]) -> float:
    """Return the root mean square of distances, or 1 where it is zero."""
    value = float(distances.square().mean().sqrt())
    return value if value > 0 and math.isfinite(value) else 1.0


def best_first(
    boxes: Boxes,
    bounds: Float[Tensor, " b"],
    expand: Callable[[Boxes], tuple[Boxes, Float[Tensor, " c"], int | float]],
    *,
    at_once: int,
    until: Callable[[int], bool],
    small: Callable[[Boxes], Bool[Tensor, " b"]] | None = None,
) -> tuple[float, int]:
    """Expand the boxes of highest bound first, until no box can hold a better value than was found.

    `bounds` are upper bounds of the value; `expand` maps boxes to their children, the bounds of these, and the value
    that a bound must exceed for its box to be kept. `until` gets the number of children and returns True to stop;
    `small` returns which boxes are kept for their bound but not expanded. Return the highest bound of the remaining
    boxes, -inf if there are none, and the number of children.
    """
    done, final_bounds = 0, bounds.new_tensor([-math.inf])
    while len(bounds) and not until(done):
        # One at a time, the oldest of equal bounds is expanded.
        chosen = bounds.topk(min(at_once, len(bounds))).indices if at_once > 1 else bounds.argmax().unsqueeze(0)
        rest = torch.ones_like(bounds, dtype=torch.bool)
        rest[chosen] = False
        children, upper, least = expand(boxes.pick(chosen))
        done += len(upper)
        boxes = Boxes(*(torch.cat(values) for values in zip(boxes.pick(rest), children, strict=True)))
        bounds = torch.cat([bounds[rest], torch.minimum(upper, bounds.max())])
        promising = bounds > least
        boxes, bounds = boxes.pick(promising), bounds[promising]
        if small is not None:
            final = small(boxes)
            final_bounds = torch.cat([final_bounds, bounds[final]])
            boxes, bounds = boxes.pick(~final), bounds[~final]
    return float(torch.cat([final_bounds, bounds]).max()), done


def rotation_uncertainty(boxes: Boxes) -> Float[Tensor, " b"]:
    """Return psi_r >= angle(R x, R_0 x) for all R in the cube around R_0 and all x: sqrt(3) times its half side."""
    return (math.sqrt(3) * boxes.rotvec_half).clamp_max(math.pi)


def translation_uncertainty(boxes: Boxes, points: Float[Tensor, "a 3"]) -> Float[Tensor, "b a"]:
    """Return psi_t(p) >= angle(p - c, p - c_0), (b, a), for all c in the cuboid around c_0.

    Directions to the points of a convex set lie in the cone that its corners span. Their angle to an axis is therefore
    largest at a corner, as long as that is below pi/2; otherwise the bound is pi.
    """
    towards = points - boxes.centre.unsqueeze(1)
    cosine = torch.ones_like(towards[..., 0])
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = towards - (boxes.centre_half * boxes.centre_half.new_tensor(signs)).unsqueeze(1)
        lengths = torch.linalg.vector_norm(corner, dim=-1) * torch.linalg.vector_norm(towards, dim=-1)
        cosine = torch.minimum(cosine, (corner * towards).sum(-1) / lengths.clamp_min(1e-300))
    inside = (towards.abs() <= boxes.centre_half.unsqueeze(1)).all(-1)
    # Rounding of a cosine near 1 changes its angle by 1e-8.
    return torch.where(inside | (cosine <= 0), math.pi, torch.acos(cosine.clamp(max=1)) + 1e-7)


def distance_range(boxes: Boxes, points: Float[Tensor, "a 3"]) -> tuple[Float[Tensor, "b a"], Float[Tensor, "b a"]]:
    """Return the least and the largest distance between each point and the camera centres of each box, (b, a)."""
    offset = (points - boxes.centre.unsqueeze(1)).abs()
    half = boxes.centre_half.unsqueeze(1)
    return (offset - half).clamp_min(0).norm(dim=-1), (offset + half).norm(dim=-1)


def split(boxes: Boxes, rotating: Bool[Tensor, " b"]) -> Boxes:
    """Split each box into eight children, in rotation where `rotating`, else in translation.

    Cubes without a rotation vector of length pi or less are left out.
    """
    signs = boxes.rotvec.new_tensor(list(itertools.product((-0.5, 0.5), repeat=3)))
    chosen = rotating[:, None, None]
    rotvec_shift = torch.where(chosen, boxes.rotvec_half[:, None, None] * signs, 0)
    centre_shift = torch.where(chosen, 0, boxes.centre_half.unsqueeze(1) * signs)
    children = Boxes(
        (boxes.rotvec.unsqueeze(1) + rotvec_shift).flatten(0, 1),
        torch.where(rotating, 0.5, 1.0).mul(boxes.rotvec_half).repeat_interleave(8),
        (boxes.centre.unsqueeze(1) + centre_shift).flatten(0, 1),
        (torch.where(rotating, 1.0, 0.5).unsqueeze(-1) * boxes.centre_half).repeat_interleave(8, 0),
    )
    nearest = (children.rotvec.abs() - children.rotvec_half.unsqueeze(-1)).clamp_min(0).norm(dim=-1)
    return children.pick(nearest <= math.pi)


class GOPAC(BranchAndBound):
    """Branch and bound on the number of inlier image points; exact where `converged`.

    `residual` of the pose is the fraction of image points that are no inliers. `converged` certifies that no pose of
    the domain has more inliers.

    Differences from the paper (Campbell et al., ICCV 2017):

    - A better pose is refined by the weighted PnP layer, in the paper by SoftPOSIT.
    - The search is written in torch and uses one thread; the authors' program is compiled and parallel. Over the whole
      domain, 12 million boxes, 20 CPU seconds, certify nothing even for 8 points.
    - Camera centres lie in a cube of 1.5 weak-perspective distances around the centroid of the scene. Boxes of a half
      side under 0.001 root mean square radii of the scene are not split.

    Args:
        angle: Largest angle between an inlier's ray and its scene point, radians. Default 0.005.
        max_boxes: Largest number of boxes, including those of inner searches; None for as many as the time allows.
        time_limit: Seconds for each problem; then the best pose so far is returned, not converged. None for no limit.
    """

    estimates = ("gopac",)

    def __init__(self, *, angle: float = 0.005, max_boxes: int | None = None, time_limit: float | None = 30.0) -> None:
        super().__init__(max_boxes, time_limit)
        check_positive(angle=angle)
        self.angle = angle

    def search(
        self, rays: Tensor, points: Tensor, domain: Boxes, camera_distance: float, deadline: Deadline
    ) -> BestPose:
        """Maximise nu(R, c) = sum_i max_j [angle(f_i, R (p_j - c)) <= angle], the number of inlier rays.

        The value and the bound are the fractions of rays that are no inliers. The outer search is over the camera
        centre c. For each box there are two inner searches over R. The first, at the centre of the box, looks for a
        better pose, which is refined. The second, with every angle widened by the uncertainty psi_t(p_j), decides
        whether the box can hold one. Boxes under SMALLEST_CENTRE are not split, so their bound may stay above the
        count. Arguments as for `BranchAndBound.search`.
        """
        del camera_distance
        best: tuple[Tensor | None, Tensor, int] = (None, domain.centre[0], 0)
        inner = 1

        def expand(box: Boxes) -> tuple[Boxes, Tensor, int | float]:
            nonlocal best, inner
            children = split(box, torch.zeros_like(box.rotvec_half, dtype=torch.bool))
            bounds = []
            for centre, moving in zip(children.centre, translation_uncertainty(children, points), strict=True):
                reach = torch.full_like(moving, self.angle)
                here = best_rotation(rays, points, centre, reach, domain, floor=best[2], deadline=deadline)
                if here.rotation is not None:
                    best = _refine(rays, points, here.rotation, centre, self.angle)
                wide = (reach + moving).clamp_max(math.pi)
                there = best_rotation(rays, points, centre, wide, domain, floor=best[2], first=True, deadline=deadline)
                inner += here.boxes + there.boxes
                bounds.append(there.bound)
            return children, rays.new_tensor(bounds), best[2]

        left, outer = best_first(
            domain,
            rays.new_full((1,), len(rays)),
            expand,
            at_once=1,
            small=lambda boxes: boxes.centre_half.amax(-1) < SMALLEST_CENTRE,
            until=lambda done: deadline.passed() or done + inner >= self.max_boxes,
        )
        value, bound = (1 - count / len(rays) for count in (best[2], max(best[2], left)))
        return BestPose(*best[:2], value, bound, outer + inner, best[2] >= left)


def _refine(rays: Tensor, points: Tensor, rotation: Tensor, centre: Tensor, angle: float) -> tuple[Tensor, Tensor, int]:
    """Refine a pose by weighted PnP unless that loses inliers; return the pose and its number of inliers."""
    near = within(rays, points, rotation, centre, angle)
    count = int(near.any(-1).sum())
    inputs = near.to(rays), rays, points, rotation, -rotation @ centre
    turned, shift, stats = weighted_pnp(*(x.unsqueeze(0) for x in inputs))
    if bool(stats.converged[0]):
        moved = -turned[0].mT @ shift[0]
        if (refined := int(within(rays, points, turned[0], moved, angle).any(-1).sum())) >= count:
            return turned[0], moved, refined
    return rotation, centre, count


def best_rotation(
    rays: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
    centre: Float[Tensor, "3"],
    reach: Float[Tensor, " n"],
    domain: Boxes,
    *,
    floor: int,
    first: bool = False,
    deadline: Deadline,
) -> BestPose:
    """Maximise the number of rays f_i with some angle(f_i, R (p_j - c)) <= reach_j over rotations, at one centre c.

    The reach is in radians. Boxes that cannot have more than `floor` such rays are dropped; with `first`, the first
    rotation that exceeds it ends the search. Boxes under SMALLEST_ROTATION are not split; they, and those left at the
    deadline, keep the bound above the count.
    """
    directions = normalize(points - centre, dim=-1)
    count, rotation = floor, None

    def expand(parents: Boxes) -> tuple[Boxes, Tensor, int | float]:
        nonlocal count, rotation
        children = split(parents, torch.ones_like(parents.rotvec_half, dtype=torch.bool))
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
        small=lambda boxes: boxes.rotvec_half < SMALLEST_ROTATION,
        until=lambda _: deadline.passed() or (first and rotation is not None),
    )
    return BestPose(rotation, centre, count, max(count, left), boxes, count >= left)


def within(rays: Tensor, points: Tensor, rotation: Tensor, centre: Tensor, angle: float) -> Bool[Tensor, "m n"]:
    """Return which pairs have angle(f_i, R (p_j - c)) <= `angle`, (m, n)."""
    return (rays @ rotation) @ normalize(points - centre, dim=-1).mT >= math.cos(angle) - ROUNDING
