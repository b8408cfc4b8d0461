"""A user's arrays of points and of what is known of them, checked: each function raises ValueError for unusable ones.

`where` names the pair in the errors.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from bpnp.cameras import Camera

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
UNIT_NORM = 1e-3  # largest error of a length
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


def checked_normals(values: Any, count: int, where: str) -> Array | None:
    """Unit normals (n, 3) of `count` 3D points."""
    if values is None:
        return None
    normals = _one_each("normals3d", numbers("normals3d", values, where), (count, 3), where)
    length = np.linalg.norm(normals, axis=-1)
    bad = np.flatnonzero(~(np.abs(length - 1) <= UNIT_NORM))
    if len(bad):
        raise ValueError(
            f"expected unit vectors in `normals3d`{where}, got {normals[bad[0]].tolist()} at point {bad[0]}; "
            "try to divide by the lengths"
        )
    return np.asarray(normals / length[:, None])


def checked_labels(labels2d: Any, labels3d: Any, counts: tuple[int, int], where: str) -> tuple[Labels, Labels] | None:
    """Integer labels of the 2D and the 3D points, -1 for any; both or neither."""
    if labels2d is None and labels3d is None:
        return None
    for name, values in (("labels2d", labels2d), ("labels3d", labels3d)):
        if values is None:
            raise ValueError(f"expected both `labels2d` and `labels3d`, or neither{where}, got no `{name}`")
    return _labels("labels2d", labels2d, counts[0], where), _labels("labels3d", labels3d, counts[1], where)


def _labels(name: str, values: Any, count: int, where: str) -> Labels:
    host = values.detach().cpu() if isinstance(values, torch.Tensor) else values
    labels = _one_each(name, np.asarray(host), (count,), where)
    if labels.dtype.kind not in "iu":
        raise ValueError(f"expected integers in `{name}`{where}, got {labels.dtype}; try .astype(int)")
    if labels.min(initial=0) < -1:
        raise ValueError(f"expected labels of 0 or more, or -1 for any, in `{name}`{where}, got {labels.min()}")
    return labels.astype(np.int64)


def checked_scores(name: str, values: Any, count: int, where: str) -> Array | None:
    """Probabilities (count,) that a point has a partner, in (0, 1]."""
    if values is None:
        return None
    scores = _one_each(name, numbers(name, values, where), (count,), where)
    bad = np.flatnonzero(~((scores > 0) & (scores <= 1)))
    if len(bad):
        raise ValueError(
            f"expected probabilities above 0 and up to 1 in `{name}`{where}, got {scores[bad[0]]} at point {bad[0]}; "
            "try to divide by the largest"
        )
    return scores


def _one_each(name: str, values: npt.NDArray[Any], shape: tuple[int, ...], where: str) -> npt.NDArray[Any]:
    if values.shape != shape:
        raise ValueError(f"expected `{name}` of shape {shape} as `points{name[-2:]}`{where}, got {values.shape}")
    return values
