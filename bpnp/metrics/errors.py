"""How far a camera pose is from the true one.

Conventions: camera = R p + t. Angles are in degrees, lengths in scene units; everything is computed in float64.
A pair without a pose (NaN or infinity in the estimate) has errors of 180 deg and infinity: it counts as the worst pose,
it is never left out. A pair with a pose but without a true match has no reprojection error (NaN).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import angle_between, bearings, camera_centre, is_finite, rotation_angle, transform
from bpnp.types import Batch, Pose


@dataclass(frozen=True)
class PoseErrors:
    """Errors of one estimate for b pairs, float64; see the functions below. `index` is the pairs' `Batch.index`."""

    rotation_deg: Float[Tensor, " b"]
    translation: Float[Tensor, " b"]
    centre: Float[Tensor, " b"]
    reprojection_deg: Float[Tensor, " b"]
    index: Int[Tensor, " b"] | None = None


def rotation_error(rotation: Float[Tensor, "b 3 3"], rotation_gt: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Angle of R^T R_gt in degrees, in [0, 180] (paper Eq. 11), by atan2; 180 where R is not finite.

    >>> quarter_turn = torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    >>> float(rotation_error(quarter_turn, torch.eye(3)[None]))
    90.0
    """
    error = torch.rad2deg(rotation_angle(rotation.double(), rotation_gt.double()))
    return error.where(rotation.isfinite().all((-2, -1)), 180.0)


def translation_error(translation: Float[Tensor, "b 3"], translation_gt: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
    """|t - t_gt| in scene units (paper Eq. 12); infinite where t is not finite.

    >>> float(translation_error(torch.tensor([[3.0, 4.0, 1.0]]), torch.tensor([[0.0, 0.0, 1.0]])))
    5.0
    """
    error = torch.linalg.vector_norm(translation.double() - translation_gt.double(), dim=-1)
    return error.where(translation.isfinite().all(-1), math.inf)


def centre_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    rotation_gt: Float[Tensor, "b 3 3"],
    translation_gt: Float[Tensor, "b 3"],
) -> Float[Tensor, " b"]:
    """Distance |R^T t - R_gt^T t_gt| of the camera centres in scene units; infinite where the pose is not finite.

    Unlike |t - t_gt| it does not depend on where the scene's origin is.
    """
    centre = camera_centre(rotation.double(), translation.double())
    error = torch.linalg.vector_norm(centre - camera_centre(rotation_gt.double(), translation_gt.double()), dim=-1)
    return error.where(is_finite(rotation, translation), math.inf)


def reprojection_error(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    match3d: Int[Tensor, "b n"],
) -> Float[Tensor, " b"]:
    """Mean angle in degrees between f_i and R p_j + t over the true pairs i = match3d[j] >= 0.

    Paper Eq. 2 divides the sum over the true pairs by m n; here it is divided by their number, so that it is an angle
    and does not depend on the sizes of the sets. A point at the camera centre counts as 180. A sample without a pose
    is 180; else a sample without a true pair is NaN.
    """
    true = match3d >= 0
    seen = points2d.double().gather(1, match3d.clamp(min=0).unsqueeze(-1).expand(-1, -1, 2))
    points = transform(rotation.double(), translation.double(), points3d.double())
    angle = angle_between(bearings(seen), points).where((points != 0).any(-1), math.pi)
    mean = torch.rad2deg(angle.where(true, 0.0).sum(-1) / true.sum(-1))
    return mean.where(is_finite(rotation, translation), 180.0)


def pose_errors(pose: Pose, batch: Batch) -> PoseErrors:
    """All four errors against the batch's true pose. `reprojection_deg` is NaN if the batch has no `match3d`.

    Raises ValueError if the true pose is absent or not finite.
    """
    if batch.rotation is None or batch.translation is None:
        raise ValueError("expected a batch with its true `rotation` and `translation`, got None; try Batch.from_arrays")
    known = is_finite(batch.rotation, batch.translation)
    if not bool(known.all()):
        raise ValueError(f"expected a finite true pose, got NaN or infinity in {batch.ids[int(known.int().argmin())]}")
    rotation = pose.rotation.where(pose.found[:, None, None], math.nan)
    translation = pose.translation.where(pose.found[:, None], math.nan)
    reprojection = torch.full_like(translation[:, 0], math.nan, dtype=torch.float64)
    if batch.match3d is not None:
        reprojection = reprojection_error(rotation, translation, batch.points2d, batch.points3d, batch.match3d)
    return PoseErrors(
        rotation_deg=rotation_error(rotation, batch.rotation),
        translation=translation_error(translation, batch.translation),
        centre=centre_error(rotation, translation, batch.rotation, batch.translation),
        reprojection_deg=reprojection,
        index=batch.index,
    )
