"""The photos of COLMAP scenes, undistorted: what lies under the normalised image points of a pair."""

import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates

from bpnp.datamodules.colmap.reconstruction import read_projections
from bpnp.datamodules.colmap.scenes import find_scenes

FOLDERS = ("images", "imgs", "dense/images", "dense0/imgs", "dense0/images")
UP = 4  # levels above a model: <scene>/sparse/manhattan/0
WIDTH = 480  # pixels of a crop
Pixels = NDArray[np.uint8]
logger = logging.getLogger(__name__)


def photo_finder(root: Path) -> Callable[[str, tuple[float, float, float, float]], Pixels | None]:
    """A function of a pair's name, <scene>/<image>, and a box (left, top, right, bottom) of the normalised image plane.

    It gives the undistorted photo in that box (h, 480, 3), black where there is none, or None without a photo: in
    `images`, `imgs`, `dense/images` or `dense0/imgs` beside or above the model. Photos that cannot be read are logged.
    Raises ColmapError if `root` holds no COLMAP model.
    """
    models = {name: folder for scene in find_scenes(root).values() for name, folder in scene.items()}
    projections = cache(read_projections)

    def find(pair: str, box: tuple[float, float, float, float]) -> Pixels | None:
        name = max((name for name in models if pair.startswith(f"{name}/")), key=len, default=None)
        if name is None:
            return None
        image = pair[len(name) + 1 :]
        path = image_file(models[name], image)
        project = projections(models[name]).get(image)
        if path is None or project is None:
            return None
        try:
            with Image.open(path) as file:
                photo = np.asarray(file.convert("RGB"))
        except (OSError, ValueError) as error:
            logger.warning("photo %s cannot be read: %s", path, error)
            return None
        return _resampled(photo, project, box)

    return find


def image_file(model: Path, image: str) -> Path | None:
    """The photo of a model's image, if it is where COLMAP's or MegaDepth's layout has it."""
    paths = (folder / name / image for folder in [model, *model.parents][: UP + 1] for name in FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def _resampled(
    photo: Pixels, project: Callable[[NDArray[np.float64]], NDArray[np.float64]], box: tuple[float, float, float, float]
) -> Pixels:
    left, top, right, bottom = box
    height = int(np.clip(round(WIDTH * (bottom - top) / (right - left)), 16, 2 * WIDTH))
    x = left + (np.arange(WIDTH) + 0.5) / WIDTH * (right - left)
    y = top + (np.arange(height) + 0.5) / height * (bottom - top)
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, WIDTH))], -1).reshape(-1, 3)
    size = np.array(photo.shape[1::-1])
    column, row = (project(rays) * size - 0.5).T  # COLMAP's origin is the corner of the first pixel
    channels = [map_coordinates(photo[..., c], [row, column], order=1, cval=0) for c in range(3)]
    return np.stack(channels, -1).reshape(height, WIDTH, 3)
