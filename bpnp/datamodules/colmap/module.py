"""Data module of photos with known poses in COLMAP models: MegaDepth, or your own scenes."""

import json
import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp.cameras import camera_to_json
from bpnp.datamodules.augment import check_clutter
from bpnp.datamodules.colmap.model_files import FILES, ColmapError, find_scenes
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction, read_reconstruction
from bpnp.datamodules.problem import Counts, Problem, ProblemSource, stack_problems
from bpnp.datamodules.store import JobResult, Recipe, StoreError, StoreRow, is_store
from bpnp.datamodules.stored import PROBLEMS, WIDTHS, StoredDataModule, has_enough_matches, problem_row
from bpnp.files import file_states, fingerprint
from bpnp.poses import common_up
from bpnp.types import Batch

FAR = 100.0  # distance from the origin, in extents of the points, beyond which float32 resolves only 1e-5 of an extent
logger = logging.getLogger(__name__)


class ColmapDataModule(StoredDataModule):
    """Photos with known poses in COLMAP models, read directly, or converted once by `bpnp prepare megadepth`.

    Of models that are read directly, a setup reads only the scenes of its stage. A model that cannot be read is skipped
    with a warning if the part (train, val, test) has others.

    Args:
        root: Folder that `bpnp prepare megadepth` made; or a folder of scenes, <scene>/sparse/0 or
            <scene>/sparse/manhattan/0 with cameras, images and points3D (.bin or .txt) in it; or one scene, one model,
            or a list of any of these.
        y_down: Rotate the scene of each photo so that its second axis points down, as most of the map's other photos
            see it. Poses are those in the rotated scene. Default False. Not for a folder of `bpnp prepare`.
        **options: Options of `StoredDataModule`: train_scenes, val_scenes, test_scenes, val_fraction, test_fraction,
            min_points, max_points, fresh_subsets, eval_max_points, clutter, clutter_side and rotate, and those of
            `ProblemDataModule`.
    """

    def __init__(self, root: str | list[str], *, y_down: bool = False, **options: Any) -> None:
        super().__init__(root, **options)  # type: ignore[arg-type]
        self.y_down = y_down
        self.models: dict[str, Reconstruction] = {}  # models read so far, by name

    def _open(self) -> dict[str, Any]:
        return super()._open() if self._is_store() else find_scenes(self.root)

    def _is_store(self) -> bool:
        return isinstance(self.root, str) and is_store(self.root)

    def _problems(self, scenes: Sequence[Any], seed: tuple[int, int]) -> ProblemSource:
        if self._is_store():
            if self.y_down:
                raise ValueError("`y_down` needs the photos of the models; give the folder of the COLMAP models")
            return super()._problems(scenes, seed)
        folders = {name: folder for models in scenes for name, folder in models.items()}
        models = self._read(folders)
        return ColmapSource(models, min_points=self.min_points, clutter=self.clutter, y_down=self.y_down, seed=seed)

    def _read(self, folders: Mapping[str, Path]) -> list[Reconstruction]:
        readable, failures = [], []
        for name, folder in folders.items():
            try:
                if name not in self.models:
                    self.models[name] = read_reconstruction(folder, name=name)
                readable.append(self.models[name])
            except ColmapError as error:
                failures.append(error)
        if not readable:
            raise failures[0]
        if failures:
            some = "; ".join(map(str, failures[:4]))
            warnings.warn(f"skipped {len(failures)} of {len(folders)} COLMAP models: {some}", stacklevel=3)
        return readable


