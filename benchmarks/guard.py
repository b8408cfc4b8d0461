"""Compare a run over problems of all kinds with an earlier run, problem by problem: did a change cost anything.

    python -m benchmarks guard --seed 71 --output before.json
    python -m benchmarks guard --seed 71 --output after.json --against before.json

Kinds: shapes and meshes, photos against one view and in their maps, LEDs, near-symmetric devices, symmetric objects,
unknown focal lengths, unrelated points, and `verify`. The file has verdict, errors, CPU seconds and pose of every
problem. With --against, a line for each kind has the paired differences: the geometric mean of the ratios of the CPU
seconds, the confident verdicts that were gained and lost, the number of poses that differ by more than 2 degrees or a
twentieth of the translation, and the number of answers that changed at all. An answer is unchanged if verdict and
reason are equal and the pose is equal to 1e-9 of its size. The exit status is 1 if a kind has fewer successes, more
poses that are confident and wrong, or more than 1.1 times the CPU seconds; with --exact, for code that only moves, also
if an answer changed. --limit: problems of each kind.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import bench_focal
import leds
import numpy as np
import shapes
import symmetric
from record import Outcome, Problem, Row, degrees, parser, run
from reliability import RIGHT_DEG, RIGHT_MOVED
from scipy.spatial.transform import Rotation
from view_problems import photos

import bpnp

MOST_CPU = 1.1
EQUAL = 1e-9  # relative difference of two poses that are equal
OTHER_DEG, OTHER_SHIFT = 2.0, 0.05  # of different poses; the shift relative to the translation
SHOWN = 5  # names of changed problems in a line
ANSWER = ("rotation", "translation")
Draw = Callable[[argparse.Namespace], Iterable[Problem]]


def of_shapes(chosen: str, ratio: float, options: argparse.Namespace) -> Iterator[Problem]:
    return shapes.problems(chosen, ratio, options.limit, options.seed, options.data, options.time_limit)


def of_verify(turned: float, options: argparse.Namespace) -> Iterator[Problem]:
    """Yield true poses of cluttered shapes to be verified, or poses rotated by some degrees."""
    for name, points2d, points3d, rotation, translation in shapes.shapes(0.25, options.limit, options.seed):
        turn = Rotation.from_rotvec([0, np.radians(turned), 0]).as_matrix()
        search = partial(bpnp.verify, points2d, points3d, turn @ rotation, translation)
        yield Problem(name, search, [(rotation, translation)], points3d)


def of_noise(options: argparse.Namespace) -> Iterator[Problem]:
    """Yield image points and scene points that are unrelated."""
    for k in range(options.limit):
        rng = np.random.default_rng([options.seed, 99, k])
        count = int(rng.choice([12, 30, 100]))
        image, points = rng.uniform(-0.4, 0.4, (count, 2)), rng.uniform(-1, 1, (count, 3))
        yield Problem(f"noise {k}", partial(bpnp.solve, image, points, time_limit=options.time_limit), [])


def of_symmetric(unique: Callable[[int], bool], options: argparse.Namespace) -> Iterator[Problem]:
    kinds = [kind for kind in symmetric.KINDS if unique(kind.unique)]
    drawn = [symmetric.problems(kind, options.limit, options.seed, options.time_limit) for kind in kinds]
    yield from islice(chain.from_iterable(zip(*drawn, strict=True)), options.limit)


def of_leds(name: str, options: argparse.Namespace) -> Iterator[Problem]:
    return leds.problems(name, options.limit, options.seed, options.time_limit)


def of_devices(normals: bool, options: argparse.Namespace) -> Iterator[Problem]:
    return symmetric.device_problems(options.limit, options.seed, options.time_limit, normals=normals, frames=3)


def of_photos(against: Any, outliers: float, in_map: bool, apart: bool, options: argparse.Namespace) -> Any:
    count = options.limit, options.seed, options.data
    return photos(against, outliers, *count, in_map=in_map, apart=apart, time_limit=options.time_limit)


def of_focal(what: str, options: argparse.Namespace) -> Iterator[Problem]:
    chosen = argparse.Namespace(**vars(options) | {"what": what, "scenes": bench_focal.SCENES[:2]})
    if what == "maps":
        chosen.limit = -(-options.limit // 2)
    else:
        chosen.limit = -(-options.limit // len(bench_focal.LEDS))
    for row in bench_focal.rows(chosen):
        yield from row.draw()  # type: ignore[misc]


KINDS: dict[str, Draw] = {
    "shapes": partial(of_shapes, "shapes", 0.0),
    "shapes, 0.25": partial(of_shapes, "shapes", 0.25),
    "shapes, 0.5": partial(of_shapes, "shapes", 0.5),
    "psb": partial(of_shapes, "psb", 0.0),
    "castle": partial(of_shapes, "castle-P30", 0.0),
    "castle, 0.5": partial(of_shapes, "castle-P30", 0.5),
    "photos, one view, 75 %": partial(of_photos, "view", 0.75, False, False),
    "photos, one view, 100 %": partial(of_photos, "view", 1.0, False, False),
    "photos, whole maps": partial(of_photos, "map", 1.0, True, False),
    "photos, another place": partial(of_photos, "view", 1.0, True, True),
    "leds, ring": partial(of_leds, "ring, 3 lights"),
    "leds, headset": partial(of_leds, "headset, 8 lights, 20 % missing"),
    "leds, no normals": partial(of_leds, "ring, no normals, 3 lights"),
    "leds, gravity": partial(of_leds, "headset, 5 seen, gravity"),
    "leds, drone": partial(of_leds, "drone, 3 lights"),
    "devices, near-symmetric": partial(of_devices, True),
    "devices, no normals": partial(of_devices, False),
    "symmetric, exactly": partial(of_symmetric, lambda unique: unique == 0),
    "symmetric, 3 or 4 unique": partial(of_symmetric, lambda unique: unique in (3, 4)),
    "symmetric, 8 or more unique": partial(of_symmetric, lambda unique: unique >= 8),
    "focal length unknown, LEDs": partial(of_focal, "leds"),
    "focal length unknown, maps": partial(of_focal, "maps"),
    "noise": of_noise,
    "verify, true": partial(of_verify, 0.0),
    "verify, 25 deg off": partial(of_verify, 25.0),
}


def compare(row: Row, found: Sequence[Outcome], before: Sequence[Outcome], *, exact: bool = False) -> tuple[str, bool]:
    """Return the paired comparison of a kind with an earlier run, and whether the kind is held."""
    earlier = {outcome.problem: outcome for outcome in before}
    pairs = [(outcome, earlier[outcome.problem]) for outcome in found if outcome.problem in earlier]
    if not pairs:
        return "no problem in common", False
    ratio = float(np.exp(np.mean([np.log(a.cpu_seconds / max(b.cpu_seconds, 1e-9)) for a, b in pairs])))
    new, old = ([pair[k] for pair in pairs] for k in (0, 1))
    sure = [[outcome.verdict == "confident" for outcome in outcomes] for outcomes in (new, old)]
    gained = sum(a and not b for a, b in zip(*sure, strict=True))
    lost = sum(b and not a for a, b in zip(*sure, strict=True))
    right = sum(map(row.is_right, new)) - sum(map(row.is_right, old))
    wrong = sum(map(row.is_confident_and_wrong, new)) - sum(map(row.is_confident_and_wrong, old))
    other = sum(differs(a, b) for a, b in pairs)
    changed = [outcome.problem for outcome, earlier in pairs if is_changed(outcome, earlier)]
    text = (
        f"CPU {ratio:.2f}, right {right:+d}, wrong {wrong:+d}, confident +{gained} -{lost}, {other} other poses, "
        f"{len(changed)} of {len(pairs)} answers changed{': ' * bool(changed)}{', '.join(changed[:SHOWN])}"
    )
    return text, right >= 0 and wrong <= 0 and ratio <= MOST_CPU and not (exact and changed)


def differs(one: Outcome, other: Outcome) -> bool:
    """Return True if two answers are different poses, or only one of them is a pose."""
    rotations, translations = (np.array([getattr(each, name) for each in (one, other)]) for name in ANSWER)
    if not (np.isfinite(rotations).any() and np.isfinite(translations).any()):
        return False
    moved = np.linalg.norm(translations[0] - translations[1]) / np.linalg.norm(translations[1])
    return degrees(*rotations) > OTHER_DEG or bool(moved > OTHER_SHIFT)


def is_changed(one: Outcome, other: Outcome) -> bool:
    """Return True if verdict or reason of two answers differ, or their poses by more than `EQUAL` of their size."""
    poses = (np.array([getattr(each, name) for each in (one, other)]) for name in ANSWER)
    equal = all(
        np.array_equal(*np.isnan(pose)) and not (np.abs(pose[0] - pose[1]) > EQUAL * np.abs(pose[1]).max()).any()
        for pose in poses
    )
    return (one.verdict, one.reason) != (other.verdict, other.reason) or not equal


def read_outcomes(file: Path) -> dict[str, list[Outcome]]:
    """Return the outcomes of each kind in a file of `--output`."""
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    return {kind: [Outcome(**outcome) for outcome in row["outcomes"]] for kind, row in rows.items()}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    for kind, draw in KINDS.items():
        yield Row(kind, partial(draw, options), RIGHT_DEG, right_moved=RIGHT_MOVED)


def main() -> None:
    options = parser(__doc__)
    options.set_defaults(time_limit=10.0)
    options.add_argument("--against", type=Path, help="file of an earlier run")
    options.add_argument("--exact", action="store_true", help="a changed answer is a failure too")
    chosen = options.parse_args()
    before: dict[str, list[Outcome]] = {}
    if chosen.against:
        try:
            before = read_outcomes(chosen.against)
        except (OSError, ValueError, KeyError, TypeError) as error:
            options.error(
                f"--against: {chosen.against} is no file that `guard --output` of this version wrote: {error}"
            )
    held = True
    for row, found in run(rows(chosen), chosen):
        if chosen.against:
            text, good = compare(row, found, before.get(row.name, []), exact=chosen.exact)
            print(f"{row.name}: {text}{'' if good else ' NOT HELD'}")
            held &= good
    raise SystemExit(not held)
