"""Checks of the arguments of `solve`, `solve_many` and `verify`; they raise ValueError for invalid values."""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat, TypeAlias, TypeGuard, Union

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.argument_types import PoseObject, array_shape, check_unmasked, short_repr
from bpnp.arrays import Array, Labels
from bpnp.cameras import CENTRE, Camera, check_normalised, is_calibration_matrix, is_opencv, outside_image
from bpnp.search.starts import GravityPrior, PosePrior

ROTATION_ROUNDING = 1e-12  # largest error of R R^T of a rotation; others are made orthonormal [1; numerics, float64]
UNIT_TOLERANCE = 1e-3  # largest error of a unit length, of a rotation, and of a sum of probabilities [1; convention]
SURE_CLASS = 0.97  # probability of a class from which on points match only within the class [probability; not tuned]
PRIOR_DEG = 10.0  # default standard deviation of a given rotation about each axis [degrees; convention]
LEAST_SIGMA_DEG = 1e-6  # least standard deviation of an angle of a prior [degrees; numerics, float64]
ONE_PIXEL = 3.0  # largest coordinate that is refused as normalised if a camera in pixels is given [pixels; convention]
VECTORS = ((3,), (3, 1), (1, 3))  # shapes of a vector; that of OpenCV is a column [1; convention, OpenCV]
WIDEST_ROW = 8  # largest number of columns of keypoints whose first two columns are positions [columns; convention]

if TYPE_CHECKING:
    import torch

    from bpnp.models.weights import TrainedNet

    PriorObject: TypeAlias = PosePrior | GravityPrior | PoseObject | TrainedNet | str | Path
    PriorLike: TypeAlias = PriorObject | Sequence[Sequence[SupportsFloat]]
    ManyPriors: TypeAlias = PriorObject | Sequence[PriorLike | Sequence[SupportsFloat] | None]
else:
    PriorLike = ManyPriors = Any

Prior = Union[PosePrior, GravityPrior, "torch.nn.Module"]  # a TrainedNet


@contextmanager
def about(problem: str | None) -> Iterator[None]:
    """Prefix the messages of errors in this context with the name of the problem, if there are several."""
    try:
        yield
    except ValueError as error:
        if problem is None:
            raise
        raise ValueError(f"{problem}: {error}") from error


