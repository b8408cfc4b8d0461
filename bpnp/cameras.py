"""Cameras: from pixels to normalised image coordinates and back, distortion included.

The only file that imports pycolmap, and only when a camera needs it: it takes half a second.
"""

import signal
import threading

# zlib has to be loaded before pycolmap (4.2): in the other order zlib.compress and np.savez_compressed abort Python.
import zlib  # noqa: F401
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
ROUND_TRIP = 0.01  # pixels
FISHEYE = {  # models with the radius t (1 + k1 t^2 + ...) at the angle t from the axis: focal lengths, coefficients
    "SIMPLE_FISHEYE": (1, 0),
    "FISHEYE": (2, 0),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
    "OPENCV_FISHEYE": (2, 4),
}
EDGES, STEPS = 1024, 5  # of a fisheye's angles, between which Newton's steps find one to the last digit
CENTRE = 0.5  # of the first pixel in COLMAP's coordinates; OpenCV and hloc count from 0
SLIGHTLY, FEW_OUTSIDE = 0.01, 0.02  # larger sides outside an image; fraction of points that may be farther outside
WIDEST = 10.0  # normalised image coordinates, 84 degrees off the axis
MOST_PIXELS = 2**31  # of a side of an image; more is a file that is none


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion, pixels ~ K (x, y, 1)."""

    matrix: Array

    @property
    def focal(self) -> float:
        """Pixels per unit of normalised coordinates."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix[:2, :2]))))

    def normalise(self, pixels: Array) -> Array:
        """Normalised coordinates (k, 2) of pixels (k, 2)."""
        return np.asarray((pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T, np.float64)

    def bearings(self, pixels: Array) -> Array:
        """Unit vectors (k, 3) towards pixels (k, 2)."""
        return _of_length_one(np.column_stack([self.normalise(pixels), np.ones(len(pixels))]))

    def project(self, points: Array) -> Array:
        """Pixels (k, 2) of points (k, 3) in camera coordinates; NaN at and behind the plane of the camera."""
        return in_front(points) @ self.matrix[:2].T


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera of any COLMAP model, with its distortion; `camera` is pycolmap's."""

    camera: Any

    @property
    def focal(self) -> float:
        """Pixels per unit of normalised coordinates: the mean focal length; of a model that has none (equirectangular),
        the scale at the principal ray."""
        step = 1e-4
        ahead, aside = self.camera.img_from_cam(np.array([[0.0, 0.0, 1.0], [step, 0.0, 1.0]]))
        return float(self.camera.mean_focal_length() or np.linalg.norm(aside - ahead) / step)

    @property
    def matrix(self) -> Array:
        """(3, 3) focal lengths and principal point in pixels: the pinhole camera of the undistorted image."""
        if self.camera.mean_focal_length():
            return np.asarray(self.camera.calibration_matrix(), np.float64)
        ((x, y),) = self.camera.img_from_cam(np.array([[0.0, 0.0, 1.0]]))
        return np.array([[self.focal, 0, x], [0, self.focal, y], [0, 0, 1]])

    def normalise(self, pixels: Array) -> Array:
        """Normalised, undistorted coordinates (k, 2) of pixels (k, 2), NaN where there are none.

        pycolmap marks some failures with NaN and returns a wrong finite point for others (a fisheye beyond 90 degrees),
        so the result has to project back to the pixel.
        """
        points = np.asarray(self.camera.cam_from_img(np.ascontiguousarray(pixels)), dtype=np.float64)
        back = np.asarray(self.camera.img_from_cam(np.column_stack([points, np.ones(len(points))])), dtype=np.float64)
        with np.errstate(invalid="ignore"):
            good = np.linalg.norm(back - pixels, axis=-1) < ROUND_TRIP
        return np.where(good[:, None], points, np.nan)

    def bearings(self, pixels: Array) -> Array:
        """Unit vectors (k, 3) towards pixels (k, 2), of a fisheye up to 180 degrees off its axis; NaN where there is
        none."""
        name, params = self.camera.model.name, np.asarray(self.camera.params, np.float64)
        if name not in FISHEYE:
            return _of_length_one(np.column_stack([self.normalise(pixels), np.ones(len(pixels))]))
        focals, count = FISHEYE[name]
        seen = (pixels - params[focals : focals + 2]) / params[:focals]
        radius = np.linalg.norm(seen, axis=-1)
        # t (1 + k1 t^2 + ...) rises up to the first root of its derivative, or to the angle of a full turn.
        radial = np.zeros(2 * count + 2)
        radial[1::2] = np.r_[1.0, params[focals + 2 : focals + 2 + count]]
        distance = np.polynomial.Polynomial(radial).trim()
        slope = distance.deriv()
        roots = slope.roots()
        turns = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)]
        widest = min([np.pi, *turns.tolist()])
        edges = np.linspace(0, widest, EDGES)
        rising = distance(edges)
        k = np.clip(np.searchsorted(rising, radius) - 1, 0, EDGES - 2)
        angle = edges[k]
        for _ in range(STEPS):  # Newton's, between two edges
            angle += (radius - distance(angle)) / np.maximum(slope(angle), np.finfo(float).tiny)
            angle = np.clip(angle, edges[k], edges[k + 1])
        angle = np.where(radius <= rising[-1], angle, np.nan)
        aside = seen * (np.sin(angle) / np.maximum(radius, np.finfo(float).tiny))[:, None]
        return np.column_stack([aside, np.cos(angle)])

    def project(self, points: Array) -> Array:
        """Pixels (k, 2) of points (k, 3) in camera coordinates; NaN at and behind the plane of the camera."""
        return np.asarray(self.camera.img_from_cam(np.ascontiguousarray(in_front(points))), dtype=np.float64)


