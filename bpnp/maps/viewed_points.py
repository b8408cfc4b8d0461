"""Points and views of a map: their parts, the order in which views are tried, and the points in view of a pose."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bpnp.argument_types import ArrayLike
from bpnp.arrays import Array
from bpnp.cameras import Camera
from bpnp.maps.upright import count_quarter_turns, rotate_view
from bpnp.maps.views import Cones, Pictures, View, pictures_of_views, places_first, scores_of_views, viewing_cones
from bpnp.poses import MIN_POINTS
from bpnp.search.focal_length import FOCAL_STEP_FEW, UnknownCamera
from bpnp.search.problem import faces
from bpnp.search.starts import PosePrior

VIEWS_AHEAD = 4  # number of views that are tried with one focal length before the next one starts [views; not tuned]
# Standard deviation of the rotation of a photo from that of a view, about the largest angle per axis between photos
# that share a third of their points.
VIEW_SIGMA_DEG = 15.0  # [degrees; not tuned]
# Standard deviation of its translation, about the largest shift of the viewed points, as a fraction of their distance.
VIEW_SIGMA_SHIFT = 0.2  # [fraction; not tuned]
LEAST_TRACK = 2  # least number of views of a point after a view is removed [views; convention]

Map = TypeVar("Map", bound="ViewedPoints")
RankViews = Callable[[Array, Sequence[View]], ArrayLike]  # normalised keypoints (m, 2), views -> scores (views,)


class Place(NamedTuple):
    """A view to search near, the indices (k,) of the points to use, and the camera model or its prior.

    `ViewedPoints.region` makes the `Region` with the points themselves.
    """

    view: View
    points: NDArray[np.integer]
    camera: Camera | UnknownCamera


@dataclass(frozen=True, eq=False)
class Region:
    """Map points that one view, or several, see, and the view to search near."""

    view: View
    points3d: Array  # (k, 3) scene points
    point_ids: NDArray[np.int64]  # (k,) ids of the points in the COLMAP model
    cones: Cones  # cones of directions from which the points are visible
    distance: float  # median distance from the view to its own points, scene units; NaN if it has no points

    def prior(self) -> PosePrior:
        """Return a prior at the view's pose, as wide as the poses of photos of one place differ."""
        return PosePrior(self.view.rotation, self.view.translation, VIEW_SIGMA_DEG, VIEW_SIGMA_SHIFT * self.distance)

    def part(self, points: NDArray[np.integer]) -> "Region":
        """Return the region with only the points of these indices (j,)."""
        cones = Cones(self.cones.axes[points], self.cones.cosines[points])
        return replace(self, points3d=self.points3d[points], point_ids=self.point_ids[points], cones=cones)

    def in_view(self, rotation: Array, translation: Array, camera: Camera, keypoints: Array) -> NDArray[np.int64]:
        """Return the indices of the points visible from a pose, within the bounding box of keypoints (m, 2), pixels."""
        in_camera = self.points3d @ rotation.T + translation
        ahead = (in_camera[:, 2] > 0) & faces(self.cones.axes, self.cones.cosines, in_camera, rotation)
        indices = np.flatnonzero(ahead)
        projected = camera.project(in_camera[indices])
        inside = ((projected >= keypoints.min(0)) & (projected <= keypoints.max(0))).all(-1)  # not NaN
        return indices[inside]


