"""Photos to draw under the points of problems: without distortion, cut to the points, and small."""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bpnp.arrays import AnyArray
from bpnp.cameras import Camera, Pinhole
from bpnp.report.images import size_in_camera
from bpnp.report.points import ProblemPoints
from bpnp.report.results import Results

SIDE = 480  # longer side of a photo, pixels
MARGIN = 0.15  # margin around the image points, relative to their extent
QUALITY = 70  # of JPEG
GREY = (128, 128, 128)  # outside the photo


@dataclass(frozen=True)
class ProblemPhoto:
    """Photo of a problem, as a pinhole camera would have taken it."""

    pixels: AnyArray  # (h, w, 3), uint8
    camera: Pinhole  # camera of these pixels, without distortion

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom in normalised image coordinates."""
        height, width = self.pixels.shape[:2]
        left, top, right, bottom = self.camera.normalise(np.array([[0.0, 0.0], [width, height]])).ravel().tolist()
        return left, top, right, bottom

    @property
    def jpeg(self) -> str:
        """JPEG file in base64."""
        from PIL import Image

        content = io.BytesIO()
        Image.fromarray(self.pixels).save(content, format="jpeg", quality=QUALITY, optimize=True)
        return base64.b64encode(content.getvalue()).decode()


PhotoSource = Callable[[ProblemPoints], ProblemPhoto | None]  # finds the photo of a problem
PhotoFinder = Callable[[Results, Sequence[ProblemPoints]], PhotoSource | None]  # finds the photos of a test


def undistort_photo(photo: AnyArray, camera: Camera, points2d: AnyArray, *, side: int = SIDE) -> ProblemPhoto:
    """Return the part of a photo (h, w, 3), uint8, around image points (m, 2), normalised, without distortion.

    The photo may be resized; `side` is the longer one of the result, pixels. Raise ValueError if the photo has another
    aspect ratio than the camera's images, or no part of it is near the points.
    """
    import cv2

    width, height = size_in_camera(photo, camera)
    low, high = np.nanmin(points2d, axis=0).astype(float), np.nanmax(points2d, axis=0).astype(float)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    along = np.linspace(0, 1, 33)[:, None] * [width, height]
    border = np.concatenate([along * [1, 0], along * [1, 0] + [0, height], along * [0, 1], along * [0, 1] + [width, 0]])
    edges = camera.normalise(border)
    low = np.fmax(low - margin, np.nanmin(edges, axis=0))
    high = np.fmin(high + margin, np.nanmax(edges, axis=0))
    if not (high > low).all():
        raise ValueError("the image points of the problem are outside the photo; use the photo of this camera")
    scale = side / (high - low).max()
    columns, rows = np.maximum(np.rint((high - low) * scale), 1).astype(int)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / scale + low[0], (np.arange(rows) + 0.5) / scale + low[1])
    source = camera.project(np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])).reshape(rows, columns, 2)
    source *= np.array(photo.shape[1::-1]) / [width, height]
    span = np.nanmax(source, axis=(0, 1)) - np.nanmin(source, axis=(0, 1))
    shrink = min(1.0, 2 * side / float(span.max()))  # averages the pixels that the result leaves out
    small = cv2.resize(photo, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else photo
    source *= np.array(small.shape[1::-1]) / photo.shape[1::-1]
    at = np.nan_to_num(source - 0.5, nan=-1e6).astype(np.float32)  # OpenCV counts from the centre of the first pixel
    pixels = cv2.remap(
        small, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=GREY
    )
    matrix = np.array([[scale, 0, -scale * low[0]], [0, scale, -scale * low[1]], [0, 0, 1]])
    return ProblemPhoto(np.asarray(pixels, np.uint8), Pinhole(matrix))