Camera = Pinhole | Lens


def _of_length_one(rays: Array) -> Array:
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def in_front(points: Array) -> Array:
    """(x/z, y/z, 1) of points (k, 3) with z > 0, NaN for the others."""
    depth = np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
    with np.errstate(over="ignore"):
        return points / depth


def camera_from(camera: Any) -> Camera:
    """The camera of a 3x3 matrix K, of OpenCV's (K, distortion), of (COLMAP model name, parameters) or (name, width,
    height, parameters), of a mapping with `model` and `params` (and `width`, `height`), or of a pycolmap.Camera; a
    `Camera` as it is.

    Raises ValueError for a singular or broken K, an unknown model, a wrong number of parameters, or no positive focal
    length.
    """
    if isinstance(camera, (Pinhole, Lens)):
        return camera
    if hasattr(camera, "cam_from_img") and hasattr(camera, "img_from_cam"):
        return _checked(Lens(camera), f"{camera.params}")
    if isinstance(camera, Mapping):
        if not {"model", "params"} <= set(camera):
            raise ValueError(f"expected `camera` with `model` and `params`, got a mapping with {', '.join(camera)}")
        return colmap_camera(str(camera["model"]), camera["params"], (camera.get("width", 0), camera.get("height", 0)))
    if isinstance(camera, (tuple, list)) and len(camera) and isinstance(camera[0], str):
        if len(camera) not in (2, 4):
            raise ValueError(
                f"expected `camera` as (model, parameters) or (model, width, height, parameters), got {len(camera)} "
                "values"
            )
        return colmap_camera(camera[0], camera[-1], camera[1:-1] or (0, 0))
    return _opencv(*camera) if is_opencv(camera) else _pinhole(camera)


def is_opencv(camera: Any) -> bool:
    """Whether a camera is OpenCV's (K, distortion), whose pixels count from (0, 0), the centre of the first one."""
    return isinstance(camera, tuple) and len(camera) == 2 and np.shape(camera[0]) == (3, 3)


def image_size(camera: Camera) -> tuple[int, int] | None:
    """Width and height of a camera's images in pixels, None where they are not known."""
    size = (camera.camera.width, camera.camera.height) if isinstance(camera, Lens) else (0, 0)
    return size if all(size) else None


