"""Photos without descriptors or a given view, in maps merged to one city: recall, CPU seconds and memory by map size.

    python -m benchmarks city --views 477 1000 3000 10000 --limit 12
    python -m benchmarks city --twice 0.1

The models of the data, or those that are named, are placed at random with random rotations and scales. Changed copies
of them fill the city up to the number of views. In a copy the points are displaced along a smooth field by a tenth of
their distance from the views, a third of them are dropped, and some copies are mirrored. Photos of the scenes of
--photos are removed from the map, with all points that fewer than two of the remaining views see.

Success: rotation within 5 degrees, and the camera centre within a tenth of the distance. With --twice every place
exists twice, and the second copy lacks this fraction of its points; only the pose in the complete copy is correct.

A row begins with the cost of opening the map before the first photo, in CPU seconds and peak memory of a new process:
as a COLMAP model, and with the index of a large map. Then follows the ranking of the views (`bpnp.maps.views`): the
fraction of photos for which one of the first 1, 10 and 50 views is rotated by less than 30 degrees and lies within half
the distance.
"""

import argparse
import multiprocessing
import struct
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from record import Problem, Row, Similarity, degrees, parser, run, spread
from scipy.spatial.transform import Rotation
from view_problems import REPORTED, map_of, median_distance, model_of, part_of

from bpnp import SceneMap, warm_up
from bpnp.arrays import Array, PoseArrays
from bpnp.cameras import camera_from
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction
from bpnp.maps.views import View

RIGHT_DEG, RIGHT_SHIFT = 5.0, 0.1
NEAR_DEG, NEAR_SHIFT = 30.0, 0.5  # of a view that shows about what a photo shows
FIRST = (1, 10, 50)
VIEWS = (477, 1000, 3000, 10_000)
MOVED, WAVES = 0.1, 6  # root mean square of the field, in distances of the view; sine waves in it
DROPPED = 0.3  # fraction of a copy's points
APART = 40.0  # side of the cube in which places lie, in distances of a view, for 10 of them
CAMERA = camera_from(np.eye(3))  # views are looked near by pose alone


class CityPhoto(NamedTuple):
    """A photo that was left out."""

    name: str
    points2d: Array  # all its keypoints (m, 2), normalised
    focal: float
    poses: tuple[PoseArrays, ...]  # the true one, and of a repeated place the one there
    distance: float  # of the median point that it sees


def move_place(place: SceneMap, to: Similarity) -> SceneMap:
    """Return the place in another frame."""
    poses = (to.pose(view.rotation, view.translation) for view in place.views)
    views = (replace(view, rotation=r, translation=t) for view, (r, t) in zip(place.views, poses, strict=True))
    return replace(place, points3d=to.points(place.points3d), views=tuple(views))


def distance_of(place: SceneMap) -> float:
    """Return the median, over the views, of the median distance from a view to the points that it sees."""
    seen = [(place.points3d[view.points], (view.rotation, view.translation)) for view in place.views]
    return float(np.median([median_distance(*one) for one in seen if len(one[0])]))


def change_place(place: SceneMap, rng: np.random.Generator, name: str) -> SceneMap:
    """Return another place of the same kind: points displaced and dropped, or mirrored with all views."""
    unit, points = distance_of(place), place.points3d
    field = np.zeros_like(points)
    for _ in range(WAVES):
        along = rng.standard_normal(3)
        along *= 2 * np.pi / (unit * rng.uniform(0.7, 2.5) * np.linalg.norm(along))
        field += np.sin(points @ along + rng.uniform(0, 2 * np.pi))[:, None] * rng.standard_normal(3)
    field *= MOVED * unit / np.sqrt(WAVES * 3 / 2)
    mirror = np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0])  # of the scene and, so that views stay views, of the image
    views = tuple(
        replace(view, rotation=mirror @ view.rotation @ mirror, translation=mirror @ view.translation)
        for view in place.views
    )
    turned = replace(place, points3d=(points + field) @ mirror, views=views)
    return part_of(turned, np.flatnonzero(rng.random(len(points)) > DROPPED), name)


def anywhere(rng: np.random.Generator, places: int, unit: float) -> Similarity:
    """Return a similarity that scales a view's distance to 0.5 to 2 units and places a scene at random in the city."""
    scale = float(np.exp(rng.uniform(-1, 1) * np.log(2))) / unit
    side = APART * (places / 10) ** (1 / 3)
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.uniform(0, side, 3))