@dataclass(frozen=True, eq=False, repr=False)
class ViewedPoints:
    """Scene points, and the views that see them.

    Attributes:
        points3d: (n, 3) scene points, in the order of their ids.
        point_ids: (n,) ids in the COLMAP model.
        track_lengths: (n,) number of views that see each point.
        views: Views in the order of their names.
    """

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.views):,} views, {len(self.points3d):,} points)"

    @cached_property
    def pictures(self) -> Pictures:
        """Density images of the views, from which their ranks are computed."""
        return pictures_of_views(self.points3d, self.views)

    @cached_property
    def cones(self) -> Cones:
        """Cone of directions from which each point is visible."""
        return viewing_cones(self.points3d, ((view.centre, view.points) for view in self.views))

    @cached_property
    def view_numbers(self) -> dict[str, int]:
        """Indices in `views` by name."""
        return {view.name: i for i, view in enumerate(self.views)}

    def named(self, names: Iterable[str]) -> list[View]:
        """Return the views with some names.

        Args:
            names: Names of views.

        Raises:
            ValueError: A name is not in the map.
        """
        wanted = list(names)
        if unknown := [name for name in wanted if name not in self.view_numbers]:
            some = ", ".join(view.name for view in self.views[:5])
            raise ValueError(f"the map has no views {', '.join(unknown[:5])}; its views are {some}, ...")
        return [self.views[self.view_numbers[name]] for name in wanted]

    def without(self: Map, names: Collection[str]) -> Map:
        """Return the map without some views, and without points that fewer than two of the other views see.

        Args:
            names: Names of the views to remove.

        Raises:
            ValueError: A name is not in the map, or no view that sees a point is left.
        """
        left_out = {view.name for view in self.named(names)}
        views = tuple(view for view in self.views if view.name not in left_out)
        return replace(self, views=views).seen_by(LEAST_TRACK)

    def seen_by(self: Map, least: int) -> Map:
        """Return the map with only the points that enough views see.

        Args:
            least: Smallest number of views that see a point.

        Raises:
            ValueError: No point is left.
        """
        tracks = np.zeros(len(self.points3d), np.int32)
        for view in self.views:
            tracks[view.points] += 1
        enough = tracks >= least
        if not enough.any():
            raise ValueError(f"the map has no points that {least} or more views see, among {len(self.views)} views")
        index = np.cumsum(enough, dtype=np.int32) - 1
        views = tuple(replace(view, points=index[view.points[enough[view.points]]]) for view in self.views)
        return type(self)(self.points3d[enough], self.point_ids[enough], tracks[enough], views)

    def places(
        self,
        views: Iterable[str] | None,
        keypoints: Array,
        camera: Camera | UnknownCamera,
        rank_views: RankViews | None = None,
    ) -> list[Place]:
        """Return the views to search near for a photo's keypoints, in this order.

        With `views` these are the given views in their order. Each gets the points that any of them sees, since they
        show one place. Otherwise they are all views of the map by rank (`bpnp.maps.views`), each with its own points.
        With an unknown focal length several are tried, the likeliest first: each begins `VIEWS_AHEAD` views after
        the one before.
        Views with too few points to fix a pose are skipped.

        Args:
            views: Names of views, best first; None for all views of the map.
            keypoints: (m, 2) pixels.
            camera: Camera model, or its prior if the focal length is unknown.
            rank_views: Function that scores the views, as for `SceneMap.localize`.

        Raises:
            ValueError: A name is unknown, or `views` is empty.
        """
        if views is not None:
            named = self.named(views)
            if not named:
                raise ValueError("`views` is empty; give names of views, or None for all views of the map")
            points = np.unique(np.concatenate([view.points for view in named]))
            return [Place(view, points, camera) for view in named if len(view.points) and len(points) >= MIN_POINTS]
        cameras: list[Camera] = camera.focal_steps(FOCAL_STEP_FEW) if isinstance(camera, UnknownCamera) else [camera]
        scores = self.scores(cameras[0], keypoints, known_focal=isinstance(camera, Camera), rank_views=rank_views)
        order = list(places_first(self.views, scores, len(self.points3d)))
        ahead = VIEWS_AHEAD
        queue = [(rank + ahead * step, step, k) for step in range(len(cameras)) for rank, k in enumerate(order)]
        tried = [camera.near(one) if isinstance(camera, UnknownCamera) else camera for one in cameras]
        return [
            Place(view, view.points, tried[step])
            for _, step, k in sorted(queue)
            if len((view := self.views[k]).points) >= MIN_POINTS
        ]

    def scores(
        self, camera: Camera, keypoints: Array, *, known_focal: bool = True, rank_views: RankViews | None = None
    ) -> NDArray[np.float32]:
        """Return the scores (views,) of the views for a photo's keypoints.

        Args:
            camera: Camera model of the photo.
            keypoints: (m, 2) pixels.
            known_focal: False if the focal length of the camera is a guess. Default True.
            rank_views: Function that scores the views; None for the correlation of the densities of the points
                (`scores_of_views`).

        Raises:
            ValueError: `rank_views` does not return one number per view.
        """
        points2d = camera.normalise(np.asarray(keypoints, np.float64))
        if rank_views is None:
            return scores_of_views(points2d, self.pictures, known_focal=known_focal)
        scores = np.asarray(rank_views(points2d, self.views), np.float32)
        if scores.shape != (len(self.views),) or np.isnan(scores).any():
            what = "NaN" if scores.shape == (len(self.views),) else f"an array of shape {scores.shape}"
            raise ValueError(
                f"`rank_views` returned {what}; one score for each of the {len(self.views)} views is needed"
            )
        return scores

    def region(self, view: View, points: NDArray[np.integer] | None = None) -> Region:
        """Return some points of the map, with the view to search near.

        Args:
            view: View to search near.
            points: (k,) indices of points; None for all points of the map.
        """
        in_camera = self.points3d[view.points] @ view.rotation.T + view.translation
        distance = float(np.median(np.linalg.norm(in_camera, axis=-1))) if len(in_camera) else np.nan
        whole = Region(view, self.points3d, self.point_ids, self.cones, distance)
        return whole if points is None else whole.part(points)

    def ranked_regions(self, camera: Camera, keypoints: Array, rank_views: RankViews | None = None) -> Iterator[Region]:
        """Yield the points seen by each view, in the order of the views' scores for the keypoints of a known camera.

        Several views may show the same place.

        Args:
            camera: Camera of the photo.
            keypoints: (m, 2) pixels.
            rank_views: Function that scores the views, as for `SceneMap.localize`; None for their point density.
        """
        scores = self.scores(camera, keypoints, rank_views=rank_views)
        order = [self.views[k] for k in np.argsort(-scores, kind="stable")]
        yield from (self.region(view, view.points) for view in order if len(view.points) >= MIN_POINTS)

    def match_orientation(self: Map, up_camera: Array) -> Map:
        """Return the map with each view rotated by quarter turns until its up direction is that of a photo.

        Args:
            up_camera: (3,) direction up in the camera frame of the photo.

        Returns:
            The map with rotated views; the map itself if no view needs a rotation.
        """
        quarters = count_quarter_turns(self.views, up_camera)
        if not quarters.any():
            return self
        key = quarters.tobytes()
        if key not in self._rotated_maps:
            views = tuple(map(rotate_view, self.views, quarters.tolist()))
            self._rotated_maps[key] = rotated = replace(self, views=views)
            vars(rotated).update(cones=self.cones)  # cones depend on the view centres only, which are unchanged
        found: Map = self._rotated_maps[key]
        return found

    @cached_property
    def _rotated_maps(self) -> dict[bytes, Any]:
        return {}
