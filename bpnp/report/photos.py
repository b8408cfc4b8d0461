"""Photos: read from files, and as undistorted crops that lie under the image points of a page."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bpnp.cameras import Camera, Lens
from bpnp.report.points import Array, ProblemPoints

MARGIN = 0.15  # of the extent of the image points, around them
MOST_BYTES = 3_000_000  # of all photos of a page


def read_photo(path: Path | str) -> Array:
    """The picture in a file (h, w, 3), uint8. Raises ValueError that names a file that is none."""
    from PIL import Image

    try:
        with Image.open(path) as photo:
            return np.asarray(photo.convert("RGB"))
    except OSError as error:
        raise ValueError(f"expected a picture, got {path}: {error}") from error


def size_in_camera(photo: Array, camera: Camera | None) -> tuple[int, int]:
    """Width and height of a whole photo in pixels of its camera, where the photo may have been made smaller since.

    Raises ValueError for a photo of another shape than the camera's images.
    """
    height, width = photo.shape[:2]
    known = (camera.camera.width, camera.camera.height) if isinstance(camera, Lens) else (0, 0)
    if not all(known):
        return width, height
    if abs(width * known[1] - height * known[0]) > max(*known, width, height):  # a pixel of rounding on a side
        raise ValueError(
            f"expected a photo of {known[0]} x {known[1]} pixels as its camera has, or of that shape, got {width} x "
            f"{height}; try the photo of this camera"
        )
    return known


class Box(NamedTuple):
    """Part of the normalised image plane."""

    left: float
    top: float
    right: float
    bottom: float


# Of the id of a problem and a box, (h, w, 3) uint8 that fills the box, or None.
PhotoFinder = Callable[[str, Box], Array | None]


def picture_box(points2d: Array) -> Box:
    """What image points (m, 2) span, and a little more. Raises ValueError if none is finite, in front of the camera."""
    seen = points2d[np.isfinite(points2d).all(-1)].astype(float)
    if not len(seen):
        raise ValueError("expected image points in front of the camera to draw, got none")
    low, high = seen.min(0), seen.max(0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return Box(*(low - margin).tolist(), *(high + margin).tolist())


def page_photos(runs: Mapping[str, Sequence[ProblemPoints]], photo: PhotoFinder | None) -> dict[str, dict[str, object]]:
    """By problem, a plotly layout image that fills its box, the worst problems first while there is room."""
    from PIL import Image

    images: dict[str, dict[str, object]] = {}
    if photo is None:
        return images
    left = MOST_BYTES
    worst_first = sorted((problem for run in runs.values() for problem in run), key=lambda problem: -problem.error)
    for problem in {problem.id: problem for problem in worst_first}.values():
        box, content = picture_box(problem.points2d), io.BytesIO()
        pixels = photo(problem.id, box)
        if pixels is None:
            continue
        Image.fromarray(pixels).save(content, format="JPEG", quality=70)
        text = base64.b64encode(content.getvalue()).decode()
        left -= len(text)
        if left < 0:
            break
        images[problem.id] = {
            "source": f"data:image/jpeg;base64,{text}", "xref": "x", "yref": "y", "sizing": "stretch",
            "layer": "below", "x": box.left, "y": box.top, "sizex": box.right - box.left, "sizey": box.bottom - box.top,
        }  # fmt: skip
    return images
