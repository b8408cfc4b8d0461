"""A map to localise photos in: the points of a COLMAP reconstruction, its views, and which view sees which point."""

import logging
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from bpnp.cameras import Camera, camera_models, colmap_camera
from bpnp.datamodules.colmap.model_files import ColmapError, ModelRecords, read_records

if TYPE_CHECKING:
    from bpnp.search.starts import PosePrior
    from bpnp.solving.solution import Solution

Array = NDArray[np.float64]
LEAST_TRACK = 2  # views that fix a point; with one left it would not be in the map
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class View:
    """A registered image of the map; camera = rotation p + translation (COLMAP's cam_from_world).

    points: (k,) places in `SceneMap.points3d` of the points that it sees, ascending.
    """

    name: str
    camera: Camera
    rotation: Array
    translation: Array
    points: NDArray[np.int32]

    @property
    def centre(self) -> Array:
        """Centre of the camera in the scene, -R^T t."""
        return -self.rotation.T @ self.translation


@dataclass(frozen=True, eq=False)
class SceneMap:
    """A map of n points and the views that saw them.

    points3d: (n, 3) scene units, in the order of their ids. point_ids: (n,) ids in the COLMAP model.
    track_lengths: (n,) views that see each point. views: in the order of their names.

    >>> from bpnp import SceneMap
    >>> scene = SceneMap.from_colmap("sparse/0")  # doctest: +SKIP
    >>> solution = scene.localize(keypoints, ("SIMPLE_PINHOLE", (1380, 768, 512)))  # doctest: +SKIP
    >>> solution.verdict, solution.view, solution.matches  # doctest: +SKIP
    """

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]

    @classmethod
    def from_colmap(cls, path: str | Path) -> "SceneMap":
        """The map in a folder of cameras, images and points3D, all .bin or all .txt.

        Not used, and logged as a warning: images with a broken pose, and points that are not finite. A view without
        points stays in the map. Keypoints are not kept: 10^6 points and 10^4 views of 1,000 points take 80 MB.
        Raises ColmapError, a ValueError, for a model that cannot be read or has no view that sees a point.
        """
        folder = Path(path)
        return _scene_map(folder, read_records(folder, camera_models=camera_models()))

    @cached_property
    def visibility(self) -> csr_array:
        """(views, n) with 1 where a view sees a point."""
        counts = [len(view.points) for view in self.views]
        columns = np.concatenate([view.points for view in self.views])
        entries = np.ones(len(columns), np.int32), columns, np.concatenate([[0], np.cumsum(counts)])
        return csr_array(entries, shape=(len(self.views), len(self.points3d)))

    @cached_property
    def covisibility(self) -> csr_array:
        """(views, views): how many points two views both see."""
        return csr_array(self.visibility @ self.visibility.T)

    @cached_property
    def view_numbers(self) -> dict[str, int]:
        """Places in `views` by name."""
        return {view.name: i for i, view in enumerate(self.views)}

    def named(self, names: Iterable[str]) -> list[View]:
        """The views of these names. Raises ValueError for one that the map does not have."""
        wanted = list(names)
        if unknown := [name for name in wanted if name not in self.view_numbers]:
            some = ", ".join(view.name for view in self.views[:5])
            raise ValueError(f"expected names of views of the map, got {', '.join(unknown[:5])}; try {some}, ...")
        return [self.views[self.view_numbers[name]] for name in wanted]

    def without(self, names: Collection[str]) -> "SceneMap":
        """The map as it would be without these views: also points that then fewer than two views see are left out.

        Raises ValueError for a name that the map does not have, or if no view that sees a point is left.
        """
        left_out = {view.name for view in self.named(names)}
        views = [view for view in self.views if view.name not in left_out]
        return _with_points_of(replace(self, views=tuple(views)), LEAST_TRACK)

    def localize(
        self,
        keypoints: Any,
        camera: Any,
        *,
        views: Iterable[str] | None = None,
        scores: Any = None,
        prior: "PosePrior | None" = None,
        seed: int = 0,
        time_limit: float | None = None,
    ) -> "Solution":
        """The pose of a photo from its keypoints alone; see `bpnp.maps.localize.localize`."""
        from bpnp.maps.localize import localize

        return localize(
            self, keypoints, camera, views=views, scores=scores, prior=prior, seed=seed, time_limit=time_limit
        )  # fmt: skip


def _scene_map(folder: Path, records: ModelRecords) -> SceneMap:
    order = np.argsort(records.point_ids)
    finite = np.isfinite(records.points3d[order]).all(-1)
    order = order[finite]
    ids, points3d = records.point_ids[order], records.points3d[order]
    cameras: dict[int, Camera] = {}
    views, broken = [], 0
    for record in sorted(records.images, key=lambda image: image.name):
        if not np.isfinite([*record.quaternion, *record.translation]).all() or not record.quaternion.any():
            broken += 1
            continue
        if record.camera_id not in cameras:
            cameras[record.camera_id] = _camera(folder, records, record.camera_id)
        observed = np.unique(record.point_ids[record.point_ids >= 0])
        place = np.minimum(np.searchsorted(ids, observed), max(len(ids) - 1, 0))
        views.append(
            View(
                name=record.name,
                camera=cameras[record.camera_id],
                rotation=Rotation.from_quat(np.roll(record.quaternion, -1)).as_matrix(),
                translation=record.translation,
                points=place[ids[place] == observed].astype(np.int32) if len(ids) else np.empty(0, np.int32),
            )
        )
    if broken or not finite.all():
        logger.warning(
            "not used in %s: %d images with a broken pose, %d points not finite", folder, broken, (~finite).sum()
        )
    if not any(len(view.points) for view in views):
        raise ColmapError(
            f"expected a map with views that see points in {folder}, got {len(views)} views and {len(ids)} points; "
            "try a model with registered images"
        )
    return _with_points_of(SceneMap(points3d, ids, np.zeros(len(ids), np.int32), tuple(views)), 1)


def _with_points_of(scene: SceneMap, least: int) -> SceneMap:
    """The map with such points as `least` or more of its views see. Raises ValueError if none is left."""
    tracks = np.zeros(len(scene.points3d), np.int32)
    for view in scene.views:
        tracks[view.points] += 1
    kept = tracks >= least
    if not kept.any():
        raise ValueError(f"expected points that {least} or more views see, got none in {len(scene.views)} views")
    place = np.cumsum(kept, dtype=np.int32) - 1
    views = tuple(replace(view, points=place[view.points[kept[view.points]]]) for view in scene.views)
    return SceneMap(scene.points3d[kept], scene.point_ids[kept], tracks[kept], views)


def _camera(folder: Path, records: ModelRecords, number: int) -> Camera:
    record = records.cameras.get(number)
    if record is None:
        raise ColmapError(f"expected camera {number} of an image in {folder}, got no such camera; try another model")
    try:
        return colmap_camera(record.model, record.params)
    except ValueError as error:
        raise ColmapError(f"camera {number} in {folder}: {error}; try another model") from error
