"""Reliability of the verdict: fraction of confident poses that are wrong, for LEDs, shapes, photos and hard scenes.

    python -m benchmarks reliability --only leds shapes photos maps hard --seed 9 --limit 100

Rows:

- leds: the settings of `leds.py`
- shapes: 0, 0.25 and 0.5 outliers per match
- photos: against the points of one view, 0 to 100 % outliers per side
- maps: photos removed from their map, no view given
- hard: `hard_scenes.py`
- wrong focal: photos and planes with a focal length that is 5 to 33 % wrong; photos in whole maps, for each of
  --factors
- labels: LEDs of three colours that a classifier with Gaussian noise sees: without labels, with its likeliest class,
  and with its probabilities
- symmetric: `symmetric.py`; every confident pose of an exactly symmetric object is wrong
- devices: LEDs that a half turn nearly maps onto each other
- pitch: crossings of lines of a playing field, gravity known to 2 degrees

--limit: problems of each row; photos of each scene, as many as the scene with the fewest has. No constant was chosen on
the scenes of the photos (`--scenes`), except for two scales of the search near a view, on south_building.

Success: rotation within 3 degrees, and the centroid of the scene moved by less than a tenth of its distance. Wrong: no
success, and outside the 99.9 % bound of the solution. Rows "wrong focal": success is a camera centre within a twentieth
of the distance, and every other pose is wrong.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import cycle
from typing import Any

import leds
import numpy as np
import shapes
import symmetric
from hard_scenes import CAMERA, SCENES, Drawn, wrong_focal_plane
from record import Problem, Row, parser, run
from scipy.special import softmax
from view_problems import LEAST_MATCHES, REPORTED, Against, ViewProblem, scene_problems

from bpnp import Solution, solve
from bpnp.arrays import Array, PoseArrays
from bpnp.cameras import camera_from
from bpnp.search.inputs import problem_from
from bpnp.search.solvers import Options, solve_problems

FACTORS = (0.67, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.33)
RIGHT_DEG, RIGHT_MOVED, RIGHT_CENTRE = 3.0, 0.1, 0.05
COLOURS, BLUR = 3, 0.8  # classes of LEDs, and the noise of what a classifier sees of them


def rows(options: argparse.Namespace) -> Iterator[Row]:
    right = partial(Row, right_deg=RIGHT_DEG, right_moved=RIGHT_MOVED)
    near = partial(Row, right_deg=np.inf, right_shift=RIGHT_CENTRE, excused=False)
    count, photos = (options.limit, options.seed), partial(of_photos, cache(partial(in_turns, options)), options)
    for name in leds.SETTINGS:
        yield right(f"leds, {name}", partial(leds.problems, name, *count, options.time_limit))
    for ratio in (0.0, 0.25, 0.5):
        drawn = partial(shapes.problems, "shapes", ratio, *count, options.data, options.time_limit)
        yield right(f"shapes, {ratio:g} outliers a match", drawn)
    for outliers in (0.0, 0.25, 0.5, 0.75, 1.0):
        yield right(f"photos, {outliers:.0%} outliers", partial(photos, outliers, "view", [[1.0]]))
    yield right("maps", partial(photos, 1.0, "map", [[1.0]]))
    for draw in SCENES:
        yield right(f"hard, {draw.__name__}", partial(with_lens, draw, options.seed, options))
    for error in sorted({f"{abs(factor - 1):.0%}" for factor in options.factors}):
        factors = [factor if f"{abs(factor - 1):.0%}" == error else np.nan for factor in options.factors]
        yield near(f"wrong focal, one view, {error}", partial(photos, 0.5, "view", [factors[::2], factors[1::2]]))
        yield near(f"wrong focal, whole map, {error}", partial(photos, 1.0, "map", [factors]))
    yield near("wrong focal, planes", partial(with_lens, wrong_focal_plane, [options.seed, 1], options))
    for parts in symmetric.KINDS:
        drawn = partial(symmetric.problems, parts, *count, options.time_limit)
        yield right(f"symmetric, {parts.label}", drawn)
    for normals in (True, False):
        drawn = partial(symmetric.device_problems, *count, options.time_limit, normals=normals)
        yield right(f"devices, {'with' if normals else 'without'} normals", drawn)
    for tilt in (0.0, 30.0, 60.0):
        yield right(
            f"pitch with gravity, tilt {tilt:g} deg",
            partial(symmetric.pitch_problems, tilt, *count, options.time_limit),
        )
    for kind in ("none", "likeliest", "probabilities"):
        yield right(f"labels, {kind}", partial(of_classes, kind, options))


def of_photos(
    drawn: Callable[[float, Against], Sequence[ViewProblem]], options: argparse.Namespace, outliers: float,
    against: Against, factors: Sequence[Sequence[float]],
) -> Iterator[Problem]:  # fmt: skip
    """Yield photos whose cameras have these factors of the focal length in turn; a factor that is NaN is left out."""
    solve_one, arguments = in_map if against == "map" else with_cones, limits(options)
    for photo, chosen in zip(drawn(outliers, against), cycle(factors)):
        for factor in chosen:
            if np.isfinite(factor):
                seen = photo.points3d if against == "view" and factor == 1 else photo.points3d[photo.matched]
                run = partial(solve_one, photo, factor, **arguments)
                yield problem(f"{photo.name} x {factor}", run, [photo.pose], seen)


def in_turns(options: argparse.Namespace, outliers: float, against: Against) -> list[ViewProblem]:
    """Return photos of the scenes in turn, so that every part of the list has all scenes; only those with enough true
    matches.
    """
    arguments = {"against": against, "outliers": outliers, "seed": options.seed}
    per_scene = [scene_problems(options.data, [scene], options.limit, **arguments) for scene in options.scenes]
    return [
        photo
        for one_each in zip(*per_scene, strict=False)
        for photo in one_each
        if photo.matched.sum() >= LEAST_MATCHES
    ]


def in_map(photo: ViewProblem, factor: float, **arguments: Any) -> Solution:
    pixels, camera = photo.pixels
    return photo.scene.localize(pixels, camera * [[factor], [factor], [1]], **arguments)


def with_cones(photo: ViewProblem, factor: float, **arguments: Any) -> Solution:
    """Solve a photo against one view, with the viewing cones of the points."""
    camera = camera_from(np.diag([factor * photo.focal, factor * photo.focal, 1.0]))
    cones: dict[str, Any] = {"normals3d": photo.scene.cones.axes, "cosines3d": photo.scene.cones.cosines}
    points = problem_from(photo.focal * photo.points2d, photo.points3d, camera, **cones)
    return solve_problems({0: points}, Options(asks=False, **arguments))[0].solution


def limits(options: argparse.Namespace) -> dict[str, Any]:
    return {"seed": options.seed, "time_limit": options.time_limit}


def with_lens(draw: Callable[[Any], Drawn], seed: Any, options: argparse.Namespace) -> Iterator[Problem]:
    rng = np.random.default_rng(seed)
    for k in range(options.limit):
        pixels, points3d, poses = draw(rng)
        yield problem(f"{k}", partial(solve, pixels, points3d, CAMERA, **limits(options)), poses, points3d)


def of_classes(kind: str, options: argparse.Namespace) -> Iterator[Problem]:
    """Yield LEDs of three colours, each without labels, with the likeliest label, or with the probabilities of all."""
    for k in range(options.limit):
        rng = np.random.default_rng([options.seed, k])
        shape: leds.Kind = ("ring", "headset", "drone", "marker")[k % 4]
        setting = leds.Setting("labels", shape, background=3, missing=0.1, least=5, normals=False)
        shown = leds.picture(setting, 1000 * options.seed + k, rng)
        scene = rng.permutation(np.arange(len(shown.device.points3d)) % COLOURS)
        image = np.where(shown.led >= 0, scene[shown.led], rng.integers(COLOURS, size=len(shown.led)))
        score = (np.eye(COLOURS)[image] + BLUR * rng.standard_normal((len(image), COLOURS))) / BLUR**2
        arguments: dict[str, Any] = {"likeliest": {"labels2d": score.argmax(1), "labels3d": scene}}.get(kind, {})
        if kind == "probabilities":
            arguments = {"labels2d": softmax(score, 1), "labels3d": np.eye(COLOURS)[scene]}
        yield leds.problem(f"{k}", shown, camera=shown.camera.model, **arguments, **limits(options))


def problem(name: str, run: Callable[[], Solution], poses: Sequence[PoseArrays], points3d: Array) -> Problem:
    """Return the problem of a frame; the error of the centre is in distances of the centroid of the scene."""
    centroid = np.median(points3d, 0)
    distance = float(np.linalg.norm(poses[0][0] @ centroid + poses[0][1])) if poses else 1.0
    return Problem(name, run, poses, points3d, distance)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--scenes", nargs="+", default=REPORTED, help="models of the photos")
    options.add_argument("--factors", type=float, nargs="+", default=FACTORS, help="of wrong focal lengths")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
