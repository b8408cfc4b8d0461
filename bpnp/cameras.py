"""Camera models: pixels to normalised image coordinates and back, distortion included.

Only `import_pycolmap` imports pycolmap, when a camera first needs it: the import takes half a second.
"""

import signal
import threading

# Import zlib before pycolmap 4.2: in the other order zlib.compress and np.savez_compressed abort Python.
import zlib  # noqa: F401
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, SupportsFloat, TypeAlias

import numpy as np
import numpy.typing as npt

from bpnp.argument_types import ArrayLike, HasArray, HasCameraModel, Numbers, array_shape, short_repr
from bpnp.arrays import Array

ROUND_TRIP = 0.01  # largest error of a pixel that is undistorted and distorted again, pixels
# Models whose image radius at the angle t from the axis is t (1 + k1 t^2 + ...): number of focal lengths and of k.
FISHEYE = {
    "SIMPLE_FISHEYE": (1, 0),
    "FISHEYE": (2, 0),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
    "OPENCV_FISHEYE": (2, 4),
}
# Models whose image radius at the radius r in the plane z = 1 is r (1 + k1 r^2 + ...) / (1 + k4 r^2 + ...), but for
# tangential distortion: indices of the parameters k1, k2, ... above and below.
RADIAL: dict[str, tuple[list[int], list[int]]] = {
    "SIMPLE_RADIAL": ([3], []),
    "RADIAL": ([3, 4], []),
    "OPENCV": ([4, 5], []),
    "FULL_OPENCV": ([4, 5, 8], [9, 10, 11]),
}
# Models whose image radius at the angle t from the axis is t (1 + k1 t^2 + ...), but for tangential and thin-prism
# distortion, and which see no point at 90 degrees or beyond: indices of the parameters k1, k2, ...
NARROW_FISHEYE = {"THIN_PRISM_FISHEYE": [4, 5, 8, 9], "RAD_TAN_THIN_PRISM_FISHEYE": [4, 5, 6, 7, 8, 9]}
CENTRE = 0.5  # centre of the first pixel in COLMAP's coordinates; it is 0 in OpenCV's and hloc's
SLACK, FEW_OUTSIDE = 0.01, 0.02  # margin around an image in larger sides; fraction of points allowed beyond it
WIDEST = 10.0  # normalised image coordinates; 84 degrees off the axis
MOST_PIXELS = 2**31  # largest side of an image, pixels; a larger one means a corrupt file


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Camera without distortion, pixels ~ K (x, y, 1)."""

    matrix: Array  # K (3, 3), pixels

    @property
    def focal(self) -> float:
        """Focal length in pixels: the mean of both axes."""
        return float(np.abs(np.diag(self.matrix)[:2]).mean())

    def normalise(self, pixels: Array) -> Array:
        """Convert pixels (k, 2) to normalised image coordinates (k, 2)."""
        return np.asarray((pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T, np.float64)

    def project(self, points: Array) -> Array:
        """Project points (k, 3) in camera coordinates to pixels (k, 2); NaN unless z > 0."""
        return in_front(points) @ self.matrix[:2].T


class _Fisheye(NamedTuple):
    """A fisheye, which sees the angle t from its axis at the radius t (1 + k1 t^2 + ...), in focal lengths."""

    focals: Array  # (1,) or (2,) focal lengths, pixels
    centre: Array  # (2,) principal point, pixels
    distance: np.polynomial.Polynomial  # radius as a polynomial of the angle
    widest: float  # angle up to which the radius rises (first root of its derivative), radians; at most 180 degrees


@dataclass(frozen=True, eq=False)
class Lens:
    """Camera of any COLMAP model, with its distortion."""

    camera: Any  # `pycolmap.Camera`

    @property
    def focal(self) -> float:
        """Focal length in pixels: the mean of both axes, as in pycolmap.

        For a model without focal length (equirectangular) it is the scale at the principal ray.
        """
        if len(self.camera.focal_length_idxs()):
            return float(self.camera.mean_focal_length())
        step = 1e-4
        axis, off_axis = self.camera.img_from_cam(np.array([[0.0, 0.0, 1.0], [step, 0.0, 1.0]]))
        return float(np.linalg.norm(off_axis - axis) / step)

    @property
    def matrix(self) -> Array:
        """K (3, 3) of the undistorted image, pixels."""
        if len(self.camera.focal_length_idxs()):
            return np.asarray(self.camera.calibration_matrix(), np.float64)
        ((x, y),) = self.camera.img_from_cam(np.array([[0.0, 0.0, 1.0]]))
        return np.array([[self.focal, 0, x], [0, self.focal, y], [0, 0, 1]])

    def normalise(self, pixels: Array) -> Array:
        """Convert pixels (k, 2) to normalised, undistorted image coordinates (k, 2); NaN where there are none.

        pycolmap marks some failures with NaN, and returns a wrong finite point for others (a fisheye beyond 90
        degrees). Therefore the result is projected back and has to meet the pixel.
        """
        points = np.asarray(self.camera.cam_from_img(np.ascontiguousarray(pixels)), dtype=np.float64)
        back = np.asarray(self.camera.img_from_cam(np.column_stack([points, np.ones(len(points))])), dtype=np.float64)
        with np.errstate(invalid="ignore"):
            good = np.linalg.norm(back - pixels, axis=-1) < ROUND_TRIP
        return np.where(good[:, None], points, np.nan)

    def project(self, points: Array) -> Array:
        """Project points (k, 3) in camera coordinates to pixels (k, 2); NaN unless z > 0.

        A fisheye also projects points with z <= 0. Points beyond the angle at which the image radius stops rising are
        NaN, since the polynomial of the model would fold them back into the image.
        """
        if (fisheye := self._fisheye) is None:
            plane = in_front(points)
            widest = _widest_radius(self.camera.model.name, tuple(self.camera.params))
            plane[np.linalg.norm(plane[:, :2], axis=-1) > widest] = np.nan
            return np.asarray(self.camera.img_from_cam(np.ascontiguousarray(plane)), dtype=np.float64)
        across = np.linalg.norm(points[:, :2], axis=-1)
        angle = np.arctan2(across, points[:, 2])
        radius = np.where((angle < fisheye.widest) & (points != 0).any(-1), fisheye.distance(angle), np.nan)
        outwards = points[:, :2] / np.maximum(across, np.finfo(float).tiny)[:, None]
        return np.asarray(fisheye.centre + fisheye.focals * radius[:, None] * outwards)

    @property
    def _fisheye(self) -> _Fisheye | None:
        """Parameters of a fisheye; None for another model."""
        name, params = self.camera.model.name, np.asarray(self.camera.params, np.float64)
        if name not in FISHEYE:
            return None
        focals, count = FISHEYE[name]
        distance = _odd_polynomial(params[focals + 2 : focals + 2 + count])
        widest = min(np.pi, _first_root(distance.deriv()))
        return _Fisheye(params[:focals], params[focals : focals + 2], distance, widest)


Camera = Pinhole | Lens
if TYPE_CHECKING:  # what `camera_from` converts, which checks it at run time
    CameraObject: TypeAlias = (
        HasArray
        | tuple[ArrayLike, ArrayLike | None]
        | tuple[SupportsFloat, SupportsFloat, SupportsFloat, SupportsFloat]
        | tuple[str, Numbers]
        | tuple[str, int, int, Numbers]
        | Mapping[str, Any]
        | HasCameraModel
        | Camera
    )
    CameraLike: TypeAlias = CameraObject | Sequence[SupportsFloat | Sequence[SupportsFloat]]
    ManyCameras: TypeAlias = CameraObject | Sequence[CameraLike | SupportsFloat | None]
else:
    CameraLike = ManyCameras = Any


@lru_cache
def _widest_radius(model: str, params: tuple[float, ...]) -> float:
    """Return the radius in the plane z = 1 up to which the image radius rises, infinity for other models."""
    if model in NARROW_FISHEYE:
        angle = _first_root(_odd_polynomial([params[i] for i in NARROW_FISHEYE[model]]).deriv())
        return float(np.tan(angle)) if angle < np.pi / 2 else np.inf
    above, below = RADIAL.get(model, ([], []))
    even = np.zeros(2 * len(below) + 1)
    even[::2] = [1.0, *(params[i] for i in below)]
    numerator, denominator = _odd_polynomial([params[i] for i in above]), np.polynomial.Polynomial(even)
    slope = numerator.deriv() * denominator - numerator * denominator.deriv()
    return _first_root(slope * denominator)


def _odd_polynomial(coefficients: Sequence[float] | Array) -> np.polynomial.Polynomial:
    """Return x (1 + k1 x^2 + k2 x^4 + ...) for coefficients k1, k2, ..."""
    odd = np.zeros(2 * len(coefficients) + 2)
    odd[1::2] = [1.0, *coefficients]
    return np.polynomial.Polynomial(odd).trim()


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """Return the first positive root of a polynomial, infinity if it has none."""
    roots = polynomial.trim().roots()
    return float(min(roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)], default=np.inf))


def in_front(points: Array) -> Array:
    """Return (x/z, y/z, 1) of points (k, 3) with z > 0, and NaN for the others."""
    depth = np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
    with np.errstate(over="ignore"):
        return points / depth


def camera_from(camera: Any) -> Camera:
    """Convert a description of a camera to a `Pinhole` for K without distortion, else to a `Lens`.

    It is one of: a 3x3 matrix K; its numbers (fx, fy, cx, cy); OpenCV's (K, distortion); (COLMAP model name,
    parameters); (name, width, height, parameters); a mapping with `model` and `params`, and optionally `width` and
    `height`; a `pycolmap.Camera`; a `Camera`, which is returned unchanged. Raise ValueError if K is singular or not
    finite, the model is unknown, the number of parameters is wrong, or the focal length is not positive.

    >>> from bpnp.cameras import camera_from
    >>> camera_from(("PINHOLE", 640, 480, [800, 800, 320, 240])).focal
    800.0
    """
    if isinstance(camera, (Pinhole, Lens)):
        return camera
    if hasattr(camera, "cam_from_img") and hasattr(camera, "img_from_cam"):
        return _check_focal_length(Lens(camera), f"{camera.params}")
    if isinstance(camera, Mapping):
        if not {"model", "params"} <= set(camera):
            raise ValueError(f"`camera` needs the keys `model` and `params`; it has {', '.join(camera) or 'no keys'}")
        size = (camera.get("width") or 0, camera.get("height") or 0)
        return colmap_camera(str(camera["model"]), camera["params"], size)
    if isinstance(camera, (tuple, list)) and len(camera) and isinstance(camera[0], str):
        if len(camera) not in (2, 4):
            raise ValueError(
                f"`camera` has {len(camera)} values; give (model, parameters) or (model, width, height, parameters)"
            )
        return colmap_camera(camera[0], camera[-1], camera[1:-1] or (0, 0))
    return _opencv(*camera) if is_opencv(camera) else _pinhole(camera)


def is_opencv(camera: Any) -> bool:
    """Return True for OpenCV's (K, distortion), whose pixel (0, 0) is the centre of the first pixel."""
    return isinstance(camera, tuple) and len(camera) == 2 and is_calibration_matrix(camera[0])