def same_aspect_ratio(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of two sizes are one scaled, to a pixel of rounding on a side."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def check_normalised(points2d: Any, remedy: str) -> None:
    """Raise ValueError for image points that are pixels: half of them are more than 84 degrees off the axis.

    Args:
        points2d: (m, 2) array or tensor, finite.
        remedy: what the message proposes.
    """
    points = np.asarray(points2d)
    if np.median(np.linalg.norm(points, axis=-1)) > WIDEST:
        raise ValueError(
            f"expected normalised image coordinates in `points2d`, got values up to {np.abs(points).max():g}, which "
            f"look like pixels; try {remedy}"
        )


def outside_image(pixels: Array, sides: Any) -> npt.NDArray[np.bool_]:
    """Return which pixels tell that an image has another size.

    Detectors put some keypoints slightly outside: by a hundredth of the larger side, or a pixel, all may be, and by
    more one in 50.

    Args:
        pixels: (m, 2); NaN is inside.
        sides: Width and height, pixels.

    Returns:
        (m,) those that lie farther outside; none of them where they are few.

    >>> outside_image(np.array([[101.8, 20.0], [50, 50], [10, 20]]), (100, 100)).tolist()
    [True, False, False]
    """
    sides = np.asarray(sides, np.float64)
    slack = max(SLIGHTLY * float(sides.max()), 1.0)
    outside = ((pixels < -slack) | (pixels > sides + slack)).any(-1)
    return np.asarray(outside & (outside.mean() > FEW_OUTSIDE))


def resize_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera of images that were scaled to `size`, width and height in pixels; itself where they have that size.

    >>> resize_camera(camera_from(("PINHOLE", 1000, 800, [900, 880, 500, 400])), (500, 400)).matrix.tolist()
    [[450.0, 0.0, 250.0], [0.0, 440.0, 200.0], [0.0, 0.0, 1.0]]
    """
    known = image_size(camera)
    if known is None or not same_aspect_ratio(known, size):
        raise ValueError(f"expected a camera with images of the shape {size[0]} x {size[1]}, got {known}")
    if known == size:
        return camera
    scaled = camera_from(camera_to_json(camera))
    assert isinstance(scaled, Lens)
    scaled.camera.rescale(*size)
    return scaled


def scale_focal_length(camera: Camera, zoom: float) -> Camera:
    """The camera with so many times the focal length.

    >>> scale_focal_length(camera_from(("SIMPLE_RADIAL", 1000, 800, [900, 500, 400, 0.1])), 2.0).focal
    1800.0
    """
    if isinstance(camera, Pinhole):
        return Pinhole(camera.matrix * [[zoom, zoom, 1.0], [zoom, zoom, 1.0], [1.0, 1.0, 1.0]])
    zoomed = camera_from(camera_to_json(camera))
    assert isinstance(zoomed, Lens)
    params = zoomed.camera.params
    params[list(zoomed.camera.focal_length_idxs())] *= zoom
    zoomed.camera.params = params
    return zoomed


def is_pinhole(camera: Camera) -> bool:
    """Whether a camera is a pinhole camera without skew, to which `with_radial_distortion` can add distortion."""
    if isinstance(camera, Pinhole):
        return bool(camera.matrix[0, 1] == camera.matrix[1, 0] == 0)
    return camera.camera.model.name in ("SIMPLE_PINHOLE", "PINHOLE")


def with_radial_distortion(camera: Camera, radial: float) -> Lens:
    """Return a pinhole camera with a radial coefficient: SIMPLE_RADIAL, or OPENCV with two focal lengths.

    >>> with_radial_distortion(camera_from(("SIMPLE_PINHOLE", 1000, 800, [900, 500, 400])), 0.1).camera.params.tolist()
    [900.0, 500.0, 400.0, 0.1]
    """
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    size = image_size(camera) or (0, 0)
    if fx == fy:
        return colmap_camera("SIMPLE_RADIAL", [fx, cx, cy, radial], size)
    return colmap_camera("OPENCV", [fx, fy, cx, cy, radial, 0.0, 0.0, 0.0], size)


def camera_to_json(camera: Camera) -> list[list[float]] | dict[str, Any]:
    """A camera as JSON can hold it, which `camera_from` reads again."""
    if isinstance(camera, Pinhole):
        return camera.matrix.tolist()
    lens = camera.camera
    return {"model": lens.model.name, "width": lens.width, "height": lens.height, "params": lens.params.tolist()}


def colmap_camera(model: str, params: Any, size: Any = (0, 0)) -> Lens:
    """The camera of a COLMAP model's name and parameters, in COLMAP's order; size: width and height of its images,
    pixels, 0 if unknown. Raises ValueError as `camera_from`."""
    counts = dict(camera_models().values())
    if model not in counts:
        raise ValueError(f"expected a COLMAP camera model among {', '.join(counts)}, got {model!r}")
    try:
        values = np.asarray(params, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected the parameters of a {model} camera as numbers, got {params!r:.60}") from error
    if values.shape != (counts[model],):
        raise ValueError(f"expected {counts[model]} parameters of a {model} camera, got {values.tolist()}")
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite parameters of a {model} camera, got {values.tolist()}")
    try:
        width, height = (int(value) for value in size)
    except (TypeError, ValueError, OverflowError):
        width, height = -1, -1
    if min(width, height) < 0 or max(width, height) > MOST_PIXELS:
        raise ValueError(f"expected width and height of a {model} camera in pixels, got {tuple(size)}")
    lens = Lens(_pycolmap().Camera(model=model, width=width, height=height, params=values.tolist()))
    return _checked(lens, f"{values.tolist()}")


def read_text_model(folder: Path) -> Any:
    """The pycolmap.Reconstruction of a COLMAP model in text files. Raises ValueError with pycolmap's reason."""
    model = _pycolmap().Reconstruction()
    try:
        model.read_text(str(folder))
    except (ValueError, IndexError, RuntimeError) as error:
        raise ValueError(str(error)) from error
    return model


@cache
def camera_models() -> Mapping[int, tuple[str, int]]:
    """Name and number of parameters of each COLMAP camera model, by its id."""
    pycolmap = _pycolmap()
    return {
        int(model): (name, len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params))
        for name, model in pycolmap.CameraModelId.__members__.items()
        if model != pycolmap.CameraModelId.INVALID
    }


