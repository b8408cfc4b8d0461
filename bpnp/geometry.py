"""Geometry of poses and bearings: rigid motion, projection, rotations and angles of tensors.

A pose is world to camera: camera = R p + t. Functions take any number of leading axes unless they say otherwise.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def bearings(points2d: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
    """Return the unit viewing rays f = (x, y, 1) / |(x, y, 1)| of normalised image points, in camera coordinates.

    >>> import torch
    >>> from bpnp.geometry import bearings
    >>> bearings(torch.tensor([[0.75, 0.0]]))
    tensor([[0.6000, 0.0000, 0.8000]])
    """
    homogeneous = torch.cat([points2d, torch.ones_like(points2d[..., :1])], -1)
    return torch.nn.functional.normalize(homogeneous, dim=-1)


def transform(
    rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"], points3d: Float[Tensor, "*b n 3"]
) -> Float[Tensor, "*b n 3"]:
    """Transform scene points to camera coordinates, R p + t."""
    return points3d @ rotation.mT + translation.unsqueeze(-2)


def project(points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
    """Project points in camera coordinates to the normalised image plane, (x/z, y/z); infinite at z = 0.

    >>> import torch
    >>> from bpnp.geometry import project
    >>> project(torch.tensor([1.0, 2.0, 4.0]))
    tensor([0.2500, 0.5000])
    """
    return points[..., :2] / points[..., 2:]


def camera_centre(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Return the camera centre in scene coordinates, -R^T t."""
    return -(rotation.mT @ translation.unsqueeze(-1)).squeeze(-1)


def choose(chosen: Bool[Tensor, " b"], first: Tensor, second: Tensor) -> Tensor:
    """Choose `first` (b, ...) for the samples of the mask and `second` (b, ...) for the others."""
    return torch.where(chosen.view(-1, *(1 for _ in first.shape[1:])), first, second)


def hat(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the skew-symmetric matrix [v]x with [v]x w = v x w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def retract(
    step: Float[Tensor, "*b 6"], rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Move a pose by a step (w, s): (R, t) becomes (exp([w]x) R, t + s), with w in radians.

    The exponential acts on the left, so that camera coordinates y = R p + t change by w x (R p) + s to first order.

    >>> import torch
    >>> from bpnp.geometry import retract
    >>> _, translation = retract(torch.tensor([0.0, 0, 0, 1, 2, 3]), torch.eye(3), torch.zeros(3))
    >>> translation
    tensor([1., 2., 3.])
    """
    import roma  # here, not at the top: it imports all of torch's compiler

    return roma.rotvec_to_rotmat(step[..., :3]) @ rotation, translation + step[..., 3:]


def quaternion_rotation(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Convert quaternions (x, y, z, w) of any length but zero to rotation matrices.

    A quaternion of four normal numbers gives a uniformly random rotation.
    """
    import roma  # as in `retract`

    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))


def random_rotations(
    count: int, generator: torch.Generator | np.random.Generator | None = None
) -> Float[Tensor, "count 3 3"]:
    """Draw rotations uniformly over SO(3), float64, on the CPU, from 4 normal numbers each.

    By default they come from torch's global generator.
    """
    if isinstance(generator, np.random.Generator):
        return quaternion_rotation(torch.from_numpy(generator.standard_normal((count, 4))))
    return quaternion_rotation(torch.randn(count, 4, generator=generator, dtype=torch.float64, device="cpu"))


def angle_between(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b"]:
    """Return the angle between vectors of any length, atan2(|a x b|, a.b), in [0, pi] radians.

    This form is exact near 0 and pi, where arccos loses half of the digits.
    """
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1), (a * b).sum(-1))


def is_finite(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
    """Return which poses are finite: one that was not found holds NaN or infinity."""
    return rotation.isfinite().all((-2, -1)) & translation.isfinite().all(-1)


def masked_median(values: Float[Tensor, "*b k"], mask: Bool[Tensor, "*#b k"]) -> Float[Tensor, "*b"]:
    """Return the lower median of the values where the mask is True, NaN without one.

    It is that of `torch.nanmedian`, which is not deterministic on a GPU.
    """
    mask = mask.expand_as(values)
    ordered = values.masked_fill(~mask, torch.inf).sort(-1).values
    count = mask.sum(-1, keepdim=True)
    middle = ordered.gather(-1, (count - 1).clamp(min=0) // 2)
    return middle.masked_fill(count == 0, torch.nan).squeeze(-1)


def chords(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
) -> Float[Tensor, "b m n"]:
    """Return the distance between each bearing and each point's direction, |f_i - u_j| = 2 sin(angle / 2), in [0, 2].

    u_j is the unit direction of R p_j + t. The chord keeps its digits at small angles and needs no cross products.
    """
    directions = torch.nn.functional.normalize(transform(rotation, translation, points3d), dim=-1)
    return torch.cdist(bearings, directions, compute_mode="donot_use_mm_for_euclid_dist")


def within_angle(
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    angle: float,
) -> Bool[Tensor, "b m n"]:
    """Return [angle(f_i, R p_j + t) <= angle] (paper Eq. 3), radians, computed from the chord between unit vectors."""
    return chords(bearings(points2d), points3d, rotation, translation) <= 2 * math.sin(angle / 2)


def rotation_angle(a: Float[Tensor, "*b 3 3"], b: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the angle of the relative rotation a^T b in [0, pi] radians (paper Eq. 13).

    It is atan2 of twice the sine and twice the cosine. The gradient is undefined at 0 and pi; zero is returned there.
    """
    relative = a.mT @ b
    skew = relative - relative.mT
    sine = torch.linalg.vector_norm(torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1), dim=-1)
    cosine = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.atan2(sine, cosine)
