"""Bearings, rigid motion, projection, angles and rotations of tensors, any leading axes; camera = R p + t."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def bearings(points2d: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
    """Unit viewing rays f = (x, y, 1) / |(x, y, 1)| of normalised image points."""
    homogeneous = torch.cat([points2d, torch.ones_like(points2d[..., :1])], -1)
    return torch.nn.functional.normalize(homogeneous, dim=-1)


def transform(
    rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"], points3d: Float[Tensor, "*b n 3"]
) -> Float[Tensor, "*b n 3"]:
    """Camera coordinates R p + t."""
    return points3d @ rotation.mT + translation.unsqueeze(-2)


def project(points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
    """Normalised image coordinates (x/z, y/z) of points in camera coordinates; infinite at z = 0."""
    return points[..., :2] / points[..., 2:]


def camera_centre(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Centre of the camera in scene coordinates, -R^T t."""
    return -(rotation.mT @ translation.unsqueeze(-1)).squeeze(-1)


def choose(chosen: Bool[Tensor, " b"], first: Tensor, second: Tensor) -> Tensor:
    """The first tensor (b, ...) for the chosen samples, the second for the others."""
    return torch.where(chosen.view(-1, *(1 for _ in first.shape[1:])), first, second)


def hat(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Skew matrix [v]x with [v]x w = v x w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def retract(
    step: Float[Tensor, "*b 6"], rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Pose (exp([w]x) R, t + s) after the step (w, s): w in radians, s in the units of t.

    The exponential acts on the left, so that camera coordinates y = R p + t change by w x (R p) + s to first order.

    >>> _, translation = retract(torch.tensor([0.0, 0, 0, 1, 2, 3]), torch.eye(3), torch.zeros(3))
    >>> translation
    tensor([1., 2., 3.])
    """
    import roma  # at its first use: it imports all of torch's compiler

    return roma.rotvec_to_rotmat(step[..., :3]) @ rotation, translation + step[..., 3:]


def quaternion_rotation(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of a quaternion (x, y, z, w) of any length; one of normal numbers gives a uniform rotation."""
    import roma  # as in `retract`

    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))


def random_rotations(
    count: int, generator: torch.Generator | np.random.Generator | None = None
) -> Float[Tensor, "count 3 3"]:
    """Rotations (count, 3, 3) drawn uniformly over SO(3), float64, on the CPU.

    generator: draws 4 normal numbers a rotation; torch's global generator if None.
    """
    if isinstance(generator, np.random.Generator):
        return quaternion_rotation(torch.from_numpy(generator.standard_normal((count, 4))))
    return quaternion_rotation(torch.randn(count, 4, generator=generator, dtype=torch.float64))


def angle_between(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b"]:
    """Angle in radians, atan2(|a x b|, a.b): exact near 0 and pi, where arccos loses half the digits."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1), (a * b).sum(-1))


def is_finite(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
    """Poses that are there: what was not found is NaN or infinite."""
    return rotation.isfinite().all((-2, -1)) & translation.isfinite().all(-1)


def chords(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
) -> Float[Tensor, "b m n"]:
    """|f_i - u_j|, u_j the direction of R p_j + t: 2 sin(angle / 2).

    Keeps its digits at small angles and needs no cross products.
    """
    directions = torch.nn.functional.normalize(transform(rotation, translation, points3d), dim=-1)
    return torch.cdist(bearings, directions, compute_mode="donot_use_mm_for_euclid_dist")


def rotation_angle(a: Float[Tensor, "*b 3 3"], b: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of a^T b in radians, in [0, pi] (paper Eq. 13), by atan2 of twice its sine and twice its cosine.

    The gradient is undefined at 0 and pi; zero is returned there.
    """
    relative = a.mT @ b
    skew = relative - relative.mT
    sine = torch.linalg.vector_norm(torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1), dim=-1)
    cosine = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.atan2(sine, cosine)
