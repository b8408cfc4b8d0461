"""Construction of a `Problem` from a user's arrays: checks and undistortion."""

import math
from typing import Any

import numpy as np

from bpnp.arrays import Array, Labels
from bpnp.cameras import Camera, in_front, is_pinhole
from bpnp.poses import MIN_POINTS
from bpnp.search.arguments import (
    Prior,
    check_points,
    check_unit,
    checked_labels,
    checked_normals,
    checked_scores,
    image_points,
    scene_points,
    unit_bearings,
)
from bpnp.search.measured import Measured, Unit
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.starts import GravityPrior, PosePrior

FLOOR_PIXELS = 0.1  # smallest noise of an image point; no point detector is more accurate [pixels; convention]
# With a smaller one, such as that of an identity matrix, the unit of the image points is no pixel, and the smallest
# noise is unknown.
LEAST_FOCAL = 10.0  # smallest focal length in pixels [pixels; convention]
OFF_AXIS_DEG = 80.0  # largest median angle of image points from the axis of a pinhole camera [degrees; convention]


def problem_from(
    points2d: Any,
    points3d: Any,
    camera: Camera | None,
    *,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    cosines3d: Array | None = None,
    prior: Prior | None = None,
    focal: UnknownFocal | None = None,
    inlier_threshold: float | None = None,
) -> Problem:
    """Check the arrays of one problem, as for `bpnp.solve`, undistort its pixels, and build it.

    Camera and prior are already checked; `cosines3d` and `focal` are fields of `Problem` and not checked. Pixels that
    cannot be undistorted are dropped. The `inlier_threshold`, in the unit of the image points, becomes the largest
    residual of a match in an enumeration. ValueError names the argument: a wrong or swapped shape, too few points (3
    with a known gravity, else 4) or NaN; pixels without a camera or the reverse; or normals, labels or scores that do
    not fit the points.
    """
    fewest = MIN_POINTS - isinstance(prior, GravityPrior)
    image, scene = image_points(points2d), scene_points(points3d)
    if image.ndim == 2 and image.shape[1] == 3 and (camera is not None or scene.shape[-1:] == (2,)):
        wrong = f"`points3d` has the shape {scene.shape}, not (n, 3)"
        if camera is not None:
            wrong = f"`points2d` has the shape {image.shape}; with a `camera` it holds pixels of shape (m, 2)"
        raise ValueError(f"{wrong} (are points2d and points3d swapped?)")
    check_points("points2d", image, (2, 3) if camera is None else (2,), fewest)
    check_points("points3d", scene, (3,), fewest)
    unit, (bearings, plane) = unit_of(image, camera), bearings_of(image, camera)
    usable = np.flatnonzero(np.isfinite(bearings).all(-1))
    check_seen(usable, image, fewest)
    in_pixels = camera if camera is not None and camera.focal >= LEAST_FOCAL else None
    measured = Measured.of(bearings if unit == "rad" else image, camera, plane)
    per_radian = measured.choose(usable).per_radian
    pose_prior = prior if isinstance(prior, (PosePrior, GravityPrior)) else None
    problem = Problem.of(
        bearings,
        scene,
        prior=pose_prior,
        network=prior if pose_prior is None else None,
        normals3d=checked_normals(normals3d, len(scene)),
        cosines3d=cosines3d,
        scores2d=checked_scores("scores2d", scores2d, len(image)),
        scores3d=checked_scores("scores3d", scores3d, len(scene)),
        floor=None if in_pixels is None else FLOOR_PIXELS / per_radian,
        radius=None if inlier_threshold is None else inlier_threshold / per_radian,
        focal=focal,
        measured=measured,
        **checked_labels(labels2d, labels3d, (len(image), len(scene))),
    )
    return problem.choose(usable)


def bearings_of(image: Array, camera: Camera | None) -> tuple[Array, Array]:
    """Return unit bearings (m, 3) of image points and their normalised coordinates (m, 2), NaN for points not in front.

    ValueError for pixels without a camera, or the reverse.
    """
    if image.shape[1] == 3:
        bearings = unit_bearings(image)
        return bearings, in_front(bearings)[:, :2]
    check_unit(image, camera)
    plane = image if camera is None else camera.normalise(image)
    check_view(plane, camera)
    rays = np.column_stack([plane, np.ones(len(plane))])
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), plane


def unit_of(image: Array, camera: Camera | None) -> Unit:
    """Return the unit in which the residuals of such image points are measured."""
    return "rad" if image.shape[1] == 3 else "normalised" if camera is None else "px"


def check_view(plane: Array, camera: Camera | None) -> None:
    """Raise ValueError if normalised image points (m, 2) lie far from the axis of a pinhole camera."""
    if camera is None or not is_pinhole(camera):
        return
    off = math.degrees(math.atan(float(np.median(np.linalg.norm(plane, axis=-1)))))
    if off > OFF_AXIS_DEG:
        raise ValueError(
            f"`points2d` lie {off:.0f} degrees from the axis of the `camera` (median), whose focal length is "
            f"{camera.focal:.4g} pixels; give the focal length and the points in the same unit"
        )


def check_seen(usable: Labels, image: Array, fewest: int) -> None:
    """Raise ValueError if too few of the 2D points are usable."""
    if len(usable) < fewest:
        raise ValueError(f"the camera can see {len(usable)} of {len(image)} 2D points; at least {fewest} are needed")