def is_network(value: object) -> "TypeGuard[torch.nn.Module]":
    """Return True for a torch module; torch is not imported for this check."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.nn.Module)


def source_from(solver: "str | Path | torch.nn.Module") -> "torch.nn.Module | None":
    """Return the module of a `solver` argument; None for the search, with or without packaged matchers."""
    if is_network(solver):
        return solver
    if isinstance(solver, str) and solver in ("auto", "search"):
        return None
    from bpnp.models.weights import TrainedNet, pretrained_names  # imports torch, so only if a network is named

    path = Path(str(solver))
    if not isinstance(solver, (str, Path)) or not (path.suffix or path.is_file() or str(solver) in pretrained_names()):
        raise ValueError(
            f'`solver` is {solver!r}; it is "auto", "search", a checkpoint, the name of packaged weights '
            f"({', '.join(pretrained_names())}), or in Python a module from Batch to Prediction"
        )
    return TrainedNet.from_checkpoint(solver)


def device_from(wanted: "str | torch.device | None") -> "torch.device | None":
    """Return the torch device of a `device` argument, if it is available."""
    if wanted is None:
        return None
    import torch  # takes seconds, so only if a device is named

    try:
        device = torch.device(wanted)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"this machine has no `device` {wanted}: {str(error).splitlines()[0]}") from error
    return device


def each_set(name: str, values: Any, count: int | None, axes: int = 2) -> list[Any]:
    """Return the arrays of `count` problems; one array of `axes` axes, or None, is repeated if `count` is given."""
    dims = getattr(values, "ndim", axes + 1)
    if count is not None and (values is None or dims == axes):
        return [values] * count
    if dims != axes + 1 or not hasattr(values, "__iter__"):
        wrong = f"is {values!r:.60}" if dims == axes + 1 else f"has the shape {tuple(values.shape)}"
        raise ValueError(f"`{name}` {wrong}; a sequence of arrays is needed, one per problem")
    arrays = list(values)
    if not arrays:
        raise ValueError(f"`{name}` is empty; it holds one array per problem")
    return each_of(name, arrays, count or len(arrays))


def each_of(name: str, value: Any, count: int) -> list[Any]:
    """Return a list of `count` values: the list itself, or any other value repeated."""
    if not isinstance(value, list):
        return [value] * count
    if len(value) != count:
        raise ValueError(
            f"`{name}` has the length {len(value)}, but the number of problems is {count}; give one per problem"
        )
    return value


def each_camera(value: Any, count: int) -> list[Any]:
    """Return the cameras of `count` problems, unchanged, from one camera or a list or stack of cameras.

    A list of lists of numbers is one 3x3 matrix, and a list of numbers one [fx, fy, cx, cy].
    """
    return each_of("camera", cameras_from(value, count), count)


def cameras_from(value: Any, count: int) -> Any:
    """Return a list for several cameras, and anything else for one.

    Rows of four numbers are cameras (fx, fy, cx, cy) if there are `count` of them.
    """
    shape = array_shape(value)
    if not isinstance(value, tuple) and (len(shape) == 3 or shape == (count, 4)):
        return list(value)
    if not isinstance(value, list) or not value:
        return value
    first, row = value[0], array_shape(value[0])
    is_matrix = shape == (3, 3) or (len(row) == 1 and not isinstance(first, tuple))
    is_matrix = is_matrix and (row != (4,) or len(value) != count)
    is_parameters = isinstance(first, str) or (isinstance(first, SupportsFloat) and row == ())
    is_one_of_opencv = count == 1 and len(value) == 2 and is_opencv(tuple(value))  # [K, distortion]
    return tuple(value) if is_matrix or is_parameters or is_one_of_opencv else value


def split_distortion(camera: Any, distortion: Any) -> tuple[Any, bool]:
    """Return the camera, with OpenCV's coefficients if `distortion` holds them, and True if a coefficient is fitted."""
    if distortion is None or isinstance(distortion, (bool, np.bool_)):
        return camera, bool(distortion)
    if array_shape(distortion) == () and not isinstance(distortion, (list, tuple)):
        raise ValueError(
            f"`distortion` is {short_repr(distortion)}; it is True, False, or OpenCV's coefficients k1, k2, p1, p2[, "
            "k3[, k4, k5, k6]]"
        )
    coefficients = numbers("distortion", distortion)
    if coefficients.size not in coefficients.shape:  # no row or column
        raise ValueError(
            f"`distortion` has the shape {coefficients.shape}; it holds the coefficients of one camera; for several "
            "cameras give each as (K, distortion)"
        )
    if not is_calibration_matrix(camera):
        shown = "missing" if camera is None else short_repr(camera)
        raise ValueError(
            f"the coefficients in `distortion` need a 3x3 matrix K as `camera`, which is {shown}; for several cameras "
            "give each as (K, distortion)"
        )
    return (tuple(camera) if isinstance(camera, list) else camera, coefficients), False


def each_prior(value: Any, count: int) -> list[Any]:
    """Return the priors of `count` problems, unchanged, from one prior or a list of priors.

    A list of rows of four numbers is one matrix [R | t], and a list of a rotation and a translation is one pose.
    """
    size = len(value) if isinstance(value, list) else 0
    is_matrix = size in (3, 4) and all(_are_numbers(row, 4) for row in value)
    is_pose = size == 2 and array_shape(value[1]) in VECTORS
    return [value] * count if is_matrix or is_pose else each_of("prior", value, count)


def _are_numbers(values: Any, count: int) -> bool:
    """Return True for a sequence of `count` numbers; a PosePrior is also a tuple of four, but not of four numbers."""
    is_sequence = isinstance(values, (list, tuple)) or getattr(values, "ndim", 0) == 1
    return is_sequence and len(values) == count and all(np.ndim(value) == 0 for value in values)


def positive(name: str, value: Any, *, finite: bool = False) -> float | None:
    """Return a positive number as a float; None stays None."""
    if value is not None and not (_is_real(value) and value > 0 and (value < math.inf or not finite)):
        raise ValueError(f"`{name}` is {value!r}; it must be a positive number")
    return None if value is None else float(value)


