"""The arguments of `solve` and `solve_many`, checked: each function raises ValueError for what is not usable.

`where` names the problem in the errors, where there are several.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from bpnp.cameras import CENTRE, Camera, is_opencv
from bpnp.search.starts import GravityPrior, PosePrior

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
Prior = PosePrior | GravityPrior | nn.Module  # a TrainedNet
ROUNDING = 1e-12  # of R R^T: a rotation in float64; others are made orthonormal
UNIT_NORM = 1e-3  # largest error of a length
UNIT_SUM = 1e-3  # largest error of a sum of probabilities
SURE = 0.8  # probability of a class from which a search matches a point to none of another one
WIDEST = 10.0  # half the points 84 degrees off the axis: these are pixels
INSIDE_ONE_PIXEL = 3.0
WIDEST_ROW = 8  # numbers of a keypoint; an array with more columns is the wrong way round


def source_from(solver: str | Path | nn.Module) -> nn.Module | None:
    """The module that solves, None for the search, alone or not."""
    if isinstance(solver, nn.Module):
        return solver
    if isinstance(solver, str) and solver in ("auto", "search"):
        return None
    from bpnp.models.weights import TrainedNet, pretrained_names  # the networks, where one is asked for

    path = Path(str(solver))
    if not isinstance(solver, (str, Path)) or not (path.suffix or path.is_file() or str(solver) in pretrained_names()):
        raise ValueError(
            f'expected `solver` "auto", "search", a module from Batch to Prediction, a checkpoint, or packaged weights '
            f"({', '.join(pretrained_names())}), got {solver!r}"
        )
    return TrainedNet.from_checkpoint(solver)


def device_from(wanted: str | torch.device | None) -> torch.device | None:
    """The device that a user names, if it can be used."""
    if wanted is None:
        return None
    try:
        device = torch.device(wanted)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"expected a `device` of this machine, got {wanted}: {str(error).splitlines()[0]}") from error
    return device


def each_set(name: str, values: Any, count: int | None, axes: int = 2) -> list[Any]:
    """The arrays of `count` problems, of `axes` axes each; one array, or None, is shared by all where that is known."""
    dims = getattr(values, "ndim", axes + 1)
    if count is not None and (values is None or dims == axes):
        return [values] * count
    if dims != axes + 1 or not hasattr(values, "__iter__"):
        got = f"{values!r:.60}" if dims == axes + 1 else f"shape {tuple(values.shape)}"
        raise ValueError(f"expected `{name}` as a sequence of arrays, one a problem, got {got}")
    arrays = list(values)
    if not arrays or len(arrays) != (count or len(arrays)):
        wanted = "one array a problem" if count is None else f"{count} arrays as in `points2d`"
        raise ValueError(f"expected {wanted} in `{name}`, got {len(arrays)}")
    return arrays


def each_of(name: str, value: Any, count: int) -> list[Any]:
    """A list has one each; anything else is for all problems."""
    if not isinstance(value, list):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"expected {count} of `{name}`, one a problem, got {len(value)}")
    return value


def each_camera(value: Any, count: int) -> list[Any]:
    """One camera for all, or a list or stack of them, as they are. A 3x3 matrix as a list of lists is one camera."""
    if getattr(value, "ndim", 2) == 3:
        value = list(value)
    elif isinstance(value, list) and value and not isinstance(value[0], tuple):
        rows = isinstance(value[0], str) or np.ndim(value[0]) == 1  # (model, parameters), or the rows of one matrix
        value = tuple(value) if rows else value
    return each_of("camera", value, count)


def positive(name: str, value: float | int | None, *, finite: bool = False) -> float | None:
    """The number as a float; None stays."""
    if value is not None and not (value > 0 and (value < math.inf or not finite)):
        raise ValueError(f"expected a positive `{name}`, got {value}")
    return None if value is None else float(value)


def checked_prior(prior: Any) -> Prior | None:
    """A prior with its numbers as float64 arrays, or a net: itself, of a checkpoint, or "learned", the packaged one."""
    if prior is None:
        return None
    if isinstance(prior, PosePrior):
        rotation, shift = checked_pose("prior.", prior.rotation, prior.translation)
        for name in ("rotation_sigma_deg", "translation_sigma"):
            positive(f"prior.{name}", getattr(prior, name))
        return prior._replace(rotation=rotation, translation=shift)
    if isinstance(prior, GravityPrior):
        camera, scene = (_vector(f"prior.{name}", getattr(prior, name), (3,)) for name in ("up_camera", "up_scene"))
        if not (camera.any() and scene.any() and prior.sigma_deg > 0):
            raise ValueError(f"expected directions and a positive sigma_deg in `prior`, got {prior}")
        return GravityPrior(camera, scene, prior.sigma_deg)
    from bpnp.models.weights import LEARNED, TrainedNet  # where a network is asked for

    if isinstance(prior, (str, Path)):
        return TrainedNet.from_pretrained(LEARNED) if str(prior) == "learned" else TrainedNet.from_checkpoint(prior)
    if isinstance(prior, TrainedNet):
        return prior
    raise ValueError(
        f"expected `prior` as PosePrior, GravityPrior, BPnPNet, Matcher, a checkpoint or 'learned', got {prior!r:.60}"
    )


def checked_pose(prefix: str, rotation: Any, translation: Any) -> tuple[Array, Any]:
    """A rotation (3, 3), orthonormal, and a translation (3,), None if that is None; `prefix` goes before their names.

    Raises ValueError for a matrix that is no rotation.
    """
    matrix = _vector(f"{prefix}rotation", rotation, (3, 3))
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(matrix) < 0:
        raise ValueError(f"expected a rotation in `{prefix}rotation`, R R^T = I and det R = 1, got {matrix.tolist()}")
    shift = None if translation is None else _vector(f"{prefix}translation", translation, (3,))
    return Rotation.from_matrix(matrix).as_matrix() if off > ROUNDING else matrix, shift


def _vector(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    array = numbers(name, values, "")
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite `{name}` of shape {shape}, got {array.tolist()}")
    return array


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


def pixels_from(values: Any, camera: Any) -> Any:
    """The pixels (m, 2) of a list of cv2.KeyPoint as their camera, as a user gives it, counts them; anything else as it
    is."""
    if not isinstance(values, (list, tuple)) or not len(values) or not all(hasattr(value, "pt") for value in values):
        return values
    return np.array([value.pt for value in values]) + (0.0 if camera is None or is_opencv(camera) else CENTRE)


def checked_size(image_size: Any) -> tuple[int, int]:
    """Width and height of images in pixels. Raises ValueError for anything else."""
    try:
        width, height = (int(side) for side in image_size)
        whole = (width, height) == tuple(image_size)
    except (TypeError, ValueError):
        whole = False
    if not whole or min(width, height) < 1:
        raise ValueError(f"expected `image_size` as (width, height) in whole pixels, got {image_size!r:.60}")
    return width, height


def check_inside(points2d: Any, size: Any) -> None:
    """Pixels (m, 2) within an image of this width and height, to a pixel."""
    pixels, sides = keypoints(points2d, ""), np.array(checked_size(size))
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"expected pixels `points2d` of shape (m, 2) with an `image_size`, got {pixels.shape}")
    outside = ~((pixels >= -1) & (pixels <= sides + 1) | ~np.isfinite(pixels)).all(-1)
    if outside.any():
        fits_swapped = (pixels <= sides[::-1] + 1).all()
        hint = "are width and height swapped?" if fits_swapped else "try the size of the image in which they are"
        raise ValueError(
            f"expected `points2d` inside the {sides[0]} x {sides[1]} pixels of `image_size`, got "
            f"{pixels[outside][0].round(1).tolist()}; {hint}"
        )


def keypoints(values: Any, where: str) -> Array:
    """Image points (m, 2) or (m, 3) from what detectors return: OpenCV's (m, 1, 2) arrays, and rows of four or more
    numbers that begin with x and y (scale, orientation, strength)."""
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


def normalised(points2d: Array, camera: Camera | None, where: str) -> Array:
    """Points (m, 2) on the normalised image plane, undistorted."""
    if camera is None:
        if np.median(np.linalg.norm(points2d, axis=-1)) > WIDEST:
            raise ValueError(
                f"expected normalised image coordinates without a `camera`{where}, got values up to "
                f"{np.abs(points2d).max():g}, which look like pixels; try camera=K"
            )
        return points2d
    if np.abs(points2d).max() < INSIDE_ONE_PIXEL and camera.focal > 100:
        raise ValueError(
            f"expected pixels with a `camera`{where}, got values up to {np.abs(points2d).max():g}, which look "
            "normalised; try without the camera"
        )
    return camera.normalise(points2d)


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


class KnownLabels(NamedTuple):
    """Labels as `PointSets` has them."""

    labels2d: Labels
    labels3d: Labels
    odds2d: Array | None = None
    classes3d: Array | None = None


def checked_labels(labels2d: Any, labels3d: Any, counts: tuple[int, int], where: str) -> KnownLabels | None:
    """Integer labels of the 2D and the 3D points, -1 for any, or probabilities (m, c), (n, c); both or neither.

    Of image point i with the probabilities p_i and scene point j with q_j, the appearance of i is likelier if they
    belong together than if not by sum_c p_ic q_jc / b_c, b the mean of the p_i, over its mean over j.
    """
    if labels2d is None and labels3d is None:
        return None
    for name, values in (("labels2d", labels2d), ("labels3d", labels3d)):
        if values is None:
            raise ValueError(f"expected both `labels2d` and `labels3d`, or neither{where}, got no `{name}`")
    if max(getattr(values, "ndim", 1) for values in (labels2d, labels3d)) < 2:
        known2d = _labels("labels2d", labels2d, counts[0], where)
        return KnownLabels(known2d, _labels("labels3d", labels3d, counts[1], where))
    image, scene = _classes("labels2d", labels2d, counts[0], where), _classes("labels3d", labels3d, counts[1], where)
    if image.shape[1] != scene.shape[1]:
        raise ValueError(
            f"expected as many classes in `labels2d` as in `labels3d`{where}, got {image.shape[1]} and {scene.shape[1]}"
        )
    odds = image / np.maximum(image.mean(0), 1e-12)
    odds /= np.maximum(odds @ scene.mean(0), 1e-12)[:, None]
    sure2d, sure3d = (np.where(each.max(1) >= SURE, each.argmax(1), -1) for each in (image, scene))
    return KnownLabels(sure2d, sure3d, odds, scene)


def _classes(name: str, values: Any, count: int, where: str) -> Array:
    """Probabilities (count, c) of classes."""
    shares = numbers(name, values, where)
    if shares.ndim != 2 or len(shares) != count:
        raise ValueError(
            f"expected probabilities in `{name}` of shape ({count}, c), as in the other one{where}, got {shares.shape}"
        )
    off = np.abs(shares.sum(1) - 1)
    bad = np.flatnonzero(~((shares >= 0).all(1) & (off <= UNIT_SUM)))
    if len(bad):
        raise ValueError(
            f"expected probabilities from 0 that add up to 1 in `{name}`{where}, got {shares[bad[0]].tolist()} at "
            f"point {bad[0]}; try softmax, or to divide by the sums"
        )
    return np.asarray(shares / shares.sum(1, keepdims=True))


def _labels(name: str, values: Any, count: int, where: str) -> Labels:
    values = values.detach().cpu() if isinstance(values, torch.Tensor) else values
    labels = _one_each(name, np.asarray(values), (count,), where)
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
