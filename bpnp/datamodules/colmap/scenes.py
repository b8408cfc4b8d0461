"""Which COLMAP models there are below a folder, which scene each belongs to, and its photos, undistorted."""

import itertools
import logging
import os
import re
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates

from bpnp.cameras import Camera, image_size
from bpnp.datamodules.colmap.model_files import FILES, ColmapError, model_format
from bpnp.datamodules.colmap.reconstruction import ImagePoints, read_reconstruction

# What lies between the folder of a scene and its models: <scene>/sparse/0, <scene>/sparse/manhattan/0 (MegaDepth),
# <scene>/dense/0/sparse.
LAYOUT = re.compile(r"sparse|dense\d*")
INSIDE_LAYOUT = re.compile(r"sparse|dense\d*|manhattan|\d+")
PHOTO_FOLDERS = ("images", "imgs", "dense/images", "dense0/imgs", "dense0/images")
UP = 4  # levels above a model: <scene>/sparse/manhattan/0
WIDTH = 480  # pixels of a crop
Pixels = NDArray[np.uint8]
Box = tuple[float, float, float, float]  # left, top, right, bottom of the normalised image plane
logger = logging.getLogger(__name__)


def find_scenes(roots: str | Path | Sequence[str | Path]) -> dict[str, dict[str, Path]]:
    """Every COLMAP model at or below `roots`, as {scene: {name of the model: folder}}, sorted.

    A scene is named by its path below the root, without what follows from `sparse` or `dense` on; all models below it
    (`sparse/0`, `sparse/1`, `sparse/manhattan/0`) belong to it. A scene's only model has the scene's name, others have
    their path added.

    Raises ColmapError if a root is not a folder, holds no model, or two scenes have one name. A folder that lacks one
    of the three files is skipped with a warning if there are whole ones.
    """
    scenes: dict[str, dict[str, Path]] = {}
    homes: dict[str, Path] = {}
    for root in [roots] if isinstance(roots, (str, Path)) else roots:
        top = Path(root).absolute()
        for folder in _find_models(top):
            home = _scene_folder(top, folder)
            scene = home.relative_to(top).as_posix() if top in home.parents else home.name
            if homes.setdefault(scene, home) != home:
                raise ColmapError(
                    f"expected scenes of different names, got {homes[scene]} and {home} for {scene!r}; try their "
                    "common parent folder as `root`"
                )
            scenes.setdefault(scene, {})["/".join((scene, *folder.relative_to(home).parts))] = folder
    return {
        scene: {scene: next(iter(models.values()))} if len(models) == 1 else dict(sorted(models.items()))
        for scene, models in sorted(scenes.items())
    }


def _find_models(top: Path) -> list[Path]:
    if not top.is_dir():
        raise ColmapError(f"expected a folder of COLMAP models, got {top}, which is no folder; try another `root`")
    whole, incomplete, visited = [], [], set[Path]()
    for name, children, files in os.walk(top, followlinks=True):
        folder = Path(name)
        children.sort()
        if folder.resolve() in visited:  # a link
            children.clear()
            continue
        visited.add(folder.resolve())
        if model_format(folder):
            whole.append(folder)
        elif max(sum(f"{part}.{suffix}" in files for part in FILES) for suffix in ("bin", "txt")) > 1:
            incomplete.append(folder)
    if incomplete:
        message = (
            f"expected cameras, images and points3D in a COLMAP model, got {len(incomplete)} folders without one of "
            f"them ({', '.join(map(str, incomplete[:4]))}); try copying them again"
        )
        if not whole:
            raise ColmapError(message)
        warnings.warn(f"skipped: {message}", stacklevel=4)
    if not whole:
        raise ColmapError(
            f"expected COLMAP models below {top}, got none; try a folder that holds <scene>/sparse/0/cameras.bin (or "
            ".txt), images and points3D"
        )
    return whole


def _scene_folder(top: Path, folder: Path) -> Path:
    """Where the path to a model first meets `sparse` or `dense`; else the model's folder itself.

    Looked for below the root, or from above it if the root is inside a scene, `castle/sparse` say.
    """
    start = len(top.parts)
    if all(INSIDE_LAYOUT.fullmatch(part) for part in folder.relative_to(top).parts):
        start -= len(list(itertools.takewhile(INSIDE_LAYOUT.fullmatch, reversed(top.parts))))
    for depth in range(max(start, 1), len(folder.parts)):
        if LAYOUT.fullmatch(folder.parts[depth]):
            return Path(*folder.parts[:depth])
    return folder


def photo_finder(root: Path) -> Callable[[str, Box], Pixels | None]:
    """A function of an image's name, <scene>/<image>, and a box of the normalised image plane.

    It gives the undistorted photo in that box (h, 480, 3), black where there is none, or None without a photo: in
    `images`, `imgs`, `dense/images` or `dense0/imgs` beside or above the model. Photos that cannot be read are logged.
    Raises ColmapError if `root` holds no COLMAP model.
    """
    models = {name: folder for scene in find_scenes(root).values() for name, folder in scene.items()}

    @cache
    def images(model: str) -> dict[str, ImagePoints]:
        return {image.name: image for image in read_reconstruction(models[model], keypoints=False).images}

    def find(name: str, box: Box) -> Pixels | None:
        model = max((model for model in models if name.startswith(f"{model}/")), key=len, default=None)
        if model is None:
            return None
        image = images(model).get(name[len(model) + 1 :])
        path = None if image is None else image_file(models[model], image.name)
        if image is None or path is None:
            return None
        try:
            with Image.open(path) as file:
                photo = np.asarray(file.convert("RGB"))
        except (OSError, ValueError) as error:
            logger.warning("photo %s cannot be read: %s", path, error)
            return None
        return _resampled(photo, image.camera, box)

    return find


def image_file(model: Path, image: str) -> Path | None:
    """The photo of a model's image, if it is where COLMAP's or MegaDepth's layout has it."""
    paths = (folder / name / image for folder in [model, *model.parents][: UP + 1] for name in PHOTO_FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def _resampled(photo: Pixels, camera: Camera, box: Box) -> Pixels:
    left, top, right, bottom = box
    height = int(np.clip(round(WIDTH * (bottom - top) / (right - left)), 16, 2 * WIDTH))
    x = left + (np.arange(WIDTH) + 0.5) / WIDTH * (right - left)
    y = top + (np.arange(height) + 0.5) / height * (bottom - top)
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, WIDTH))], -1).reshape(-1, 3)
    if (size := image_size(camera)) is None:
        raise ColmapError("expected a camera with a width and a height in the COLMAP model, got 0; try another model")
    scale = np.array(photo.shape[1::-1]) / size  # a photo may have another size than the camera's image
    column, row = (camera.project(rays) * scale - 0.5).T  # COLMAP's origin is the corner of the first pixel
    channels = [map_coordinates(photo[..., c], [row, column], order=1, cval=0) for c in range(3)]
    return np.stack(channels, -1).reshape(height, WIDTH, 3)