def _is_real(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def seconds_from(time_limit: Any, default: float) -> float:
    """Return a time limit in seconds: None is the default of the function, math.inf no limit."""
    return positive("time_limit", time_limit) or default


def checked_clutter(clutter: Any) -> float | None:
    """Return an expected outlier fraction as a float; None stays None."""
    if clutter is None:
        return None
    if not (_is_real(clutter) and 0 <= clutter < 1):
        raise ValueError(f"`clutter` is {clutter!r}; it is a fraction of the points, 0 or more and below 1")
    return float(clutter)


def checked_seed(seed: Any) -> int:
    """Return a random seed; raise ValueError unless it is a non-negative integer."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"`seed` is {seed!r}; it is a whole number, 0 or more")
    return int(seed)


def pose_of(value: Any, name: str = "prior") -> tuple[Any, Any] | None:
    """Return rotation and translation of an object that holds a pose; None for anything else.

    It may be (R, t) or OpenCV's (rvec, tvec); [R | t] of shape (3, 4) or (4, 4); an object with `rotation` and
    `translation`, such as a `Solution`; or a pycolmap.Rigid3d. Messages use `name`.
    """
    if getattr(value, "found", True) is False:
        raise ValueError(f"`{name}` is a solution without a pose; give another pose, or leave it out")
    if callable(getattr(value, "matrix", None)):
        value = value.matrix()
    elif hasattr(value, "rotation") and hasattr(value, "translation"):
        return value.rotation, value.translation
    if isinstance(value, (tuple, list)) and len(value) == 2:
        return value[0], value[1]
    if array_shape(value) not in ((3, 4), (4, 4)):
        return None
    matrix = numbers(name, value)
    if len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"`{name}` has the last row {matrix[3].tolist()}; that of a pose is 0, 0, 0, 1")
    return matrix[:3, :3], matrix[:3, 3]


def checked_prior(prior: Any) -> Prior | None:
    """Return a prior with float64 arrays, or a network: the given one, a checkpoint's, or the packaged "learned"."""
    if prior is None:
        return None
    if not isinstance(prior, (PosePrior, GravityPrior)) and (pose := pose_of(prior)) is not None:
        prior = PosePrior(*pose, PRIOR_DEG)
    if isinstance(prior, PosePrior):
        rotation, shift = checked_pose("prior.", prior.rotation, prior.translation)
        return PosePrior(rotation, shift, _sigma(prior, "rotation_sigma_deg"), _sigma(prior, "translation_sigma"))
    if isinstance(prior, GravityPrior):
        camera, scene = (_finite(f"prior.{name}", getattr(prior, name), (3,)) for name in ("up_camera", "up_scene"))
        if not (camera.any() and scene.any()):
            raise ValueError(f"`prior` is {short_repr(prior)}; its directions must not be zero")
        camera, scene = (direction / np.abs(direction).max() for direction in (camera, scene))
        return GravityPrior(camera, scene, _sigma(prior, "sigma_deg"))
    from bpnp.models.weights import LEARNED, TrainedNet  # imports torch, so only if a network is named

    if isinstance(prior, (str, Path)):
        return TrainedNet.from_pretrained(LEARNED) if str(prior) == "learned" else TrainedNet.from_checkpoint(prior)
    if isinstance(prior, TrainedNet):
        return prior
    raise ValueError(
        f"`prior` is {short_repr(prior)}; give a PosePrior, a GravityPrior, a pose, a network or its checkpoint"
    )


def _sigma(prior: PosePrior | GravityPrior, name: str) -> float:
    """Return a standard deviation of a prior; one of 180 degrees and more tells nothing."""
    sigma = positive(f"prior.{name}", getattr(prior, name))
    if sigma is None:
        raise ValueError(f"`prior.{name}` is None; it must be a positive number")
    if name == "translation_sigma":  # in the unit of the scene, whose size is not known here
        return sigma
    if sigma < LEAST_SIGMA_DEG:
        least = f"{LEAST_SIGMA_DEG:g}"
        raise ValueError(f"`prior.{name}` is {sigma:g} degrees; give {least} or more, even where it is known exactly")
    return min(sigma, 180.0)


def checked_pose(prefix: str, rotation: Any, translation: Any) -> tuple[Array, Any]:
    """Return an orthonormal rotation (3, 3) and a translation (3,) or None; messages name them with `prefix`.

    The rotation is a matrix, a rotation vector, or an object of SciPy or pycolmap.
    """
    matrix = _rotation_matrix(f"{prefix}rotation", rotation)
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(matrix) < 0:
        raise ValueError(f"`{prefix}rotation` is no rotation matrix, R R^T = I and det R = 1: {matrix.tolist()}")
    shift = None if translation is None else _vector(f"{prefix}translation", translation)
    return Rotation.from_matrix(matrix).as_matrix() if off > ROTATION_ROUNDING else matrix, shift


def _rotation_matrix(name: str, value: Any) -> Array:
    """Return the rotation as a matrix (3, 3), which may not be orthonormal."""
    for method in ("as_matrix", "matrix"):  # SciPy's Rotation, pycolmap's Rotation3d
        if callable(getattr(value, method, None)):
            value = getattr(value, method)()
    if array_shape(value) in VECTORS:
        return Rotation.from_rotvec(_vector(name, value)).as_matrix()
    matrix = numbers(name, value)
    if matrix.shape == (4,):
        raise ValueError(
            f"`{name}` is {matrix.tolist()}; of a quaternion (x, y, z, w) give "
            "scipy.spatial.transform.Rotation.from_quat(...)"
        )
    return _finite(name, matrix, (3, 3))


def _vector(name: str, values: Any) -> Array:
    """Return finite numbers (3,), also of OpenCV's column (3, 1)."""
    array = numbers(name, values)
    return _finite(name, array.ravel() if array.shape in VECTORS else array, (3,))


def numbers(name: str, values: Any) -> Array:
    """Return the values as a float64 array."""
    check_unmasked(name, values)
    try:
        values = _on_host(values)
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"{array.dtype}")
        return array.astype(np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`{name}` is {short_repr(values)}; an array of numbers is needed") from error


def _on_host(values: Any) -> Any:
    """Return a torch tensor as a NumPy array, and any other value unchanged."""
    if not hasattr(values, "detach"):
        return values
    tensor = values.detach().cpu()
    return (tensor.double() if tensor.is_floating_point() else tensor).numpy()  # NumPy has no bfloat16


def _finite(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    array = numbers(name, values)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"`{name}` is {array.tolist()}; finite numbers of shape {shape} are needed")
    return array


def pixels_from(values: Any, camera: Any, image_size: Any = None) -> Any:
    """Return the pixels (m, 2) of a list of cv2.KeyPoint in the convention of their camera; other values unchanged.

    They are shifted by half a pixel, from the convention of OpenCV to that of COLMAP, if the camera has this one or
    only the `image_size` is known.
    """
    if not isinstance(values, (list, tuple)) or not len(values) or not all(hasattr(value, "pt") for value in values):
        return values
    unshifted = image_size is None if camera is None else is_opencv(camera)
    return np.array([value.pt for value in values]) + (0.0 if unshifted else CENTRE)


def checked_size(image_size: Any) -> tuple[int, int]:
    """Return (width, height) of images, pixels."""
    try:
        width, height = (int(side) for side in image_size)
        whole = (width, height) == tuple(image_size)
    except (TypeError, ValueError):
        whole = False
    if not whole or min(width, height) < 1:
        raise ValueError(f"`image_size` is {image_size!r:.60}; it is (width, height) in whole pixels")
    return width, height


def check_inside(points2d: Any, size: Any) -> None:
    """Raise ValueError if pixels (m, 2) have a wrong shape, or if `outside_image` finds some; NaN is ignored."""
    pixels, sides = image_points(points2d), np.array(checked_size(size))
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(
            f"`points2d` has the shape {pixels.shape}; with an `image_size` it holds pixels of shape (m, 2)"
        )
    outside = outside_image(pixels, sides)
    if outside.any():
        fits_swapped = not outside_image(pixels, sides[::-1]).any()
        hint = "are width and height swapped?" if fits_swapped else "give the size of the image in which they are"
        raise ValueError(
            f"{int(outside.sum())} of {len(pixels)} `points2d` are outside the {sides[0]} x {sides[1]} pixels of "
            f"`image_size`, such as {pixels[outside][0].round(1).tolist()}; {hint}"
        )


def image_points(values: Any) -> Array:
    """Return image points (m, 2) or (m, 3) from the output of detectors.

    OpenCV's (m, 1, 2) arrays are accepted, and rows of four or more numbers that begin with x and y (scale,
    orientation, strength).
    """
    points = scene_points(values, "points2d")
    return points[:, :2] if points.ndim == 2 and 3 < points.shape[1] <= WIDEST_ROW else points


def scene_points(values: Any, name: str = "points3d") -> Array:
    """Return points (k, d) from arrays, OpenCV's (k, 1, d), or clouds and meshes of trimesh and Open3D."""
    if not hasattr(values, "__array__"):
        values = getattr(values, "vertices", getattr(values, "points", values))
    points = numbers(name, values)
    return points[:, 0] if points.ndim == 3 and points.shape[1] == 1 else points


def check_points(name: str, points: Array, widths: tuple[int, ...], fewest: int) -> None:
    """Check that points have shape (k, width), with k at least `fewest`, and are finite."""
    if points.ndim != 2 or points.shape[1] not in widths:
        shapes = " or ".join(f"(k, {width})" for width in widths)
        swapped = points.ndim == 2 and points.shape[1] in (2, 3)
        hint = " (are points2d and points3d swapped?)" if swapped else "; give one row per point"
        raise ValueError(f"`{name}` has the shape {points.shape}, not {shapes}{hint}")
    if len(points) < fewest:
        raise ValueError(f"`{name}` has {len(points)} points; at least {fewest} are needed")
    _check_rows(name, points, np.isfinite(points).all(-1), "all numbers must be finite")


def _check_rows(name: str, rows: Array, good: Any, requirement: str) -> None:
    """Raise ValueError with the first invalid row, and what is required of all."""
    if not good.all():
        bad = int(good.argmin())
        raise ValueError(f"`{name}` is {rows[bad].tolist()} at point {bad}; {requirement}")


def unit_bearings(rays: Array) -> Array:
    """Return bearings (m, 3), normalised; raise ValueError if a length is off by more than `UNIT_TOLERANCE`."""
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    if np.abs(length - 1).max() > UNIT_TOLERANCE:
        worst = float(length[np.abs(length - 1).argmax(), 0])
        raise ValueError(
            f"`points2d` of shape (m, 3) are unit bearings, but one has the length {worst:g} (are points2d and "
            "points3d swapped?); divide bearings by their lengths, or give points2d of shape (m, 2)"
        )
    return rays / length


def check_unit(points2d: Array, camera: Camera | None) -> None:
    """Raise ValueError for pixels without a camera, or for normalised coordinates with one."""
    largest = np.abs(points2d).max()
    if camera is None:
        check_normalised(points2d, "camera=K, or image_size=(width, height) if the focal length is unknown")
    if camera is not None and largest < ONE_PIXEL and camera.focal > 100:
        raise ValueError(
            f"`points2d` has values up to {largest:g}, which look normalised; give pixels with a `camera`, or leave "
            "the camera out"
        )


def unit_vectors(name: str, vectors: Array, hint: str = "divide by the lengths") -> Array:
    """Return vectors (n, 3), normalised; raise ValueError if a length is off by more than `UNIT_TOLERANCE`."""
    length = np.linalg.norm(vectors, axis=-1)
    _check_rows(name, vectors, np.abs(length - 1) <= UNIT_TOLERANCE, f"unit vectors are needed: {hint}")
    return np.asarray(vectors / length[:, None])


def checked_normals(values: Any, count: int) -> Array | None:
    """Return the unit normals (n, 3) of `count` 3D points."""
    if values is None:
        return None
    return unit_vectors("normals3d", _one_each("normals3d", numbers("normals3d", values), (count, 3)))


def checked_labels(labels2d: Any, labels3d: Any, counts: tuple[int, int]) -> dict[str, Any]:
    """Return the labels as fields of `Problem`: integers, with -1 for any, or probabilities (m, c) and (n, c).

    Both sets of points have labels, or neither. For image point i with probabilities p_i and scene point j with q_j,
    the likelihood ratio of the appearance, match against non-match, is sum_c p_ic q_jc / b_c over its mean over j. Here
    b is the mean of the p_i.
    """
    labels = {"labels2d": labels2d, "labels3d": labels3d}
    missing = [name for name, values in labels.items() if values is None]
    if len(missing) == 2:
        return {}
    if missing:
        raise ValueError(f"`{missing[0]}` is missing; give both `labels2d` and `labels3d`, or neither")
    if all(np.ndim(values) < 2 for values in labels.values()):
        integers = [_integers(name, labels[name], count) for name, count in zip(labels, counts, strict=True)]
        return dict(zip(labels, compact_labels(*integers), strict=True))
    image, scene = (_classes(name, labels[name], count) for name, count in zip(labels, counts, strict=True))
    if image.shape[1] != scene.shape[1]:
        raise ValueError(
            f"`labels2d` has {image.shape[1]} classes and `labels3d` {scene.shape[1]}; both need the same classes"
        )
    odds = image / np.maximum(image.mean(0), 1e-12)
    odds /= np.maximum(odds @ scene.mean(0), 1e-12)[:, None]
    sure = [np.where(shares.max(1) >= SURE_CLASS, shares.argmax(1), -1) for shares in (image, scene)]
    return {"labels2d": sure[0], "labels3d": sure[1], "odds2d": odds, "classes3d": scene}


def compact_labels(labels2d: Labels, labels3d: Labels) -> tuple[Labels, Labels]:
    """Number labels (m,) and (n,), any integers, by their order in the scene, from 0 to the number k of those in it.

    An image point whose label no scene point has gets k; -1, which matches any, stays. The numbers of scene points do
    not depend on the image.

    >>> [labels.tolist() for labels in compact_labels(np.array([-1, 2**40, 9, 3]), np.array([9, -1, 2**40]))]
    [[-1, 1, 0, 2], [0, -1, 1]]
    """
    values = np.unique(labels3d[labels3d >= 0])
    places = [np.searchsorted(values, side) for side in (labels2d, labels3d)]
    is_shared = np.isin(labels2d, values)
    image = np.where(labels2d < 0, -1, np.where(is_shared, places[0], len(values)))
    return image.astype(np.int64), np.where(labels3d < 0, -1, places[1]).astype(np.int64)


def _classes(name: str, values: Any, count: int) -> Array:
    """Return class probabilities (count, c)."""
    shares = numbers(name, values)
    if shares.ndim != 2 or len(shares) != count:
        raise ValueError(
            f"`{name}` has the shape {shares.shape}; it needs class probabilities of shape ({count}, c), as the other "
            "labels"
        )
    good = (shares >= 0).all(1) & (np.abs(shares.sum(1) - 1) <= UNIT_TOLERANCE)
    _check_rows(name, shares, good, "probabilities are 0 or more and add up to 1: use softmax, or divide by the sums")
    return np.asarray(shares / shares.sum(1, keepdims=True))


def _integers(name: str, values: Any, count: int) -> Labels:
    check_unmasked(name, values)
    labels = _one_each(name, np.asarray(_on_host(values)), (count,))
    if labels.dtype.kind not in "iu":
        raise ValueError(f"`{name}` has the type {labels.dtype}; labels are integers: use .astype(int)")
    if labels.min(initial=0) < -1:
        raise ValueError(f"`{name}` has the label {labels.min()}; labels are 0 or more, or -1 for any")
    if labels.max(initial=0) > np.iinfo(np.int64).max:  # these would wrap to negative ones
        raise ValueError(f"`{name}` has the label {labels.max()}; labels are below 2^63: number them from 0")
    return labels.astype(np.int64)


def checked_scores(name: str, values: Any, count: int) -> Array | None:
    """Return the probabilities (count,) that a point has a correspondence, over the largest; None stays None.

    Only their ratios matter, and float32 has no numbers below 1e-45.
    """
    if values is None:
        return None
    scores = _one_each(name, numbers(name, values), (count,))
    good = (scores > 0) & (scores <= 1)
    _check_rows(name, scores, good, "scores are above 0 and at most 1: divide by the largest")
    return scores / scores.max(initial=0)


def _one_each(name: str, values: npt.NDArray[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    if values.shape != shape:
        raise ValueError(f"`{name}` has the shape {values.shape}, not {shape} for these `points{name[-2:]}`")
    return values
