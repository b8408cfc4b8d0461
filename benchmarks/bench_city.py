"""Photos without descriptors or a view in maps merged to one city: recall, CPU seconds and memory against its views.

    python -m benchmarks city --views 477 1000 3000 10000 --limit 12
    python -m benchmarks city --twice 0.1

The models of --scenes lie at random places, rotations and scales; changed copies of them make up the number of views
(`cities.py`). Photos of the scenes of --photos are left out with all points that then fewer than two views see. Right
is within 5 degrees, the centre within a tenth of the distance. --twice: every place is there twice, this share of the
points of the second one gone; a confident pose in it is wrong, and no pose there is right. A row begins with the rank
of the views (`bpnp.maps.ranking`): of how many photos one of the first 1, 10 and 50 views is turned by less than 30
degrees and lies within half the distance.
"""

import argparse
import resource
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from bench_views import REPORTED
from cities import CityPhoto, city
from record import TIME_LIMIT, Outcome, Rows, degrees, measured, parser, solved

from bpnp import SceneMap, warm_up
from bpnp.cameras import camera_from
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.maps.views import View

RIGHT_DEG, RIGHT_SHIFT = 5.0, 0.1
NEAR_DEG, NEAR_SHIFT = 30.0, 0.5  # of a view that shows about what a photo shows
FIRST = (1, 10, 50)
VIEWS = (477, 1000, 3000, 10_000)


def opened(scene: SceneMap) -> float:
    """CPU seconds of what a map does before its first photo."""
    start = time.process_time()
    _ = scene.cones, scene.pictures
    return time.process_time() - start


def ranked(scene: SceneMap, photos: Sequence[CityPhoto]) -> str:
    """Shares of the photos that have a view near by among the first of the rank, and its milliseconds a view."""
    places, start = [], time.process_time()
    for photo in photos:
        places.append(scene.places(None, photo.points2d, camera_from(np.eye(3))))
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


def outcomes(scene: SceneMap, photos: Sequence[CityPhoto], seed: int, limit: float) -> list[Outcome]:
    seconds, rank, found = opened(scene), ranked(scene, photos), []
    for photo in photos:
        camera = np.diag([photo.focal, photo.focal, 1.0])
        search = partial(scene.localize, photo.focal * photo.points2d, camera, seed=seed, time_limit=limit)
        found.append(solved(photo.name, *photo.poses[0], search, distance=photo.distance))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"opened in {seconds:.2g} CPU s, {memory:.2g} GB, {rank}", end="; ")
    return found


def rows(options: argparse.Namespace) -> Rows:
    scenes = [read_reconstruction(folder, name=folder.parents[1].name) for folder in folders(options)]
    wanted = dict.fromkeys(options.photos, -(-options.limit // len(options.photos)))
    for views in options.views if options.twice is None else [0]:
        scene, photos = city(scenes, wanted, views, options.seed, twice=options.twice)
        name = f"{len(scene.views):,} views, {len(scene.points3d):,} points"
        yield name, partial(outcomes, scene, photos[: options.limit], options.seed, options.time_limit)


def folders(options: argparse.Namespace) -> list[Path]:
    """Those of the models: given ones, or all in the folder of the data."""
    models = options.data / "colmap"
    return [models / name / "sparse/0" for name in options.scenes or sorted(path.name for path in models.iterdir())]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help="models of the city (default: all of the data)")
    options.add_argument("--photos", nargs="+", default=REPORTED, metavar="SCENE", help="scenes of the photos")
    options.add_argument("--views", type=int, nargs="+", default=VIEWS, help="of the cities")
    options.add_argument("--twice", type=float, help="every place twice, this share of the points of one gone")
    options.add_argument("--time-limit", type=float, default=TIME_LIMIT, help="seconds a photo (default: %(default)s)")
    chosen = options.parse_args()
    warm_up()
    measured(rows(chosen), chosen, RIGHT_DEG, RIGHT_SHIFT)


if __name__ == "__main__":
    main()
