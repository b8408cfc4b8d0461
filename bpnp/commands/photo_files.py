"""Photos of tested problems: found by the COLMAP models of the data of a test, or by the store made of them."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from bpnp.bounded_files import file_inside
from bpnp.cameras import Camera, camera_from
from bpnp.datamodules.colmap.model_files import find_scenes
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.store import Store, is_store, open_store
from bpnp.datamodules.stored import PROBLEMS
from bpnp.report.images import read_photo
from bpnp.report.photos import SIDE, PhotoFinder, PhotoSource, ProblemPhoto, undistort_photo
from bpnp.report.points import ProblemPoints
from bpnp.report.results import Results
from bpnp.report.terminal import say

LEVELS = 4  # folders above a model that may hold the folder `images`
MODULES = ("ColmapDataModule", "StoredDataModule")  # data modules of problems that may have photos


class ModelImage(NamedTuple):
    """Image that a problem may be of."""

    name: str  # name of the image in its model
    model: str
    folder: Path  # folder of the model, which a store may outlive
    camera: Callable[[], Camera | None]  # function that returns the camera, None if the model has no such image


ImagesOf = Callable[[str], Iterator[ModelImage]]  # images that a problem may be of, by its name


def model_images(models: Mapping[str, Path]) -> ImagesOf:
    """Return the images of problems that are named <model>/<image>; a model is read when its first camera is used."""

    @cache
    def cameras(model: str) -> dict[str, Camera]:
        content = read_reconstruction(models[model], name=model, keypoints=False)
        return {image.name: image.camera for image in content.images}

    def camera(model: str, name: str) -> Camera | None:
        return cameras(model).get(name)

    def images(problem: str) -> Iterator[ModelImage]:
        for model in sorted(models, key=len, reverse=True):
            if problem.startswith(f"{model}/"):
                name = problem.removeprefix(f"{model}/")
                yield ModelImage(name, model, models[model], partial(camera, model, name))

    return images


def stored_images(store: Store) -> ImagesOf:
    """Return the images of problems in a store of COLMAP models, which has columns "image", "model" and "camera"."""
    rows = {store.name(row): row for row in range(len(store))}

    def images(problem: str) -> Iterator[ModelImage]:
        if (row := rows.get(problem)) is not None:
            name, folder, camera = (bytes(store.columns[key][row]).decode() for key in ("image", "model", "camera"))
            yield ModelImage(
                name, problem.removesuffix(f"/{name}"), Path(folder), lambda: camera_from(json.loads(camera))
            )

    return images


class ColmapPhotos:
    """Source of the photos of problems from COLMAP models.

    Photos are <image> or <model>/<image> in `folder`; for None in the folder `images` of each model's scene, next to
    `sparse`. Their longer side is reduced to `side` pixels.
    """

    def __init__(self, images: ImagesOf, folder: Path | None = None, *, side: int = SIDE) -> None:
        self.images, self.folder, self.side = images, folder, side

    def __call__(self, problem: ProblemPoints) -> ProblemPhoto | None:
        """Return the photo of a problem, None if there is none."""
        for image, path in self._files(problem.id):
            if (camera := image.camera()) is not None:
                photo = read_photo(path)
                try:
                    return undistort_photo(photo, camera, problem.points2d, side=self.side)
                except ValueError as error:
                    raise ValueError(f"{path}: {error}") from error
        return None

    def has_file(self, problem: str) -> bool:
        """Return True if there is a file with the name of a problem's photo."""
        return any(True for _ in self._files(problem))

    def _files(self, problem: str) -> Iterator[tuple[ModelImage, Path]]:
        """Yield the images that a problem may be of, each with its file, if there is one."""
        for image in self.images(problem):
            if self.folder is None:
                paths = [file_inside(parent / "images", image.name) for parent in image.folder.parents[:LEVELS]]
            else:
                paths = [file_inside(self.folder, name) for name in (image.name, f"{image.model}/{image.name}")]
            if (path := next((path for path in paths if path is not None and path.is_file()), None)) is not None:
                yield image, path


def photo_finder(folder: Path | None, *, side: int = SIDE) -> PhotoFinder:
    """Return a function that finds the source of the photos of a test, and prints once what is missing.

    It raises ValueError if a folder is given, as in `ColmapPhotos`, and has no photo of the problems.
    """
    printed: set[str] = set()

    def find(results: Results, problems: Sequence[ProblemPoints]) -> PhotoSource | None:
        source, missing = None, ""
        try:
            source = find_photos(results, folder, side=side)
        except ValueError as error:
            if folder is not None:
                raise
            missing = f"no photos under the points: {error}"
        if source is not None and (without := [each.id for each in problems if not source.has_file(each.id)]):
            if folder is not None and len(without) == len(problems):
                raise ValueError(f"{folder} has no photo of the problems, such as {without[0]}")
            where = "the folder images next to sparse" if folder is None else str(folder)
            missing = f"{len(without)} of {len(problems)} problems have no photo in {where}, such as {without[0]}"
            missing += "; give their folder with --photos" if folder is None else ""
        if missing and missing not in printed:
            printed.add(missing)
            say(missing)
        return source

    return find


def find_photos(results: Results, folder: Path | None, *, side: int = SIDE) -> ColmapPhotos | None:
    """Return the source of the photos of tested problems; None if the test was not of photos and no folder is given.

    Raise ValueError if the COLMAP models of the test, or the cameras in a store made of them, are not there; or if a
    folder is given, as in `ColmapPhotos`, and the test was not of photos.
    """
    data = results.settings.get("data")
    module = str(data.get("class_path")).rpartition(".")[2] if isinstance(data, Mapping) else ""
    root = (data.get("init_args") or {}).get("root") if isinstance(data, Mapping) else None
    roots = [root] if isinstance(root, str) else root or []
    images: ImagesOf | None = None
    if module in MODULES and len(roots) == 1 and is_store(roots[0]):
        store = open_store(roots[0], PROBLEMS, check=False)
        if {"image", "model", "camera"} <= store.columns.keys():
            images = stored_images(store)
    elif module == "ColmapDataModule":
        if gone := [each for each in roots if not Path(each).is_dir()]:
            raise ValueError(f"the COLMAP models of the test are no longer in {', '.join(gone)}")
        scenes = find_scenes(roots)
        images = model_images({name: path for models in scenes.values() for name, path in models.items()})
    if images is None and folder is not None:
        raise ValueError(
            "photos are drawn where a test was of COLMAP models, or of a store that `bpnp prepare megadepth` made of "
            f"them; these results are of {roots or 'other data'}. Leave out --photos"
        )
    return None if images is None else ColmapPhotos(images, folder, side=side)
