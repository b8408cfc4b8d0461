"""The focal length unknown: photos in whole maps, and LEDs.

    python -m benchmarks focal maps --limit 6 --seed 42

What: maps (photos left out of their map, which view is not told), leds (10 or more of them seen). Right is within 1.5
degrees, of LEDs within 3. A line says for how many the focal length is within 3 %, and how many are confident and more
than 3 degrees off. --limit: problems a scene, or a setting of LEDs.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from leds import Setting, frames
from record import TIME_LIMIT, Array, Problem, Row, parser, run
from view_problems import REPORTED, ViewProblem, median_distance, scene_problems

from bpnp.cameras import image_size

RIGHT_DEG = {"maps": 1.5, "leds": 3.0}
SCENES = (*REPORTED, "statue_of_liberty")
LEDS = [Setting(f"{kind}, {n} lights, 10 seen", kind, n, least=10) for kind in ("ring", "headset") for n in (0, 3)]


def of_photos(options: argparse.Namespace) -> Iterator[Problem]:
    known: dict[str, Any] = {"against": "map", "outliers": 1.0, "seed": options.seed}
    for photo in scene_problems(options.data, options.scenes, options.limit, **known):
        (pixels, size), distance = image_of(photo), median_distance(photo.points3d[photo.matched], photo.pose)
        search = partial(photo.scene.localize, pixels, image_size=size, seed=options.seed, time_limit=TIME_LIMIT)
        yield Problem(photo.name, search, [photo.pose], distance=distance, focal=photo.focal)


def image_of(photo: ViewProblem) -> tuple[Array, tuple[int, int]]:
    """Keypoints (m, 2), pixels, and width and height of an image about the principal point that has them, of the size
    of the map's images where they lie within it."""
    pixels = photo.focal * photo.points2d
    sizes = [size for view in photo.scene.views if (size := image_size(view.camera))]
    width, height = np.max([2 * np.ceil(np.abs(pixels).max(0)), *sizes[:1]], 0).astype(int).tolist()
    return pixels + np.array([width / 2, height / 2]), (width, height)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    if options.what == "maps":
        yield Row("whole map", partial(of_photos, options), RIGHT_DEG["maps"])
        return
    for k, setting in enumerate(LEDS):
        known = {"image_size": (setting.camera.size, setting.camera.size), "seed": options.seed}
        drawn = partial(frames, setting, k, options.limit, options.seed, **known)
        yield Row(setting.name, drawn, RIGHT_DEG["leds"])


def main() -> None:
    options = parser(__doc__)
    options.add_argument("what", choices=RIGHT_DEG)
    options.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE")
    run(rows, options)
