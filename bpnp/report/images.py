"""Photos: their pixels, and their size in the pixels of their camera."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bpnp.arrays import AnyArray
from bpnp.bounded_files import open_input
from bpnp.cameras import Camera, image_size, same_aspect_ratio

if TYPE_CHECKING:
    from PIL.Image import Image


@contextmanager
def open_photo(path: Path | str) -> "Iterator[Image]":
    """Open a photo with Pillow; its pixels are read when they are used.

    Raise ValueError, which names the file, if it cannot be read, or has more pixels than Pillow reads.
    """
    from PIL import Image

    try:
        with open_input(Path(path), pipes=False) as file, Image.open(file) as photo:
            yield photo
    except Image.DecompressionBombError as error:
        raise ValueError(f"the photo {path} is too large: {error}; reduce its size") from error
    except (OSError, SyntaxError) as error:  # Pillow raises SyntaxError for a damaged PNG file
        raise ValueError(f"cannot read the photo {path}: {error}; give a JPEG or PNG file") from error


def read_photo(path: Path | str) -> AnyArray:
    """Read the pixels (h, w, 3) of a photo, uint8; raise ValueError as `open_photo` does."""
    with open_photo(path) as photo:
        return np.asarray(photo.convert("RGB"))


def size_in_camera(photo: AnyArray, camera: Camera | None) -> tuple[int, int]:
    """Return the width and height of a photo (h, w, 3) in pixels of its camera, which differ if the photo was resized.

    Raise ValueError if the photo has another aspect ratio than the camera's images.
    """
    height, width = photo.shape[:2]
    size = None if camera is None else image_size(camera)
    if size is None:
        return width, height
    if not same_aspect_ratio((width, height), size):
        raise ValueError(
            f"the photo has {width} x {height} pixels, and its camera {size[0]} x {size[1]}, another aspect ratio; use "
            "the photo of this camera"
        )
    return size
