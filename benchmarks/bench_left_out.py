"""Raw photos against a map that was built without them: by keypoints alone, and with descriptors as a yardstick.

    python -m benchmarks left_out castle-P30 fountain-P11 --limit 6

Methods: views (the three views that share most points are named), map (none is); views-sift and map-sift, the same
with SIFT descriptors, a ratio test and PoseLib; words-sift, with the ten views that a bag of visual words retrieves.
pycolmap builds a map for each photo on the first run and keeps it in --maps. Truth: the pose in the model of all
photos, aligned by the views that both models have.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from descriptor_poses import DescribedMap
from rebuilt_maps import PhotoScene, aligned
from record import TIME_LIMIT, Outcome, Rows, measured, parser, solved

from bpnp import SceneMap, Solution
from bpnp.maps.photos import detected_keypoints

CAMERA = (1379.7, 1382.1, 760.3, 503.4)  # of the photos at half size, pixels
FEATURES = 2048  # of a photo in the maps, the largest
VIEWS = 3
METHODS = ("views", "map", "views-sift", "map-sift", "words-sift")
RIGHT_DEG = 1.0


def searches(
    scene: PhotoScene, photo: str, place: SceneMap, views: list[str], methods: Sequence[str], seed: int
) -> dict[str, Callable[[], Solution]]:  # fmt: skip
    """What finds the photo, by method; reading and detecting is done before."""
    found = detected_keypoints(scene.photos / photo)
    described = DescribedMap(scene.without(photo), scene.database) if any("sift" in m for m in methods) else None

    def one(method: str) -> Callable[[], Solution]:
        named = views if method.startswith("views") else None
        if described is not None and method.endswith("-sift"):
            if method == "words-sift":
                described.open()
                return lambda: described.localize(photo, scene.camera, described.retrieved(photo))
            return lambda: described.localize(photo, scene.camera, named)
        return lambda: place.localize(
            found.pixels, ("PINHOLE", scene.camera), views=named, scores=found.scores, seed=seed, time_limit=TIME_LIMIT
        )

    return {method: one(method) for method in methods}


def photo_outcomes(
    scene: PhotoScene, photo: str, full: SceneMap, methods: Sequence[str], seed: int
) -> dict[str, Outcome]:  # fmt: skip
    """By method, of one photo that is left out of its map."""
    place = SceneMap.from_colmap(scene.without(photo))
    (true,) = full.named([photo])
    shared = np.array([np.isin(view.points, true.points).sum() for view in full.views])
    likely = [full.views[i].name for i in np.argsort(-shared, kind="stable")]
    views = [name for name in likely if name != photo and name in place.view_numbers][:VIEWS]
    distance = float(np.median(np.linalg.norm(full.points3d[true.points] - true.centre, axis=1)))
    rotation, centre = aligned(full, place).pose(true.rotation, true.translation)
    unit = distance * aligned(full, place).scale
    return {
        method: solved(f"{scene.photos.name}/{photo}", rotation, -rotation @ centre, search, distance=unit)
        for method, search in searches(scene, photo, place, views, methods, seed).items()
    }


def rows(options: argparse.Namespace) -> Rows:
    for name in options.scenes:
        kept = options.maps / f"{name}-{FEATURES}"
        scene = PhotoScene(options.data / "photos" / name, kept, tuple(options.camera), FEATURES)
        full = SceneMap.from_colmap(scene.full())
        photos = [photo for photo in scene.names() if photo in full.view_numbers]
        chosen = [photos[i] for i in sorted({int(k * len(photos) / options.limit) for k in range(options.limit)})]
        found = [photo_outcomes(scene, photo, full, options.methods, options.seed) for photo in chosen]
        for method in options.methods:
            yield f"{name}, {method}", lambda method=method: [one[method] for one in found]  # type: ignore[misc] # noqa: B023


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="+", metavar="SCENE")
    options.add_argument("--maps", type=Path, default=Path("runs/left-out"), help="folder of the maps that are built")
    options.add_argument("--camera", type=float, nargs=4, default=CAMERA, metavar=("FX", "FY", "CX", "CY"))
    options.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    chosen = options.parse_args()
    measured(rows(chosen), chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
