"""Unknown focal length: photos in whole maps, and LEDs.

    python -m benchmarks focal maps --limit 6 --seed 42

Rows: maps (photos removed from their map, no view given), lenses (the same with a radial distortion from -0.3 to 0.3;
for sceaux_castle_txt and statue_of_liberty that of their own camera), leds (10 or more are visible).

Success: rotation within 1.5 degrees, for LEDs within 3. A line has the fraction with a focal length within 3 %, the
number of confident poses that are more than 3 degrees off, and the number of confident poses whose focal length is off
by more than three standard deviations or whose centre is off by more than 3 % of the depth.

--limit: problems per scene, or per setting of LEDs. Constants were chosen on statue_of_liberty and sceaux_castle_txt.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from leds import Setting, frames
from record import Problem, Row, parser, run
from view_problems import (
    REPORTED,
    ViewProblem,
    images_of,
    median_distance,
    model_of,
    scene_problems,
    view_problem,
)

from bpnp.arrays import Array
from bpnp.cameras import camera_from, image_size

RIGHT_DEG = {"maps": 1.5, "lenses": 1.5, "leds": 3.0}
RADIAL = (-0.3, -0.15, -0.05, 0.0, 0.07, 0.15, 0.3)
DISTORTED = ("sceaux_castle_txt", "statue_of_liberty")  # models whose own cameras have radial distortion
SCENES = (*REPORTED, "statue_of_liberty")
LEDS = [Setting(f"{kind}, {n} lights, 10 seen", kind, n, least=10) for kind in ("ring", "headset") for n in (0, 3)]


def of_photos(options: argparse.Namespace) -> Iterator[Problem]:
    settings: dict[str, Any] = {"against": "map", "outliers": 1.0, "seed": options.seed}
    for photo in scene_problems(options.data, options.scenes, options.limit, **settings):
        (pixels, size), distance = image_of(photo), median_distance(photo.points3d[photo.matched], photo.pose)
        search = partial(
            photo.scene.localize, pixels, image_size=size, seed=options.seed, time_limit=options.time_limit
        )
        yield Problem(photo.name, search, [photo.pose], distance=distance, focal=photo.focal)


def distorted_photos(options: argparse.Namespace) -> Iterator[Problem]:
    """Yield photos in whole maps whose keypoints are distorted by a lens, those within the image."""
    settings: dict[str, Any] = {"against": "map", "outliers": 1.0, "seed": options.seed}
    for name in options.scenes:
        scene = model_of(options.data, name)
        for k, query in enumerate(images_of(scene, options.limit)):
            photo, size = view_problem(scene, query, **settings), image_size(query.camera)
            assert size is not None
            centre, radial = (size[0] / 2, size[1] / 2), RADIAL[(k + options.seed) % len(RADIAL)]
            lens, kind = camera_from(("SIMPLE_RADIAL", (photo.focal, *centre, radial))), f"{radial}"
            if name in DISTORTED:
                lens, kind = query.camera, "own lens"
            pixels = lens.project(np.column_stack([photo.points2d, np.ones(len(photo.points2d))]))
            inside = ((pixels >= 0) & (pixels <= size)).all(-1) & np.isfinite(
                lens.normalise(np.nan_to_num(pixels))
            ).all(-1)
            search_options: dict[str, Any] = {
                "image_size": size,
                "seed": options.seed,
                "time_limit": options.time_limit,
            }
            search = partial(photo.scene.localize, pixels[inside], **search_options)
            distance = median_distance(photo.points3d[photo.matched], photo.pose)
            yield Problem(f"{photo.name}, {kind}", search, [photo.pose], distance=distance, focal=lens.focal)


def image_of(photo: ViewProblem) -> tuple[Array, tuple[int, int]]:
    """Return keypoints (m, 2), pixels, and the size of an image that is centred on the principal point and contains
    them: that of the map's images if it is large enough.
    """
    pixels = photo.focal * photo.points2d
    sizes = [size for view in photo.scene.views if (size := image_size(view.camera))]
    width, height = np.max([2 * np.ceil(np.abs(pixels).max(0)), *sizes[:1]], 0).astype(int).tolist()
    return pixels + np.array([width / 2, height / 2]), (width, height)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    if options.what == "maps":
        yield Row("whole map", partial(of_photos, options), RIGHT_DEG["maps"])
        return
    if options.what == "lenses":
        yield Row("whole map, distorted", partial(distorted_photos, options), RIGHT_DEG["lenses"])
        return
    for k, setting in enumerate(LEDS):
        size = setting.camera.size, setting.camera.size
        arguments: dict[str, Any] = {"image_size": size, "seed": options.seed, "time_limit": options.time_limit}
        drawn = partial(frames, setting, k, options.limit, options.seed, **arguments)
        yield Row(setting.name, drawn, RIGHT_DEG["leds"])


def main() -> None:
    options = parser(__doc__)
    options.add_argument("what", choices=RIGHT_DEG, help="kind of problems")
    options.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE", help="models of the photos")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
