"""Photos that lie under image points: read from files, and their size in pixels of a camera."""

from pathlib import Path

import numpy as np

from bpnp.cameras import Camera, image_size, same_shape
from bpnp.report.points import Array


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
    known = None if camera is None else image_size(camera)
    if known is None:
        return width, height
    if not same_shape((width, height), known):
        raise ValueError(
            f"expected a photo of {known[0]} x {known[1]} pixels as its camera has, or of that shape, got {width} x "
            f"{height}; try the photo of this camera"
        )
    return known
