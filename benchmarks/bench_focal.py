"""The focal length unknown: photos in whole maps, against one view, and LEDs; and what a wrong camera is believed.

    python -m benchmarks focal maps --limit 6 --seed 42
    python -m benchmarks focal wrong --limit 3 --factors 0.67 0.8 0.9 0.95 1.05 1.1 1.2 1.33

What: maps (photos left out of their map, which view is not told; beside it with the focal length known), views (photos
against the points of one view), leds (10 or more of them seen), wrong (as maps, told a camera whose focal length is
wrong by each factor). Right is within 1.5 degrees, of LEDs within 3, and of wrong cameras with the centre within a
twentieth of the distance too. A line says for how many the focal length is within 3 %. --limit: problems a scene or
setting.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from bench_constellation import Setting, picture
from bench_views import REPORTED
from record import TIME_LIMIT, Array, Outcome, Rows, measured, parser, solved
from view_problems import MOST_POINTS, ViewProblem, scene_problems

from bpnp import Solution, solve, warm_up
from bpnp.cameras import image_size

RIGHT = {"maps": (1.5, np.inf), "views": (1.5, np.inf), "leds": (3.0, np.inf), "wrong": (1.5, 0.05)}  # degrees, share
SCENES = (*REPORTED, "statue_of_liberty")
FACTORS = (0.67, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.33)
LEDS = [Setting(f"{kind}, {n} lights, 10 seen", kind, n, least=10) for kind in ("ring", "headset") for n in (0, 3)]


def of_photo(problem: ViewProblem, search: Callable[..., Solution], factor: float | None) -> Outcome:
    """A photo with a camera of `factor` times its focal length, or with the image's size alone."""
    pixels, size = image_of(problem)
    camera: dict[str, Any] = {"image_size": size}
    if factor is not None:
        focal = factor * problem.focal
        camera = {"camera": np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])}
    seen = problem.points3d[problem.match3d >= 0] @ problem.rotation.T + problem.translation
    one = solved(
        problem.name, problem.rotation, problem.translation, partial(search, pixels, **camera, time_limit=TIME_LIMIT),
        distance=float(np.median(np.linalg.norm(seen, axis=-1))), focal=np.nan if factor else problem.focal,
    )  # fmt: skip
    return one if factor in (None, 1.0) else replace(one, outside=True)  # a wrong camera's bound is none


def image_of(problem: ViewProblem) -> tuple[Array, tuple[int, int]]:
    """Keypoints (m, 2), pixels, and width and height of an image about the principal point that has them, of the size
    of the map's images where they lie within it."""
    pixels = problem.focal * problem.points2d
    sizes = [size for view in problem.scene.views if (size := image_size(view.camera))]
    width, height = np.max([2 * np.ceil(np.abs(pixels).max(0)), *sizes[:1]], 0).astype(int).tolist()
    return pixels + np.array([width / 2, height / 2]), (width, height)


def photos(options: argparse.Namespace, views: int, factors: Sequence[float | None]) -> Iterator[tuple[str, Any]]:
    """Photos against one view or, for 0, in the whole map."""
    known = {"limit": options.limit, "views": views, "outliers": 0.5 if views else 1.0, "seed": options.seed}
    most = MOST_POINTS if views else None
    problems = [one for name in options.scenes for one in scene_problems(options.data, name, most=most, **known)]

    def outcomes(factor: float | None) -> list[Outcome]:
        found = []
        for one in problems:
            search = partial(solve, points3d=one.points3d) if views else one.scene.localize
            found.append(of_photo(one, partial(search, seed=options.seed), factor))
        return found

    for factor in factors:
        name = "unknown" if factor is None else "known" if factor == 1 else f"x {factor}"
        yield f"{'one view' if views else 'whole map'}, {name}", partial(outcomes, factor)


def leds(setting: Setting, k: int, limit: int, seed: int) -> list[Outcome]:
    rng, found = np.random.default_rng([seed, k]), []
    for i in range(limit):
        shown = picture(setting, 1000 * seed + i // 5, rng)
        size, known = (shown.camera.size, shown.camera.size), shown.device
        search = partial(solve, shown.pixels, known.points3d, image_size=size, normals3d=known.normals3d)
        distance = float(np.linalg.norm(shown.translation))
        found.append(
            solved(f"{i}", shown.rotation, shown.translation, search, distance=distance, focal=shown.camera.focal)
        )
    return found


def rows(options: argparse.Namespace) -> Rows:
    if options.what == "leds":
        return [(one.name, partial(leds, one, k, options.limit, options.seed)) for k, one in enumerate(LEDS)]
    factors = options.factors if options.what == "wrong" else (1.0, None)
    return photos(options, int(options.what == "views"), factors)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("what", choices=RIGHT)
    options.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE")
    options.add_argument("--factors", type=float, nargs="+", default=FACTORS, help="of wrong focal lengths")
    chosen = options.parse_args()
    warm_up()
    measured(rows(chosen), chosen, *RIGHT[chosen.what])


if __name__ == "__main__":
    main()
