"""Photos of COLMAP models against points that other views of the model see, with natural outliers: GoMatch's protocol.

Zhou, Agostinho, Osep, Leal-Taixe, "Is geometry enough for matching in visual localization?", ECCV 2022, section 5.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from record import Array, Pose

from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction, read_reconstruction
from bpnp.maps.scene_map import SceneMap
from bpnp.maps.views import View

REPORTED = ("fountain-P11", "south_building", "tabletop", "walk_4", "walkthrough")  # no constant was chosen on them
LEAST_OVERLAP = 0.35
MOST_POINTS = 1024
LEAST_MATCHES = 10  # fewer matches count as a failure


@dataclass(frozen=True, eq=False)
class ViewProblem:
    """A photo's keypoints (m, 2), normalised, and the points (n, 3) of its views; match3d (n,), -1 for no partner.

    pose: of the photo. views: names of the k views in `scene`, most overlap first. focal: pixels. scene: the map
    without the photo, of these points alone, in this order.
    """

    name: str
    points2d: Array
    points3d: Array
    match3d: NDArray[np.int64]
    pose: Pose
    views: tuple[str, ...]
    focal: float
    scene: SceneMap

    @property
    def matches(self) -> int:
        return int((self.match3d >= 0).sum())

    @property
    def pixels(self) -> tuple[Array, Array]:
        """Keypoints (m, 2) from the principal point, and the camera's matrix."""
        return self.focal * self.points2d, np.diag([self.focal, self.focal, 1.0])

    @property
    def distance(self) -> float:
        """Of the median point from the photo."""
        return median_distance(self.points3d, self.pose)

    @property
    def seen(self) -> Array:
        """Points that have a partner."""
        return self.points3d[self.match3d >= 0]


def median_distance(points3d: Array, pose: Pose) -> float:
    """Of the points from a camera."""
    return float(np.median(np.linalg.norm(points3d @ pose[0].T + pose[1], axis=-1)))


def photos(scene: Reconstruction, limit: int) -> list[ImagePoints]:
    """At most `limit` photos, spread evenly over those that have a view of enough overlap."""
    usable = [image for image in scene.images if len(overlapping(scene, image))]
    return [usable[k] for k in sorted({int(k * len(usable) / limit) for k in range(limit)})]


def overlapping(scene: Reconstruction, query: ImagePoints) -> list[tuple[float, ImagePoints]]:
    """The views that see at least `LEAST_OVERLAP` of the photo's points, and this share, largest first."""
    seen = np.zeros(len(scene.points3d), bool)
    seen[query.seen] = True
    shares = [
        (float(seen[view.seen].sum() / max(len(query.seen), 1)), view) for view in scene.images if view is not query
    ]
    return sorted((pair for pair in shares if pair[0] >= LEAST_OVERLAP), key=lambda pair: -pair[0])


def view_problem(
    scene: Reconstruction, query: ImagePoints, *, views: int, outliers: float, seed: int = 0,
    most: int | None = MOST_POINTS, best: bool = False,
) -> ViewProblem:  # fmt: skip
    """One photo against the points that `views` views see, or, for 0, all points of the map.

    outliers: of each side at most this share of all points is without a partner; 1 for all that there are.
    most: keypoints, and points that one view sees; matches and outliers are thinned alike, so that their ratio
    stays. None for all.
    For one view it is drawn among those that overlap enough; for more, and if `best`, they are the ones that overlap
    most.
    """
    rng = np.random.default_rng([seed, query.image_id])
    candidates = [view for _, view in overlapping(scene, query)]
    chosen = [candidates[rng.integers(len(candidates))]] if views == 1 and not best else candidates[:views]
    shown = chosen or [view for view in scene.images if view is not query]
    # Points that the photo alone holds together with one view would not be in the map without it.
    tracks = np.bincount(np.concatenate([image.observed for image in scene.images]), minlength=len(scene.points3d))
    tracks[query.observed] -= 1
    in_map = np.unique(np.concatenate([view.seen for view in shown]))
    in_map = in_map[tracks[in_map] >= 2]
    true, place, _ = np.intersect1d(query.seen, in_map, assume_unique=True, return_indices=True)
    others2d = np.concatenate([np.delete(query.points2d, place, 0), query.clutter2d])
    others3d = np.setdiff1d(in_map, query.observed)
    allowed = np.inf if outliers >= 1 else len(true) * outliers / (1 - outliers)
    counts = [len(true), min(len(others2d), allowed), min(len(others3d), allowed)]
    of_one = len(true) + len(others3d) if len(shown) == 1 else max(np.isin(view.seen, in_map).sum() for view in shown)
    larger = max(counts[0] + counts[1], min(counts[0] + counts[2], of_one))
    share = 1.0 if most is None else min(1.0, most / max(larger, 1))
    kept, extra2d, extra3d = (int(count * share) for count in counts)
    pick = rng.choice(len(true), kept, replace=False)
    clutter2d = others2d[rng.choice(len(others2d), extra2d, replace=False)]
    points2d = np.concatenate([query.points2d[place[pick]], clutter2d]).astype(np.float64)
    index3d = np.concatenate([true[pick], rng.choice(others3d, extra3d, replace=False)]).astype(np.int64)
    order2d, order3d = rng.permutation(len(points2d)), rng.permutation(len(index3d))
    match3d = np.full(len(index3d), -1)
    match3d[:kept] = np.argsort(order2d)[:kept]
    index3d = index3d[order3d]
    return ViewProblem(
        f"{scene.name}/{query.name}", points2d[order2d], scene.points3d[index3d], match3d[order3d],
        (query.rotation, query.translation), tuple(view.name for view in chosen), query.camera.focal,
        map_of(scene, query, index3d),
    )  # fmt: skip


def map_of(scene: Reconstruction, query: ImagePoints, points: NDArray[np.int64]) -> SceneMap:
    """The map of some points, in their order, and of all views but the photo."""
    place = np.full(len(scene.points3d), -1, np.int32)
    place[points] = np.arange(len(points))
    views = []
    for view in scene.images:
        if view is not query:
            seen = np.sort(place[view.observed[place[view.observed] >= 0]])
            views.append(View(view.name, view.camera, view.rotation, view.translation, seen))
    return SceneMap(scene.points3d[points], points, np.zeros(len(points), np.int32), tuple(views)).seen_by(1)


def scene_problems(data: Path, name: str, *, limit: int, **chosen: Any) -> Iterator[ViewProblem]:
    """Problems of at most `limit` photos of a scene. chosen: options of `view_problem`."""
    scene = model_of(data, name)
    for query in photos(scene, limit):
        yield view_problem(scene, query, **chosen)


def model_of(data: Path, name: str) -> Reconstruction:
    return read_reconstruction(data / "colmap" / name / "sparse/0", name=name)