@cache
def _pycolmap() -> Any:
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        # Restore the SIGTERM handler, which pycolmap replaces by one that prints a stack trace.
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def _checked(lens: Lens, shown: str) -> Lens:
    focal = lens.focal
    if not focal > 0:
        raise ValueError(f"expected a camera with a positive focal length, got {focal} of the parameters {shown}")
    return lens


def _opencv(matrix: Any, distortion: Any) -> Camera:
    """OpenCV's matrix and its coefficients k1, k2, p1, p2, k3, k4, k5, k6, of which the last two or four may lack."""
    pinhole = _pinhole(matrix)
    values = np.asarray([] if distortion is None else distortion, np.float64).ravel()
    if len(values) not in (0, 4, 5, 8) and (len(values) not in (12, 14) or values[8:].any()):
        raise ValueError(f"expected the 4, 5 or 8 distortion coefficients of OpenCV, got {values.tolist()}")
    if not values.any():
        return pinhole
    if pinhole.matrix[0, 1]:
        raise ValueError(f"expected a `camera` matrix without skew beside a distortion, got {pinhole.matrix.tolist()}")
    (fx, _, cx), (_, fy, cy), _ = pinhole.matrix.tolist()
    coefficients = np.zeros(8)
    coefficients[: len(values[:8])] = values[:8]
    count = 8 if coefficients[4:].any() else 4
    return colmap_camera("FULL_OPENCV" if count == 8 else "OPENCV", [fx, fy, cx, cy, *coefficients[:count].tolist()])


def _pinhole(values: Any) -> Pinhole:
    try:
        matrix = np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"expected `camera` as a 3x3 matrix, (COLMAP model, parameters) or a pycolmap.Camera, got {values!r:.60}"
        ) from error
    if matrix.shape != (3, 3):
        raise ValueError(f"expected a `camera` matrix of shape (3, 3), got {matrix.shape}; try (model, parameters)")
    if not np.isfinite(matrix).all():
        raise ValueError(f"expected a finite `camera` matrix, got {matrix.tolist()}")
    if np.any(matrix[2, :2] != 0) or matrix[2, 2] == 0:
        raise ValueError(f"expected a `camera` matrix with the last row (0, 0, 1), got {matrix[2].tolist()}")
    matrix = matrix / matrix[2, 2]
    singular = np.linalg.svd(matrix[:2, :2], compute_uv=False)
    if not singular[1] > 1e-9 * singular[0]:
        raise ValueError(f"expected an invertible `camera` matrix, got the singular {matrix.tolist()}")
    (fx, _), (_, fy) = matrix[:2, :2].tolist()
    if np.linalg.det(matrix[:2, :2]) < 0 or min(fx, fy) < 0:
        raise ValueError(
            f"`camera` has the focal lengths {fx:g} and {fy:g}, which mirror the image; give positive ones, and points "
            "of the scene with z forward and y down in the camera"
        )
    return Pinhole(matrix)
