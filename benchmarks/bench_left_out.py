"""Raw photos against a map that was built without them: by keypoints alone, and with descriptors as a yardstick.

    python -m benchmarks left_out castle-P30 fountain-P11 --limit 6

Rows of a scene: views (the three views that share most points are named), map (none is); views-sift and map-sift, the
same with SIFT descriptors, a ratio test and PoseLib; words-sift, with the ten views that a bag of visual words
retrieves. pycolmap builds a map for each photo on the first run and keeps it in --maps. Truth: the pose in the model of
all photos, aligned by the views that both models have.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from descriptor_poses import DescribedMap
from rebuilt_maps import PhotoScene, aligned
from record import TIME_LIMIT, Problem, Row, parser, run, spread
from view_problems import median_distance

from bpnp import SceneMap, Solution
from bpnp.maps.photos import detected_keypoints

CAMERA = (1379.7, 1382.1, 760.3, 503.4)  # of the photos at half size, pixels
FEATURES = 2048  # of a photo in the maps, the largest
VIEWS = 3
RIGHT_DEG = 1.0


def problems_of(scene: PhotoScene, photo: str, full: SceneMap, seed: int) -> dict[str, Problem]:
    """By method, of one photo that is left out of its map; reading and detecting is done before."""
    place, found = SceneMap.from_colmap(scene.without(photo)), detected_keypoints(scene.photos / photo)
    (true,) = full.named([photo])
    shared = np.array([np.isin(view.points, true.points).sum() for view in full.views])
    likely = [full.views[i].name for i in np.argsort(-shared, kind="stable")]
    views = [name for name in likely if name != photo and name in place.view_numbers][:VIEWS]
    far = median_distance(full.points3d[true.points], (true.rotation, true.translation))
    alignment = aligned(full, place)
    described = DescribedMap(scene.without(photo), scene.database)
    known: dict[str, Any] = {"scores": found.scores, "seed": seed, "time_limit": TIME_LIMIT}
    searches: dict[str, Callable[[], Solution]] = {}
    for method, named in (("views", views), ("map", None)):
        searches[method] = partial(place.localize, found.pixels, ("PINHOLE", CAMERA), views=named, **known)
        searches[f"{method}-sift"] = partial(described.localize, photo, CAMERA, named)
    _ = described.words  # made before the first photo
    searches["words-sift"] = lambda: described.localize(photo, CAMERA, described.retrieved(photo))
    name, pose = f"{scene.photos.name}/{photo}", alignment.pose(true.rotation, true.translation)
    return {
        method: Problem(name, search, [pose], distance=far * alignment.scale) for method, search in searches.items()
    }


def rows(options: argparse.Namespace) -> Iterator[Row]:
    for name in options.scenes:
        kept = options.maps / f"{name}-{FEATURES}"
        scene = PhotoScene(options.data / "photos" / name, kept, CAMERA, FEATURES)
        full = SceneMap.from_colmap(scene.full())
        chosen = spread([photo for photo in scene.names() if photo in full.view_numbers], options.limit)
        drawn = [problems_of(scene, photo, full, options.seed) for photo in chosen]
        for method in drawn[0]:
            yield Row(f"{name}, {method}", partial(list, [one[method] for one in drawn]), RIGHT_DEG)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="+", metavar="SCENE")
    options.add_argument("--maps", type=Path, default=Path("runs/left-out"), help="folder of the maps that are built")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
