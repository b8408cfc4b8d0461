"""A map to localise photos in, read from a COLMAP reconstruction."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from torch import nn

from bpnp.cameras import Camera
from bpnp.datamodules.colmap.model_files import ColmapError, ModelRecords, read_records
from bpnp.datamodules.colmap.reconstruction import camera_of
from bpnp.maps.localize import localize
from bpnp.maps.views import View, ViewedPoints
from bpnp.search.starts import PosePrior
from bpnp.solving.solution import Solution

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SceneMap(ViewedPoints):
    """A COLMAP reconstruction as a map: its points, its views, and which view sees which point.

    Fields and the choice of views: `bpnp.maps.views.ViewedPoints`.

    >>> from bpnp import SceneMap
    >>> scene = SceneMap.from_colmap("sparse/0")  # doctest: +SKIP
    >>> solution = scene.localize(keypoints, ("SIMPLE_PINHOLE", (1380, 768, 512)))  # doctest: +SKIP
    >>> solution.verdict, solution.view, solution.matches  # doctest: +SKIP
    """

    @classmethod
    def from_colmap(cls, path: str | Path) -> "SceneMap":
        """The map in a folder of cameras, images and points3D, all .bin or all .txt.

        Not used, and logged as a warning: images with a broken pose, and points that are not finite. A view without
        points stays in the map. Keypoints are not kept: 10^6 points and 10^4 views of 1,000 points take 80 MB.
        Raises ColmapError, a ValueError, for a model that cannot be read or has no view that sees a point.
        """
        folder = Path(path)
        return _scene_map(folder, read_records(folder))

    def localize(
        self,
        keypoints: Any,
        camera: Any,
        *,
        views: Iterable[str] | None = None,
        scores: Any = None,
        prior: PosePrior | None = None,
        solver: str | Path | nn.Module = "auto",
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """The pose of a photo from its keypoints alone; see `bpnp.maps.localize.localize`."""
        return localize(
            self, keypoints, camera, views=views, scores=scores, prior=prior, solver=solver, seed=seed,
            time_limit=time_limit,
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
            cameras[record.camera_id] = camera_of(
                records.cameras.get(record.camera_id), f"camera {record.camera_id} of an image in {folder}"
            )
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
    return SceneMap(points3d, ids, np.zeros(len(ids), np.int32), tuple(views)).seen_by(1)
