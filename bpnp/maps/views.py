"""The views of a map and the points that they see."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from bpnp.cameras import Camera
from bpnp.maps.cones import Cones, viewing_cones

Array = NDArray[np.float64]
Map = TypeVar("Map", bound="ViewedPoints")
LEAST_TRACK = 2  # views that fix a point; with one left it would not be in the map


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
class ViewedPoints:
    """n points and the views that see them; `bpnp.SceneMap` is such a set, read from a COLMAP model.

    points3d: (n, 3) scene units, in the order of their ids. point_ids: (n,) ids in the COLMAP model.
    track_lengths: (n,) views that see each point. views: in the order of their names.
    """

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]

    @cached_property
    def visibility(self) -> csr_array:
        """(views, n) with 1 where a view sees a point."""
        counts = [len(view.points) for view in self.views]
        columns = np.concatenate([view.points for view in self.views])
        entries = np.ones(len(columns), np.int32), columns, np.concatenate([[0], np.cumsum(counts)])
        return csr_array(entries, shape=(len(self.views), len(self.points3d)))

    @cached_property
    def cones(self) -> Cones:
        """From where each point is seen."""
        return viewing_cones(self.points3d, ((view.centre, view.points) for view in self.views))

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

    def without(self: Map, names: Collection[str]) -> Map:
        """The map as it would be without these views: also points that then fewer than two views see are left out.

        Raises ValueError for a name that the map does not have, or if no view that sees a point is left.
        """
        left_out = {view.name for view in self.named(names)}
        views = [view for view in self.views if view.name not in left_out]
        return replace(self, views=tuple(views)).seen_by(LEAST_TRACK)

    def seen_by(self: Map, least: int) -> Map:
        """Only such points as `least` or more of the views see. Raises ValueError if none is left."""
        tracks = np.zeros(len(self.points3d), np.int32)
        for view in self.views:
            tracks[view.points] += 1
        kept = tracks >= least
        if not kept.any():
            raise ValueError(f"expected points that {least} or more views see, got none in {len(self.views)} views")
        place = np.cumsum(kept, dtype=np.int32) - 1
        views = tuple(replace(view, points=place[view.points[kept[view.points]]]) for view in self.views)
        return type(self)(self.points3d[kept], self.point_ids[kept], tracks[kept], views)
