"""Photos of tested problems: found by the COLMAP models of the data of a test."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bpnp.datamodules.colmap.model_files import find_scenes
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.store import is_store
from bpnp.report.images import read_photo
from bpnp.report.photos import SIDE, PhotoSource, ProblemPhoto, undistort_photo
from bpnp.report.points import ProblemPoints
from bpnp.report.results import Results

if TYPE_CHECKING:
    from bpnp.cameras import Camera

LEVELS = 4  # folders above a model that may hold the folder `images`


class ColmapPhotos:
    """Source of the photos of problems from COLMAP models, named <model>/<image>.

    Args:
        models: Folders of the models by name.
        folder: Folder of the photos: <image> or <model>/<image> in it. None for the folder `images` of each model's
            scene, next to `sparse`.
        side: Longer side of the photos, pixels.
    """

    def __init__(self, models: Mapping[str, Path], folder: Path | None = None, *, side: int = SIDE) -> None:
        self.models, self.folder, self.side = models, folder, side
        self.cameras: dict[str, dict[str, Camera]] = {}  # of the models read so far, by the names of their images

    def __call__(self, problem: ProblemPoints) -> ProblemPhoto | None:
        """Return the photo of a problem, None if there is none."""
        models = [model for model in self.models if problem.id.startswith(f"{model}/")]
        for model in sorted(models, key=len, reverse=True):
            image = problem.id.removeprefix(f"{model}/")
            path = next((path for path in self._paths(model, image) if path.is_file()), None)
            if path is None:
                continue
            if model not in self.cameras:
                content = read_reconstruction(self.models[model], name=model, keypoints=False)
                self.cameras[model] = {each.name: each.camera for each in content.images}
            if image in self.cameras[model]:
                return self._read(path, self.cameras[model][image], problem)
        return None

    def _paths(self, model: str, image: str) -> Iterator[Path]:
        if self.folder is not None:
            yield from (self.folder / image, self.folder / model / image)
        else:
            yield from (parent / "images" / image for parent in self.models[model].parents[:LEVELS])

    def _read(self, path: Path, camera: "Camera", problem: ProblemPoints) -> ProblemPhoto:
        photo = read_photo(path)
        try:
            return undistort_photo(photo, camera, problem.points2d, side=self.side)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def find_photos(results: Results, folder: Path | None, *, side: int = SIDE) -> PhotoSource | None:
    """Return the source of the photos of tested problems.

    Args:
        results: Results of a test.
        folder: Folder of the photos, as in `ColmapPhotos`.
        side: Longer side of the photos, pixels.

    Returns:
        The source, None if the test was not of COLMAP models that are still there.

    Raises:
        ValueError: A folder is given, and the test was not of COLMAP models that are still there.
    """
    data = results.settings.get("data")
    root = (data.get("init_args") or {}).get("root") if isinstance(data, Mapping) else None
    roots = [root] if isinstance(root, str) else root or []
    colmap = isinstance(data, Mapping) and str(data.get("class_path")).endswith("ColmapDataModule")
    there = colmap and roots and all(Path(each).is_dir() and not is_store(each) for each in roots)
    if not there:
        if folder is not None:
            raise ValueError(
                "photos are drawn where a test was of COLMAP models that are still in their folder; these results are "
                f"of {roots or 'other data'}. Leave out --photos"
            )
        return None
    scenes = find_scenes(roots)
    return ColmapPhotos({name: path for models in scenes.values() for name, path in models.items()}, folder, side=side)