def is_calibration_matrix(camera: Any) -> bool:
    """Return True for a 3x3 matrix K, or its numbers (fx, fy, cx, cy)."""
    return array_shape(camera) in ((3, 3), (4,))


def image_size(camera: Camera) -> tuple[int, int] | None:
    """Return the width and height of a camera's images in pixels, or None; only one of a COLMAP model has a size."""
    size = (camera.camera.width, camera.camera.height) if isinstance(camera, Lens) else (0, 0)
    return size if all(size) else None


def check_centre(camera: Camera, size: tuple[int, int]) -> None:
    """Raise ValueError if the principal point is not in the middle third of images of a size: it is that of others."""
    centre, half = camera.matrix[:2, 2], np.array(size) / 2
    if (np.abs(centre - half) > half / 3).any():
        x, y = centre.tolist()
        raise ValueError(
            f"`camera` has its principal point at ({x:g}, {y:g}), far from the centre of an image of {size[0]} x "
            f"{size[1]} pixels; if the image was resized, multiply the first two rows of K by the same factor"
        )


def same_aspect_ratio(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return True if two image sizes have the same aspect ratio, up to a pixel of rounding a side."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def check_normalised(points2d: Any, remedy: str) -> None:
    """Raise ValueError if finite image points (m, 2) are pixels: half of them lie more than 84 degrees off the axis.

    `remedy` is the proposal of the message, after "try".
    """
    points = np.asarray(points2d)
    if np.median(np.linalg.norm(points, axis=-1)) > WIDEST:
        raise ValueError(
            f"`points2d` has values up to {np.abs(points).max():g}, not normalised image coordinates; they look like "
            f"pixels; try {remedy}"
        )


def outside_image(pixels: Array, sides: Any) -> npt.NDArray[np.bool_]:
    """Return which pixels (m, 2) show that an image has another size; none if they are no more than 2 %.

    Detectors place some keypoints slightly outside of an image. Allowed are all points within a hundredth of the larger
    side (at least one pixel) of the image, and up to 2 % of the points farther away. NaN counts as inside. `sides` are
    width and height in pixels.

    >>> import numpy as np
    >>> from bpnp.cameras import outside_image
    >>> outside_image(np.array([[101.8, 20.0], [50, 50], [10, 20]]), (100, 100)).tolist()
    [True, False, False]
    """
    sides = np.asarray(sides, np.float64)
    slack = max(SLACK * float(sides.max()), 1.0)
    outside = ((pixels < -slack) | (pixels > sides + slack)).any(-1)
    return np.asarray(outside & (outside.sum() > FEW_OUTSIDE * len(outside)))


def resize_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera of resized images, whose width and height are in pixels.

    Raise ValueError if the image size of the camera is unknown, or the aspect ratios differ.

    >>> from bpnp.cameras import camera_from, resize_camera
    >>> resize_camera(camera_from(("PINHOLE", 1000, 800, [900, 880, 500, 400])), (500, 400)).matrix.tolist()
    [[450.0, 0.0, 250.0], [0.0, 440.0, 200.0], [0.0, 0.0, 1.0]]
    """
    full_size = image_size(camera)
    if full_size is None:
        raise ValueError("a camera without an image size cannot be scaled; give its width and height")
    if not same_aspect_ratio(full_size, size):
        sides = " x ".join(map(str, full_size))
        raise ValueError(f"a camera of {sides} pixels cannot be scaled to {size[0]} x {size[1]}, another aspect ratio")
    if full_size == size:
        return camera
    scaled = camera_from(camera_to_json(camera))
    assert isinstance(scaled, Lens)
    scaled.camera.rescale(*size)
    return scaled


def scale_focal_length(camera: Camera, zoom: float) -> Camera:
    """Return the camera with its focal length multiplied by a factor.

    >>> from bpnp.cameras import camera_from, scale_focal_length
    >>> scale_focal_length(camera_from(("SIMPLE_RADIAL", 1000, 800, [900, 500, 400, 0.1])), 2.0).focal
    1800.0
    """
    if isinstance(camera, Pinhole):
        return Pinhole(camera.matrix * [[zoom, zoom, 1.0], [zoom, zoom, 1.0], [1.0, 1.0, 1.0]])
    scaled = camera_from(camera_to_json(camera))
    assert isinstance(scaled, Lens)
    params = scaled.camera.params
    params[list(scaled.camera.focal_length_idxs())] *= zoom
    scaled.camera.params = params
    return scaled


def is_pinhole(camera: Camera) -> bool:
    """Return True for a pinhole camera without skew, to which `with_radial_distortion` can add distortion."""
    if isinstance(camera, Pinhole):
        return bool(camera.matrix[0, 1] == camera.matrix[1, 0] == 0)
    return camera.camera.model.name in ("SIMPLE_PINHOLE", "PINHOLE")


def with_radial_distortion(camera: Camera, radial: float) -> Lens:
    """Add the coefficient k1 of the squared radius to a pinhole camera without skew.

    The result is a SIMPLE_RADIAL camera, or an OPENCV camera for two different focal lengths.

    >>> from bpnp.cameras import camera_from, with_radial_distortion
    >>> with_radial_distortion(camera_from(("SIMPLE_PINHOLE", 1000, 800, [900, 500, 400])), 0.1).camera.params.tolist()
    [900.0, 500.0, 400.0, 0.1]
    """
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    size = image_size(camera) or (0, 0)
    if fx == fy:
        return colmap_camera("SIMPLE_RADIAL", [fx, cx, cy, radial], size)
    return colmap_camera("OPENCV", [fx, fy, cx, cy, radial, 0.0, 0.0, 0.0], size)


def camera_to_json(camera: Camera) -> list[list[float]] | dict[str, Any]:
    """Return a camera in a form that JSON can hold and `camera_from` reads; an unknown width or height is None."""
    if isinstance(camera, Pinhole):
        return camera.matrix.tolist()
    lens = camera.camera
    size = {"width": lens.width or None, "height": lens.height or None}
    return {"model": lens.model.name, **size, "params": lens.params.tolist()}


def colmap_camera(model: str, params: Any, size: Any = (0, 0)) -> Lens:
    """Return the camera of a COLMAP model, such as "PINHOLE", for parameters in COLMAP's order.

    The size is the width and height of the images in pixels, 0 if unknown. Errors are those of `camera_from`.
    """
    counts = dict(camera_models().values())
    if model not in counts:
        raise ValueError(f"{model!r} is no COLMAP camera model; the models are {', '.join(counts)}")
    try:
        values = np.asarray(params, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the parameters of a {model} camera are not numbers: {short_repr(params)}") from error
    if values.shape != (counts[model],):
        raise ValueError(f"a {model} camera has {counts[model]} parameters, not {values.tolist()}")
    if not np.isfinite(values).all():
        raise ValueError(f"the parameters of a {model} camera hold NaN or infinity: {values.tolist()}")
    try:
        width, height = (int(value) for value in size)
    except (TypeError, ValueError, OverflowError):
        width, height = -1, -1
    if min(width, height) < 0 or max(width, height) > MOST_PIXELS:
        raise ValueError(f"width and height of a {model} camera cannot be {tuple(size)} pixels")
    lens = Lens(import_pycolmap().Camera(model=model, width=width, height=height, params=values.tolist()))
    return _check_focal_length(lens, f"{values.tolist()}")


def read_text_model(folder: Path) -> Any:
    """Read a folder with cameras.txt, images.txt and points3D.txt as a `pycolmap.Reconstruction`.

    Raise ValueError, with its reason, if pycolmap cannot read the files.
    """
    model = import_pycolmap().Reconstruction()
    try:
        model.read_text(str(folder))
    except (ValueError, IndexError, RuntimeError) as error:
        raise ValueError(str(error)) from error
    return model


@cache
def camera_models() -> Mapping[int, tuple[str, int]]:
    """Return the name and the number of parameters of each COLMAP camera model, by its id."""
    pycolmap = import_pycolmap()
    return {
        int(model): (name, len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params))
        for name, model in pycolmap.CameraModelId.__members__.items()
        if model != pycolmap.CameraModelId.INVALID
    }


@cache
def import_pycolmap() -> Any:
    """Return the module pycolmap, imported after zlib and without its handler of SIGTERM."""
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        # Restore the SIGTERM handler, which pycolmap replaces by one that prints a stack trace.
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def _check_focal_length(lens: Lens, shown: str) -> Lens:
    focal = min([lens.focal, *np.asarray(lens.camera.params)[list(lens.camera.focal_length_idxs())].tolist()])
    if not focal > 0:
        raise ValueError(f"the focal length of a camera has to be positive; the parameters {shown} give {focal}")
    return lens


def _opencv(matrix: Any, distortion: Any) -> Camera:
    """Return the camera of OpenCV's matrix and coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]]."""
    model, params = opencv_model(matrix, distortion)
    return _pinhole(matrix) if model == "PINHOLE" else colmap_camera(model, params)


def opencv_model(matrix: Any, distortion: Any) -> tuple[str, list[float]]:
    """Return the COLMAP model of an OpenCV camera and its parameters; PINHOLE, without the skew, if all are 0.

    The distortion is k1, k2, p1, p2[, k3[, k4, k5, k6]], or None. Errors are those of `camera_from`.
    """
    pinhole = _pinhole(matrix)
    (fx, skew, cx), (_, fy, cy), _ = pinhole.matrix.tolist()
    values = np.asarray([] if distortion is None else distortion, np.float64).ravel()
    if len(values) not in (0, 4, 5, 8) and (len(values) not in (12, 14) or values[8:].any()):
        raise ValueError(f"OpenCV's distortion has 4, 5 or 8 coefficients, not {values.tolist()}")
    if not values.any():
        return "PINHOLE", [fx, fy, cx, cy]
    if skew:
        raise ValueError(f"a `camera` with distortion cannot have skew; its matrix is {pinhole.matrix.tolist()}")
    coefficients = np.zeros(8)
    coefficients[: len(values[:8])] = values[:8]
    count = 8 if coefficients[4:].any() else 4
    return "FULL_OPENCV" if count == 8 else "OPENCV", [fx, fy, cx, cy, *coefficients[:count].tolist()]


def _pinhole(values: Any) -> Pinhole:
    try:
        matrix = np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"`camera` is a 3x3 matrix, [fx, fy, cx, cy], (COLMAP model, parameters) or a pycolmap.Camera, not "
            f"{short_repr(values)}"
        ) from error
    if matrix.shape == (4,):
        fx, fy, cx, cy = matrix.tolist()
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if matrix.shape != (3, 3):
        raise ValueError(
            f"the `camera` matrix needs the shape (3, 3), not {matrix.shape}; or give [fx, fy, cx, cy], or (COLMAP "
            "model, parameters)"
        )
    if not np.isfinite(matrix).all():
        raise ValueError(f"the `camera` matrix holds NaN or infinity: {matrix.tolist()}")
    if np.any(matrix[2, :2] != 0) or matrix[2, 2] == 0:
        raise ValueError(f"the last row of the `camera` matrix is {matrix[2].tolist()} instead of (0, 0, 1)")
    matrix = matrix / matrix[2, 2]
    singular = np.linalg.svd(matrix[:2, :2], compute_uv=False)
    if not singular[1] > 1e-9 * singular[0]:
        raise ValueError(f"the `camera` matrix is singular: {matrix.tolist()}")
    (fx, _), (_, fy) = matrix[:2, :2].tolist()
    if np.linalg.det(matrix[:2, :2]) < 0 or min(fx, fy) < 0:
        raise ValueError(
            f"`camera` has the focal lengths {fx:g} and {fy:g}, which mirror the image; give positive ones, and points "
            "of the scene with z forward and y down in the camera"
        )
    return Pinhole(matrix)


def check_single_camera(points_per_camera: Sequence[int] | None, what: str) -> None:
    """Raise ValueError for the solution of a rig, whose points are counted by camera; None is a single camera.

    `what` would be made of the solution, for the message.
    """
    if points_per_camera is not None:
        raise ValueError(
            f"the solution of a rig of {len(points_per_camera)} cameras cannot become {what}; pass the pose of each "
            "camera, which is cam_from_rig times the pose of the rig, to `bpnp.verify`, and use those solutions"
        )