def photos_of(scene: Reconstruction, limit: int) -> list[ImagePoints]:
    """Return at most `limit` photos and a quarter of all, evenly spread over those that see enough shared points."""
    tracks = np.bincount(np.concatenate([image.observed for image in scene.images]), minlength=len(scene.points3d))
    usable = [image for image in scene.images if (tracks[image.observed] >= 3).sum() >= 50]
    return spread(usable, min(limit, len(scene.images) // 4), first=0.5)


def city(
    scenes: Sequence[Reconstruction], photos: dict[str, int], views: int, seed: int, *, twice: float | None = None
) -> tuple[SceneMap, list[CityPhoto]]:
    """Return the map of all scenes, filled with changed copies up to a number of views, and the removed photos.

    At most `photos` of each scene are removed, and the points that fewer than two of the remaining views see. With
    `twice` every place exists twice instead, and the second copy lacks this fraction of its points.
    """
    rng = np.random.default_rng(seed)
    left_out = {scene.name: photos_of(scene, photos.get(scene.name, 0)) for scene in scenes}
    first = [map_of(scene, [image.name for image in left_out[scene.name]]).seen_by(2) for scene in scenes]
    places, found = [], []
    for place, scene in zip(first, scenes, strict=True):
        unit = distance_of(place)
        moves = [anywhere(rng, len(scenes), unit) for _ in range(1 if twice is None else 2)]
        places.append(move_place(place, moves[0]))
        if twice is not None:
            again = part_of(place, np.flatnonzero(rng.random(len(place.points3d)) >= twice), "again/")
            places.append(move_place(again, moves[1]))
        for image in left_out[scene.name]:
            poses = tuple(move.pose(image.rotation, image.translation) for move in moves)
            keypoints = np.concatenate([image.points2d, image.clutter2d]).astype(np.float64)
            far = median_distance(scene.points3d[image.seen], (image.rotation, image.translation))
            name, keypoints = f"{scene.name}/{image.name}", rng.permutation(keypoints)
            found.append(CityPhoto(name, keypoints, image.camera.focal, poses, moves[0].scale * far))
    if twice is None:
        places += copies(first, views - sum(len(place.views) for place in places), views, rng)
    return merge_places(places), found


def copies(first: Sequence[SceneMap], more: int, views: int, rng: np.random.Generator) -> Iterator[SceneMap]:
    """Yield changed copies of the places in turn, with at most a number of views."""
    number = 0
    while more > 0:
        place = change_place(first[number % len(first)], rng, f"copy {number // len(first) + 1}/")
        place = replace(place, views=place.views[:more])
        yield move_place(place, anywhere(rng, len(first) * max(views // 500, 1), distance_of(place)))
        more, number = more - len(place.views), number + 1


def merge_places(places: Sequence[SceneMap]) -> SceneMap:
    """Return one map of all places, with ids in their order."""
    starts = np.cumsum([0] + [len(place.points3d) for place in places])
    views = tuple(
        replace(view, points=view.points + np.int32(start))
        for place, start in zip(places, starts, strict=False)
        for view in place.views
    )
    points = np.concatenate([place.points3d for place in places])
    return SceneMap(points, np.arange(len(points)), np.empty(0, np.int32), views).seen_by(1)


def write_map(scene: SceneMap, folder: Path) -> None:
    """Write a map as COLMAP's binary files, with all keypoints in a corner."""
    counts = np.array([len(view.points) for view in scene.views])
    (folder / "cameras.bin").write_bytes(np.array([1, 1, 2, 2], "<u8").tobytes() + np.ones(3).tobytes())
    keypoints = np.zeros(counts.sum(), [("xy", "<f8", 2), ("id", "<u8")])
    keypoints["id"] = np.concatenate([view.points for view in scene.views]) + 1
    with (folder / "images.bin").open("wb") as file:
        file.write(np.uint64(len(counts)).tobytes())
        for number, (view, rows) in enumerate(zip(scene.views, np.split(keypoints, counts.cumsum()[:-1]), strict=True)):
            turn = Rotation.from_matrix(view.rotation).as_quat(scalar_first=True)
            name, pose = f"{number:06d}".encode(), (*turn, *view.translation)
            file.write(struct.pack("<I7dI7sQ", number + 1, *pose, 1, name, len(rows)) + rows.tobytes())
    fields = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    points = np.zeros(len(scene.points3d), fields)
    points["id"], points["xyz"] = np.arange(1, len(points) + 1), scene.points3d
    points["length"] = np.bincount(keypoints["id"].astype(np.int64) - 1, minlength=len(points))
    tracks = np.column_stack([np.repeat(np.arange(1, len(counts) + 1), counts), np.zeros(len(keypoints))])
    tracks = tracks.astype("<u4")[np.argsort(keypoints["id"], kind="stable")]
    with (folder / "points3D.bin").open("wb") as file:
        file.write(np.uint64(len(points)).tobytes())
        for point, track in zip(points, np.split(tracks, points["length"].cumsum()[:-1].astype(np.int64)), strict=True):
            file.write(point.tobytes() + track.tobytes())


def open_map(folder: Path) -> str:
    """Open a map in this process, and return the CPU seconds and the peak memory as text."""
    warm_up()
    start = time.process_time()
    scene = SceneMap.from_colmap(folder)
    _ = scene.cones, scene.pictures
    seconds = time.process_time() - start
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return f"{seconds:.2g} CPU s, {int(status['VmHWM'].split()[0]) / 1e6:.2g} GB"  # ru_maxrss is the parent's too


def rank_views(scene: SceneMap, photos: Sequence[CityPhoto]) -> str:
    """Return the fractions of the photos with a close view among the first ones, and milliseconds per view."""
    start = time.process_time()
    places = [scene.places(None, photo.points2d, CAMERA) for photo in photos]
    seconds = (time.process_time() - start) / len(photos) / len(scene.views)
    first = [
        min((k for k, place in enumerate(order) if is_near(place.view, photo)), default=len(order))
        for photo, order in zip(photos, places, strict=True)
    ]
    shares = " / ".join(f"{np.mean(np.array(first) < most):.0%}" for most in FIRST)
    return f"rank {shares} in {1e3 * seconds:.2g} ms a view"


def is_near(view: View, photo: CityPhoto) -> bool:
    return any(
        degrees(view.rotation, rotation) < NEAR_DEG
        and np.linalg.norm(view.centre + rotation.T @ translation) < NEAR_SHIFT * photo.distance
        for rotation, translation in photo.poses
    )


def problems(scene: SceneMap, photos: Sequence[CityPhoto], seed: int, time_limit: float) -> Iterator[Problem]:
    with tempfile.TemporaryDirectory() as folder, multiprocessing.get_context("spawn").Pool(1, None, (), 1) as pool:
        write_map(scene, Path(folder))
        first, again = pool.map(open_map, [Path(folder)] * 2, chunksize=1)
    _ = scene.cones, scene.pictures  # before the first photo
    print(f"opened in {first}, again {again}, {rank_views(scene, photos)}", end="; ", flush=True)
    for photo in photos:
        pixels, camera = photo.focal * photo.points2d, np.diag([photo.focal, photo.focal, 1.0])
        search = partial(scene.localize, pixels, camera, seed=seed, time_limit=time_limit)
        yield Problem(photo.name, search, photo.poses[:1], distance=photo.distance)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    names = options.scenes or sorted(path.name for path in (options.data / "colmap").iterdir())
    if missing := set(options.photos) - set(names):
        raise SystemExit(f"photos of {', '.join(sorted(missing))}: not a model of this city; name others with --photos")
    scenes = [model_of(options.data, name) for name in names]
    wanted = dict.fromkeys(options.photos, -(-options.limit // len(options.photos)))
    for views in options.views if options.twice is None else [0]:
        scene, photos = city(scenes, wanted, views, options.seed, twice=options.twice)
        name = f"{len(scene.views):,} views, {len(scene.points3d):,} points"
        drawn = partial(problems, scene, photos[: options.limit], options.seed, options.time_limit)
        yield Row(name, drawn, RIGHT_DEG, RIGHT_SHIFT)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help="models of the city (default: all of --data)")
    options.add_argument(
        "--photos",
        nargs="+",
        default=REPORTED,
        metavar="SCENE",
        help="models whose photos are localised (default: %(default)s)",
    )
    options.add_argument(
        "--views", type=int, nargs="+", default=VIEWS, help="numbers of views of the cities; not with --twice"
    )
    options.add_argument("--twice", type=float, help="fraction of the points that the second copy of each place lacks")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
