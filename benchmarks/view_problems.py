"""Photos of COLMAP models against points that other views of the model see, with natural outliers: GoMatch's protocol.

Zhou, Agostinho, Osep, Leal-Taixe, "Is geometry enough for matching in visual localization?", ECCV 2022, section 5.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from record import Problem, spread

from bpnp import solve
from bpnp.arrays import Array, PoseArrays
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction, read_reconstruction
from bpnp.maps.scene_map import SceneMap
from bpnp.maps.views import View

# No constant was chosen on these, except for two scales of the search near a view, on south_building. walk_4 and
# walkthrough are parts of the same video as walk_2 and walk_6, on which constants were chosen.
REPORTED = ("fountain-P11", "south_building", "tabletop", "walk_4", "walkthrough")
LEAST_OVERLAP = 0.35
MOST_POINTS = 1024
LEAST_MATCHES = 10  # `reliability` and `rigs` leave out photos with fewer


@dataclass(frozen=True, eq=False)
class ViewProblem:
    """Keypoints of a photo and points of its map."""

    name: str
    points2d: Array  # (m, 2), normalised
    points3d: Array  # (n, 3)
    matched: NDArray[np.bool_]  # (n,) which of them the photo sees
    pose: PoseArrays  # of the photo
    view: str | None  # whose points they are, None for those of the whole map
    focal: float  # pixels
    scene: SceneMap  # without the photo, of these points alone, in this order

    @property
    def pixels(self) -> tuple[Array, Array]:
        """Keypoints (m, 2) relative to the principal point, and the camera matrix."""
        return self.focal * self.points2d, np.diag([self.focal, self.focal, 1.0])

    @property
    def distance(self) -> float:
        """Median distance of the points from the photo."""
        return median_distance(self.points3d, self.pose)


def median_distance(points3d: Array, pose: PoseArrays) -> float:
    """Return the median distance of points from a camera."""
    return float(np.median(np.linalg.norm(points3d @ pose[0].T + pose[1], axis=-1)))


def images_of(scene: Reconstruction, limit: int) -> list[ImagePoints]:
    """Return at most `limit` photos, evenly spread over those that have a view with enough overlap."""
    return spread([image for image in scene.images if len(overlapping(scene, image))], limit)


def overlapping(scene: Reconstruction, query: ImagePoints) -> list[tuple[float, ImagePoints]]:
    """Return the views that see at least `LEAST_OVERLAP` of the photo's points, and these fractions, largest first."""
    seen = np.zeros(len(scene.points3d), bool)
    seen[query.seen] = True
    shares = [
        (float(seen[view.seen].sum() / max(len(query.seen), 1)), view) for view in scene.images if view is not query
    ]
    return sorted((pair for pair in shares if pair[0] >= LEAST_OVERLAP), key=lambda pair: -pair[0])


Against = Literal["map", "view", "best view"]


def view_problem(
    scene: Reconstruction, query: ImagePoints, *, against: Against, outliers: float, seed: int = 0
) -> ViewProblem:  # fmt: skip
    """Return the problem of one photo against the points of the whole map, or of one view.

    `against` is "map", "view" (drawn among the views with enough overlap) or "best view" (the one with the largest
    overlap). `outliers` is the largest fraction of the points of each side without a correspondence; 1 keeps all
    points. Against a view, matches and outliers are thinned alike to MOST_POINTS per side, so that their ratio is kept.
    """
    rng = np.random.default_rng([seed, query.image_id])
    view = None
    if against != "map":
        candidates = [view for _, view in overlapping(scene, query)]
        view = candidates[rng.integers(len(candidates)) if against == "view" else 0]
    shown = [image for image in scene.images if image is not query] if view is None else [view]
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
    larger = max(counts[0] + counts[1], counts[0] + counts[2])
    share = 1.0 if view is None else min(1.0, MOST_POINTS / max(larger, 1))
    kept, extra2d, extra3d = (int(count * share) for count in counts)
    pick = rng.choice(len(true), kept, replace=False)
    clutter2d = others2d[rng.choice(len(others2d), extra2d, replace=False)]
    points2d = np.concatenate([query.points2d[place[pick]], clutter2d]).astype(np.float64)
    index3d = np.concatenate([true[pick], rng.choice(others3d, extra3d, replace=False)]).astype(np.int64)
    order2d, order3d = rng.permutation(len(points2d)), rng.permutation(len(index3d))
    index3d = index3d[order3d]
    name, pose = f"{scene.name}/{query.name}", (query.rotation, query.translation)
    return ViewProblem(
        name, points2d[order2d], scene.points3d[index3d], order3d < kept, pose,
        f"{scene.name}/{view.name}" if view else None, query.camera.focal,
        part_of(map_of(scene, [query.name]), index3d).seen_by(1),
    )  # fmt: skip


def map_of(scene: Reconstruction, left_out: Collection[str] = ()) -> SceneMap:
    """Return the points of a model, and its views without some."""
    views = []
    for image in scene.images:
        if image.name not in left_out:
            name, seen = f"{scene.name}/{image.name}", image.observed.astype(np.int32)
            views.append(View(name, image.camera, image.rotation, image.translation, seen))
    return SceneMap(scene.points3d, scene.point_ids, np.empty(0, np.int32), tuple(views))


def part_of(place: SceneMap, points: NDArray[np.integer], name: str = "") -> SceneMap:
    """Return some points, in this order, and all views with those of them that they see; `name` is prefixed to the
    names of the views.
    """
    number = np.full(len(place.points3d), -1, np.int32)
    number[points] = np.arange(len(points))
    seen = ((view, number[view.points]) for view in place.views)
    views = tuple(replace(view, name=name + view.name, points=np.sort(own[own >= 0])) for view, own in seen)
    return SceneMap(place.points3d[points], place.point_ids[points], np.empty(0, np.int32), views)


def scene_problems(data: Path, names: Iterable[str], limit: int, **chosen: Any) -> Iterator[ViewProblem]:
    """Yield problems of at most `limit` photos of each scene. chosen: options of `view_problem`."""
    for scene in (model_of(data, name) for name in names):
        yield from (view_problem(scene, query, **chosen) for query in images_of(scene, limit))


def model_of(data: Path, name: str) -> Reconstruction:
    return read_reconstruction(data / "colmap" / name / "sparse/0", name=name)


def photos(
    against: Against,
    outliers: float,
    limit: int,
    seed: int,
    data: Path,
    *,
    in_map: bool = True,
    apart: bool = False,
    time_limit: float | None = None,
) -> Iterator[Problem]:
    """Yield at most `limit` photos of the reported scenes, without a prior, from a folder with colmap.

    With `in_map` the photo is localised in the map of these points, with the name of the view if there is one;
    otherwise `solve` gets the points alone. With `apart` each photo is put into the map of another problem, half a list
    away. The time limit in seconds is that of `localize` or `solve` by default. The error of a centre is in median
    distances of the points.
    """
    each = -(-limit // len(REPORTED))
    drawn = list(scene_problems(data, REPORTED, each, against=against, outliers=outliers, seed=seed))
    half = len(drawn) // 2 if apart else 0
    for photo, shown in islice(zip(drawn, drawn[half:] + drawn[:half], strict=True), limit):
        pixels, camera = shown.pixels
        search = partial(solve, pixels, photo.points3d, camera, seed=seed, time_limit=time_limit)
        if in_map:
            options: dict[str, Any] = {"views": photo.view and [photo.view], "seed": seed, "time_limit": time_limit}
            search = partial(photo.scene.localize, pixels, camera, **options)
        yield Problem(photo.name, search, [photo.pose], photo.points3d, photo.distance)
