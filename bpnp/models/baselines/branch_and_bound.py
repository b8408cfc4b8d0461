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


def best_first(
    boxes: Boxes,
    bounds: Float[Tensor, " b"],
    expand: Callable[[Boxes], tuple[Boxes, Float[Tensor, " c"], float]],
    *,
    at_once: int,
    until: Callable[[int], bool],
) -> tuple[float, int]:
    """Expand the `at_once` boxes of highest bound together until no box can hold anything better than was found.

    bounds: no pose of a box is better. expand: boxes to their children, the bounds of these, and the value that a bound
    must exceed for its box to be kept. until: whether to stop after so many children.
    Returns the highest bound of the boxes that are left, -inf if none is, and the number of children.
    """
    done = 0
    while len(bounds) and not until(done):
        chosen = bounds.topk(min(at_once, len(bounds))).indices
        rest = torch.ones_like(bounds, dtype=torch.bool)
        rest[chosen] = False
        children, upper, least = expand(boxes.pick(chosen))
        done += len(upper)
        boxes = Boxes(*(torch.cat(values) for values in zip(boxes.pick(rest), children, strict=True)))
        bounds = torch.cat([bounds[rest], torch.minimum(upper, bounds.max())])
        promising = bounds > least
        boxes, bounds = boxes.pick(promising), bounds[promising]
    return float(bounds.max()) if len(bounds) else -math.inf, done


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
