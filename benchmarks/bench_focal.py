"""The focal length unknown: photos in whole maps, against one view, and LEDs; and what a wrong camera is believed.

    python -m benchmarks focal maps --limit 6 --seed 42
    python -m benchmarks focal wrong --limit 3 --factors 0.67 0.8 0.9 0.95 1.05 1.1 1.2 1.33

What: maps (photos left out of their map, which view is not told; beside it with the focal length known), views (photos
against the points of one view), leds (10 or more of them seen), wrong (as maps, told a camera whose focal length is
wrong by each factor). Right is within 1.5 degrees, of LEDs within 3, and of wrong cameras with the centre within a
twentieth of the distance too. A line says for how many the focal length is within 3 %, and how many confident poses
are more than 3 degrees off. --limit: problems a scene or setting.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from bench_constellation import Setting, picture
from bench_views import REPORTED
from record import TIME_LIMIT, Array, Outcome, measured, parser, solved
from view_problems import ViewProblem, scene_problems

from bpnp import Solution, solve, warm_up
from bpnp.cameras import image_size

RIGHT = {"maps": (1.5, np.inf), "views": (1.5, np.inf), "leds": (3.0, np.inf), "wrong": (1.5, 0.05)}  # degrees, share
FAR_DEG, NEAR_FOCAL = 3.0, 0.03
SCENES = (*REPORTED, "statue_of_liberty")
FACTORS = (0.67, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.33)
LEDS = [Setting(f"{kind}, {n} lights, 10 seen", kind, n, least=10) for kind in ("ring", "headset") for n in (0, 3)]
Row = tuple[str, list[Outcome]]


def named(name: str, focals: Sequence[float], found: Sequence[tuple[Outcome, Solution]]) -> Row:
    """A row with the shares of its focal lengths, pixels."""
    near = [
        abs(solution.focal_length / focal - 1) < NEAR_FOCAL for (_, solution), focal in zip(found, focals, strict=True)
    ]
    far = sum(one.verdict == "confident" and one.rotation_deg > FAR_DEG for one, _ in found)
    median = np.median([one.cpu_seconds for one, _ in found])
    title = f"{name}, focal length within 3 % of {np.mean(near):.0%}, confident beyond 3 deg {far}"
    return f"{title}, median {median:.3g} CPU s", [one for one, _ in found]


def outcome(
    name: str, rotation: Array, translation: Array, search: Callable[[], Solution], distance: float
) -> tuple[Outcome, Solution]:  # fmt: skip
    solutions: list[Solution] = []

    def run() -> Solution:
        solutions.append(search())
        return solutions[0]

    one = solved(name, rotation, translation, run, distance=distance)
    print(
        f"  {name}: {one.rotation_deg:.3g} deg, {one.shift:.3g}, {one.verdict}, {one.cpu_seconds:.3g} CPU s", flush=True
    )
    return one, solutions[0]


def of_photo(problem: ViewProblem, search: Callable[..., Solution], what: str) -> tuple[Outcome, Solution]:
    pixels, size = image_of(problem)
    known = np.array([[problem.focal, 0, size[0] / 2], [0, problem.focal, size[1] / 2], [0, 0, 1]])
    camera: dict[str, Any] = {"camera": known} if what == "known" else {"image_size": size}
    run = partial(search, pixels, **camera, time_limit=TIME_LIMIT)
    seen = problem.points3d[problem.match3d >= 0] @ problem.rotation.T + problem.translation
    distance = float(np.median(np.linalg.norm(seen, axis=-1)))
    return outcome(f"{problem.name} {what}", problem.rotation, problem.translation, run, distance)


def image_of(problem: ViewProblem) -> tuple[Array, tuple[int, int]]:
    """Keypoints (m, 2), pixels, and width and height of an image about the principal point that has them, of the size
    of the map's images where they lie within it."""
    pixels = problem.focal * problem.points2d
    sizes = [size for view in problem.scene.views if (size := image_size(view.camera))]
    width, height = np.max([2 * np.ceil(np.abs(pixels).max(0)), *sizes[:1]], 0).astype(int).tolist()
    return pixels + np.array([width / 2, height / 2]), (width, height)


def problems_of(options: argparse.Namespace, views: int, outliers: float) -> list[ViewProblem]:
    known = {"limit": options.limit, "views": views, "outliers": outliers, "seed": options.seed}
    most = 1024 if views else None
    return [problem for name in options.scenes for problem in scene_problems(options.data, name, most=most, **known)]


def maps(options: argparse.Namespace) -> Iterator[Row]:
    problems = problems_of(options, 0, 1.0)
    for what in ("known", "unknown"):
        found = [of_photo(one, partial(one.scene.localize, seed=options.seed), what) for one in problems]
        yield named(f"whole map, {what}", [one.focal for one in problems], found)


def views(options: argparse.Namespace) -> Iterator[Row]:
    problems = problems_of(options, 1, 0.5)
    for what in ("known", "unknown"):
        found = [
            of_photo(
                one, lambda pixels, one=one, **known: solve(pixels, one.points3d, seed=options.seed, **known), what
            )
            for one in problems
        ]
        yield named(f"one view, {what}", [one.focal for one in problems], found)


def leds(options: argparse.Namespace) -> Iterator[Row]:
    for k, setting in enumerate(LEDS):
        rng, found, focals = np.random.default_rng([options.seed, k]), [], []
        for i in range(options.limit):
            shown = picture(setting, 1000 * options.seed + i // 5, rng)
            size = (shown.camera.size, shown.camera.size)
            search = partial(
                solve, shown.pixels, shown.device.points3d, image_size=size, normals3d=shown.device.normals3d
            )  # fmt: skip
            distance = float(np.linalg.norm(shown.translation))
            found.append(outcome(f"{setting.name} {i}", shown.rotation, shown.translation, search, distance))
            focals.append(shown.camera.focal)
        yield named(setting.name, focals, found)


def wrong(options: argparse.Namespace) -> Iterator[Row]:
    problems = problems_of(options, 0, 1.0)
    for factor in options.factors:
        found = []
        for one in problems:
            told = replace(one, focal=factor * one.focal, points2d=one.points2d / factor)
            found.append(of_photo(told, partial(one.scene.localize, seed=options.seed), "known"))
        row, outcomes = named(f"focal length x {factor}", [one.focal for one in problems], found)
        yield row, [replace(one, outside=True) for one in outcomes]  # a wrong camera's bound is none


WHAT = {"maps": maps, "views": views, "leds": leds, "wrong": wrong}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("what", choices=WHAT)
    options.add_argument("--scenes", nargs="+", default=SCENES, metavar="SCENE")
    options.add_argument("--factors", type=float, nargs="+", default=FACTORS, help="of wrong focal lengths")
    chosen = options.parse_args()
    warm_up()
    measured(WHAT[chosen.what](chosen), chosen, *RIGHT[chosen.what])


if __name__ == "__main__":
    main()
