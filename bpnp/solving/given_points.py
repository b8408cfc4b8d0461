"""A user's arrays of points, checked: each function raises ValueError for unusable ones; `where` names the pair."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from bpnp.cameras import Camera
from bpnp.solving.annotations import UNIT_NORM

Array = npt.NDArray[np.float64]
WIDEST = 10.0  # half the points 84 degrees off the axis: these are pixels
INSIDE_ONE_PIXEL = 3.0

WIDEST_ROW = 8  # numbers of a keypoint; an array with more columns is the wrong way round


def numbers(name: str, values: Any, where: str) -> Array:
    """The values in float64."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().double().numpy() if not values.is_complex() else values.numpy()
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"{array.dtype}")
        return array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected `{name}` as an array of numbers{where}, got {values!r:.80}") from error


def keypoints(values: Any, where: str) -> Array:
    """Image points (m, 2) or (m, 3) from what detectors return: OpenCV's (m, 1, 2) arrays or lists of cv2.KeyPoint, and
    rows of four or more numbers that begin with x and y (scale, orientation, strength)."""
    if isinstance(values, (list, tuple)) and len(values) and all(hasattr(value, "pt") for value in values):
        values = [value.pt for value in values]
    points = one_row_each(numbers("points2d", values, where))
    return points[:, :2] if points.ndim == 2 and 3 < points.shape[1] <= WIDEST_ROW else points


def one_row_each(points: Array) -> Array:
    """(k, 1, d) as OpenCV has them, as (k, d)."""
    return points[:, 0] if points.ndim == 3 and points.shape[1] == 1 else points


def check_points(name: str, points: Array, widths: tuple[int, ...], fewest: int, where: str) -> None:
    """Points (k, width), k `fewest` or more, all finite."""
    if points.ndim != 2 or points.shape[1] not in widths:
        shapes = " or ".join(f"(k, {width})" for width in widths)
        swapped = points.ndim == 2 and points.shape[1] in (2, 3)
        hint = " (are points2d and points3d swapped?)" if swapped else "; try one row a point"
        raise ValueError(f"expected `{name}` of shape {shapes}{where}, got {points.shape}{hint}")
    if len(points) < fewest:
        raise ValueError(f"expected {fewest} or more points in `{name}`{where}, got {len(points)}: fewer fix no pose")
    bad = np.flatnonzero(~np.isfinite(points).all(-1))
    if len(bad):
        raise ValueError(f"expected finite `{name}`{where}, got {points[bad[0]].tolist()} at point {bad[0]}")


def unit_bearings(rays: Array, where: str) -> Array:
    """Bearings (m, 3) of length one, to rounding."""
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    if np.abs(length - 1).max() > UNIT_NORM:
        worst = float(length[np.abs(length - 1).argmax(), 0])
        raise ValueError(
            f"expected unit bearings in `points2d` of shape (m, 3){where}, got one of length {worst:g} (are points2d "
            "and points3d swapped?); try points2d of shape (m, 2), or to divide by the lengths"
        )
    return rays / length


def normalised(given: Array, camera: Camera | None, where: str) -> Array:
    """Points (m, 2) on the normalised image plane, undistorted."""
    if camera is None:
        if np.median(np.linalg.norm(given, axis=-1)) > WIDEST:
            raise ValueError(
                f"expected normalised image coordinates without a `camera`{where}, got values up to "
                f"{np.abs(given).max():g}, which look like pixels; try camera=K"
            )
        return given
    if np.abs(given).max() < INSIDE_ONE_PIXEL and camera.focal > 100:
        raise ValueError(
            f"expected pixels with a `camera`{where}, got values up to {np.abs(given).max():g}, which look normalised; "
            "try without the camera"
        )
    return camera.normalise(given)
