"""Branch and bound over camera poses: camera = R (p - c), R in a cube of rotation vectors, c in a cuboid.

Uncertainty angles bound how far a direction turns in a box (Campbell et al., Globally-optimal inlier set maximisation,
ICCV 2017).
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import bearings
from bpnp.loops.parallel import Deadline
from bpnp.models.baselines.single_problem import Answer, SingleProblem, SingleSolver, weak_perspective_distance

DOMAIN = 1.5  # half side of the cube of camera centres, weak-perspective distances


class Boxes(NamedTuple):
    """Centres and half sides. The cubes of rotation vectors cover the ball of radius pi."""

    turn: Float[Tensor, "b 3"]
    turn_half: Float[Tensor, " b"]
    place: Float[Tensor, "b 3"]
    place_half: Float[Tensor, "b 3"]

    @property
    def rotation(self) -> Float[Tensor, "b 3 3"]:
        return roma.rotvec_to_rotmat(self.turn)

    def pick(self, index: Tensor) -> "Boxes":
        return Boxes(*(values[index] for values in self))


class Found(NamedTuple):
    """The best pose, camera = R (p - c), and its value; `certified`: no pose of the domain is better than `bound`, and
    this one is as good, or within the gap that is asked for."""

    rotation: Float[Tensor, "3 3"] | None
    place: Float[Tensor, "3"]
    value: float
    bound: float
    boxes: int
    certified: bool


class BranchAndBound(SingleSolver):
    """Searches the camera centre in a cube around the scene's centre and the rotation everywhere."""

    def __init__(self, max_boxes: int | None, time_limit: float | None) -> None:
        super().__init__(time_limit)
        self.max_boxes = math.inf if max_boxes is None else max_boxes

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        centre = problem.points3d.mean(0)
        radius = root_mean_square((problem.points3d - centre).norm(dim=-1))
        points = (problem.points3d - centre) / radius
        away = weak_perspective_distance(problem.points2d, points)
        zero = points.new_zeros(1, 3)
        domain = Boxes(zero, points.new_full((1,), math.pi), zero, points.new_full((1, 3), DOMAIN * away))
        found = self.search(bearings(problem.points2d), points, domain, away, deadline)
        if found.rotation is None:
            return Answer(iterations=found.boxes)
        translation = -found.rotation @ (radius * found.place + centre)
        return Answer((found.rotation, translation), found.boxes, found.value, found.certified)

    def search(
        self, rays: Float[Tensor, "m 3"], points: Float[Tensor, "n 3"], domain: Boxes, away: float, deadline: Deadline
    ) -> Found:
        """The best pose for a scene of root mean square radius 1 at the origin; its value is the pose's residual.

        away: weak-perspective distance of the camera.
        """
        raise NotImplementedError


def root_mean_square(distances: Float[Tensor, " k"]) -> float:
    """Root mean square; 1 where it is zero."""
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
    """Expand the `at_once` boxes of highest bound together until no box can hold anything better than was found.

    bounds: no pose of a box is better. expand: boxes to their children, the bounds of these, and the value that a bound
    must exceed for its box to be kept. until: whether to stop after so many children. small: which boxes are kept for
    their bound but not expanded.
    Returns the highest bound of the boxes that are left, -inf if none is, and the number of children.
    """
    done, aside = 0, bounds.new_tensor([-math.inf])
    while len(bounds) and not until(done):
        # One at a time: of equal bounds the oldest.
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
            aside = torch.cat([aside, bounds[final]])
            boxes, bounds = boxes.pick(~final), bounds[~final]
    return float(torch.cat([aside, bounds]).max()), done


def rotation_uncertainty(boxes: Boxes) -> Float[Tensor, " b"]:
    """psi_r >= angle(R x, R_0 x) for all R in the cube around R_0 and all x: sqrt(3) times its half side."""
    return (math.sqrt(3) * boxes.turn_half).clamp_max(math.pi)


def translation_uncertainty(boxes: Boxes, points: Float[Tensor, "a 3"]) -> Float[Tensor, "b a"]:
    """psi_t(p) >= angle(p - c, p - c_0) for all c in the cuboid around c_0.

    The directions to the points of a convex set lie in the cone that its corners span, so that their angle to an axis
    is largest at a corner, as long as that is below pi/2; else pi.
    """
    towards = points - boxes.place.unsqueeze(1)
    cosine = torch.ones_like(towards[..., 0])
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = towards - (boxes.place_half * boxes.place_half.new_tensor(signs)).unsqueeze(1)
        lengths = torch.linalg.vector_norm(corner, dim=-1) * torch.linalg.vector_norm(towards, dim=-1)
        cosine = torch.minimum(cosine, (corner * towards).sum(-1) / lengths.clamp_min(1e-300))
    inside = (towards.abs() <= boxes.place_half.unsqueeze(1)).all(-1)
    # The rounding of a cosine near 1 is worth 1e-8 in its angle.
    return torch.where(inside | (cosine <= 0), math.pi, torch.acos(cosine.clamp(max=1)) + 1e-7)


def distance_range(boxes: Boxes, points: Float[Tensor, "a 3"]) -> tuple[Float[Tensor, "b a"], Float[Tensor, "b a"]]:
    """Least and largest distance between a point and the camera centres of a box."""
    offset = (points - boxes.place.unsqueeze(1)).abs()
    half = boxes.place_half.unsqueeze(1)
    return (offset - half).clamp_min(0).norm(dim=-1), (offset + half).norm(dim=-1)


def split(boxes: Boxes, turning: Bool[Tensor, " b"]) -> Boxes:
    """The eight children of each box, in rotation where `turning`, else in translation; cubes without a rotation
    vector of length pi or less are left out."""
    signs = boxes.turn.new_tensor(list(itertools.product((-0.5, 0.5), repeat=3)))
    chosen = turning[:, None, None]
    turn_shift = torch.where(chosen, boxes.turn_half[:, None, None] * signs, 0)
    place_shift = torch.where(chosen, 0, boxes.place_half.unsqueeze(1) * signs)
    children = Boxes(
        (boxes.turn.unsqueeze(1) + turn_shift).flatten(0, 1),
        torch.where(turning, 0.5, 1.0).mul(boxes.turn_half).repeat_interleave(8),
        (boxes.place.unsqueeze(1) + place_shift).flatten(0, 1),
        (torch.where(turning, 1.0, 0.5).unsqueeze(-1) * boxes.place_half).repeat_interleave(8, 0),
    )
    nearest = (children.turn.abs() - children.turn_half.unsqueeze(-1)).clamp_min(0).norm(dim=-1)
    return children.pick(nearest <= math.pi)