class ColmapSource:
    """Source of problems from the images of COLMAP models.

    A problem has the keypoints of an image with a 3D point, these points, and clutter without correspondence. Units are
    the scene's. An image with fewer matches than `min_points` is skipped, with a warning. An image whose points lie
    more than 100 times their extent from the origin, as in a geo-referenced scene, gets their median as its origin,
    because float32 has 7 digits; a warning logs the number of such images.

    `clutter` is a ratio to the matches: keypoints without a 3D point, and points of the scene that the image does not
    see, or all if there are fewer. They are drawn uniformly, by (seed, epoch, index).
    """

    def __init__(
        self,
        reconstructions: Sequence[Reconstruction],
        *,
        min_points: int = 4,
        clutter: float = 0.0,
        y_down: bool = False,
        seed: Sequence[int] = (0,),
    ) -> None:
        check_clutter(clutter)
        images = [(scene, image) for scene in reconstructions for image in scene.images]
        names = ", ".join(scene.name for scene in reconstructions)
        matched = np.array([len(image.seen) for _, image in images])
        self.images = [images[i] for i in has_enough_matches(matched, min_points, names)]
        self.clutter, self.y_down, self.seed = clutter, y_down, tuple(seed)
        self.origins = [_origin(scene.points3d[image.seen]) for scene, image in self.images]
        if moved := sum(bool(origin.any()) for origin in self.origins):
            logger.warning(
                "%d of %d images of %s see points that are far from the origin for float32: points and poses of these "
                "problems are relative to the median of the points",
                moved,
                len(self.images),
                names,
            )

    @property
    def counts(self) -> Counts:
        """Numbers of points of each problem."""
        matched = np.array([len(image.seen) for _, image in self.images])
        free = np.array([self._free(scene, image) for scene, image in self.images])
        return Counts(matched, matched + free[:, 0], matched + free[:, 1])

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Return problems; see `ProblemSource.batch`."""
        return stack_problems([self.problem(i, epoch) for i in index.tolist()], index)

    def problem(self, index: int, epoch: int = 0) -> Problem:
        """Return the problem of one image."""
        scene, image = self.images[index]
        rng = np.random.default_rng([*self.seed, epoch, index])
        free2d, free3d = self._free(scene, image)
        clutter2d = image.clutter2d[rng.choice(len(image.clutter2d), free2d, replace=False)]
        unseen = np.delete(np.arange(len(scene.points3d)), image.observed) if free3d else image.seen[:0]
        chosen = np.concatenate([image.seen, rng.choice(unseen, free3d, replace=False)])
        origin = self.origins[index]
        turn = turn_y_down(scene, image) if self.y_down else np.eye(3)
        return Problem(
            name=f"{scene.name}/{image.name}",
            points2d=np.concatenate([image.points2d, clutter2d]),
            points3d=((scene.points3d[chosen] - origin) @ turn.T).astype(np.float32),
            matched=len(image.seen),
            rotation=image.rotation @ turn.T,
            translation=image.translation + image.rotation @ origin,
            focal=image.camera.focal,
            origin=origin,
        )

    def _free(self, scene: Reconstruction, image: ImagePoints) -> tuple[int, int]:
        """Return the number of points without correspondence on the 2D side and on the 3D side."""
        wanted = self.clutter * len(image.seen)
        free3d = len(scene.points3d) - len(image.observed)
        return round(min(wanted, len(image.clutter2d))), round(min(wanted, free3d))


def _origin(points3d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of the points if they are far from the origin, else the origin."""
    median = np.median(points3d, axis=0)
    extent = np.median(np.linalg.norm(points3d - median, axis=-1))
    return median if np.linalg.norm(median) > FAR * extent else np.zeros(3)


def turn_y_down(scene: Reconstruction, photo: ImagePoints) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that turns the direction down of the map's other photos to the second axis.

    Identity if they have no common direction.
    """
    others = [image.rotation for image in scene.images if image is not photo]
    up = common_up(np.array(others)) if others else None
    if up is None:
        return np.eye(3)
    axis = np.cross(up, [0.0, -1.0, 0.0])
    sine, cosine = float(np.linalg.norm(axis)), float(-up[1])
    if sine == 0:  # a half turn about the first axis, or none
        return np.diag([1.0, np.copysign(1, cosine), np.copysign(1, cosine)])
    return Rotation.from_rotvec(math.atan2(sine, cosine) / sine * axis).as_matrix()


def colmap_recipe(source: Path, *, min_points: int, clutter: float) -> Recipe:
    """Return the recipe of the store of all images of all COLMAP models in a folder.

    Images with fewer than `min_points` matches, and models that cannot be read, are left out and listed in the store.
    Natural clutter is kept on both sides, as a ratio to the matches.
    """
    models = [(scene, *model) for scene, models in find_scenes(source).items() for model in models.items()]
    files = (folder / f"{file}.{suffix}" for _, _, folder in models for file in FILES for suffix in ("bin", "txt"))
    names = [name for _, name, _ in models]
    return Recipe(
        kind=PROBLEMS,
        widths=WIDTHS,
        parameters={
            "min_points": min_points,
            "clutter": clutter,
            "source": fingerprint([names, file_states(file for file in files if file.is_file())]),
        },
        jobs=[(*model, min_points, clutter) for model in models],
        work=model_rows,
        what="image",
        source=str(source),
    )


def model_rows(scene: str, name: str, folder: Path, min_points: int, clutter: float) -> JobResult:
    """Return the problems of one COLMAP model, none if it cannot be used.

    Each row has the name of its image, its camera as JSON and the folder of the model, from which its photo is found.
    Unused parts are listed in the result instead of logged, because there may be hundreds of models.
    """
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"):
            reconstruction = read_reconstruction(folder, name=name)
            source = ColmapSource([reconstruction], min_points=min_points, clutter=clutter)
    except (ColmapError, StoreError) as error:
        return [], {name: str(error)}
    finally:
        logging.disable(disabled)
    total, skipped = len(reconstruction.images), {}
    if left_out := total - len(source.images):
        skipped[f"{name}/*"] = f"{left_out} of {total} images with fewer than {min_points} points"
    if reconstruction.notable:
        skipped[f"{name}/points"] = reconstruction.notable
    rows: list[StoreRow] = []
    for i, (_, image) in enumerate(source.images):
        row_name, points, columns = problem_row(scene, source.problem(i))
        photo = {"image": image.name, "camera": json.dumps(camera_to_json(image.camera)), "model": str(folder)}
        rows.append((row_name, points, {**columns, **photo}))
    return rows, skipped
