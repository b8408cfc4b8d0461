"""Compare a run over problems of all kinds with an earlier run, problem by problem: did a change cost anything.

    python -m benchmarks guard --seed 71 --output before.json
    python -m benchmarks guard --seed 71 --output after.json --against before.json

Kinds: shapes and meshes, photos against one view and in their maps, LEDs, near-symmetric devices, symmetric objects,
unknown focal lengths, unrelated points, and `verify`. The file has verdict, error, false alarms, CPU seconds and pose
of every problem. With --against, the differences are paired: CPU as the geometric mean of the ratios, verdicts as those
gained and lost, and answers as the number of poses that differ by more than their own bound would allow. The exit
status is 1 where a kind has fewer successes, a confident and wrong pose more, or 1.15 times the CPU seconds. --limit:
problems a kind.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import bench_focal
import leds
import numpy as np
import shapes
import symmetric
from record import Problem, command, machine, nearest, parser, solve_problem
from scipy.spatial.transform import Rotation
from view_problems import photos

import bpnp

MOST_CPU = 1.15
RIGHT_DEG = 3.0
Draw = Callable[[argparse.Namespace], Iterable[Problem]]


def of_shapes(chosen: str, ratio: float, options: argparse.Namespace) -> Iterator[Problem]:
    return shapes.problems(chosen, ratio, options.limit, options.seed, options.data, options.time_limit)


def of_verify(turned: float, options: argparse.Namespace) -> Iterator[Problem]:
    """Yield true poses of cluttered shapes to be verified, or poses turned by some degrees."""
    for name, points2d, points3d, rotation, translation in shapes.shapes(0.25, options.limit, options.seed):
        turn = Rotation.from_rotvec([0, np.radians(turned), 0]).as_matrix()
        search = partial(bpnp.verify, points2d, points3d, turn @ rotation, translation)
        yield Problem(name, search, [(rotation, translation)], points3d)


def of_noise(options: argparse.Namespace) -> Iterator[Problem]:
    """Yield points that have nothing to do with each other."""
    for k in range(options.limit):
        rng = np.random.default_rng([options.seed, 99, k])
        count = int(rng.choice([12, 30, 100]))
        image, points = rng.uniform(-0.4, 0.4, (count, 2)), rng.uniform(-1, 1, (count, 3))
        yield Problem(f"noise {k}", partial(bpnp.solve, image, points, time_limit=options.time_limit), [])


def of_symmetric(unique: Callable[[int], bool], options: argparse.Namespace) -> Iterator[Problem]:
    kinds = [kind for kind in symmetric.KINDS if unique(kind.unique)]
    for k in range(options.limit):
        kind = kinds[k % len(kinds)]
        yield from symmetric.problems(kind, 1, options.seed + k, options.time_limit)


def of_leds(name: str, options: argparse.Namespace) -> Iterator[Problem]:
    return leds.problems(name, options.limit, options.seed)


def of_devices(normals: bool, options: argparse.Namespace) -> Iterator[Problem]:
    return symmetric.device_problems(options.limit, options.seed, normals=normals, frames=3)


def of_photos(against: Any, outliers: float, in_map: bool, apart: bool, options: argparse.Namespace) -> Any:
    return photos(against, outliers, options.limit, options.seed, options.data, in_map=in_map, apart=apart)


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


def measure(problem: Problem) -> dict[str, Any]:
    """Solve a problem and return its outcome with the answer, as plain numbers."""
    kept: list[Any] = []

    def search() -> Any:
        kept.append(problem.solve())
        return kept[0]

    outcome = solve_problem(
        Problem(problem.name, search, problem.poses, problem.points3d, problem.distance, problem.focal)
    )
    found = kept[0]
    row = {key: value for key, value in asdict(outcome).items() if key != "sigmas"}
    right = bool(problem.poses) and outcome.rotation_deg < RIGHT_DEG and outcome.moved < 0.1
    return row | {
        "right": right,
        "wrong": outcome.verdict == "confident" and not right and outcome.outside,
        "log10_false_alarms": float(found.log10_false_alarms),
        "reason": found.reason,
        "rotation": np.asarray(found.rotation).tolist(),
        "translation": np.asarray(found.translation).tolist(),
    }


def line(kind: str, rows: list[dict[str, Any]]) -> str:
    """Return the summary of a kind."""
    count, seconds = max(len(rows), 1), np.array([row["cpu_seconds"] for row in rows] or [0.0])
    shares = (sum(row["right"] for row in rows), sum(row["verdict"] == "confident" for row in rows))
    cpu = f"CPU s {np.median(seconds):.3g}, mean {seconds.mean():.3g}"
    right, confident = (f"{100 * value / count:.0f} %" for value in shares)
    return f"{kind}: {count}, right {right}, confident {confident}, wrong {sum(r['wrong'] for r in rows)}, {cpu}"


def compare(kind: str, rows: list[dict[str, Any]], before: list[dict[str, Any]]) -> tuple[str, bool]:
    """Return the paired comparison of a kind, and whether it is held."""
    earlier = {row["problem"]: row for row in before}
    pairs = [(row, earlier[row["problem"]]) for row in rows if row["problem"] in earlier]
    if not pairs:
        return "no problem in common", False
    ratio = float(np.exp(np.mean([np.log(a["cpu_seconds"] / max(b["cpu_seconds"], 1e-9)) for a, b in pairs])))
    gained = sum(a["verdict"] == "confident" != b["verdict"] for a, b in pairs)
    lost = sum(b["verdict"] == "confident" != a["verdict"] for a, b in pairs)
    right = sum(a["right"] for a, _ in pairs) - sum(b["right"] for _, b in pairs)
    wrong = sum(a["wrong"] for a, _ in pairs) - sum(b["wrong"] for _, b in pairs)
    other = sum(differs(a, b) for a, b in pairs)
    text = f"CPU {ratio:.2f}, right {right:+d}, wrong {wrong:+d}, confident +{gained} -{lost}, {other} other poses"
    return text, right >= 0 and wrong <= 0 and ratio <= MOST_CPU


def differs(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return whether two answers are different poses."""
    poses = [(np.array(row["rotation"], float), np.array(row["translation"], float)) for row in (one, other)]
    turn, _, moved, _ = nearest(Problem("", lambda: bpnp.solve([], []), [poses[0]]), *poses[1])
    return turn > 2 or moved > 0.05


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--against", type=Path, help="file of an earlier run")
    options.add_argument("--time-limit", type=float, default=10.0, help="seconds a problem (default: %(default)s)")
    args = options.parse_args()
    bpnp.warm_up()
    record: dict[str, Any] = {"machine": machine(), "command": command(sys.argv), "kinds": {}}
    before = json.loads(args.against.read_text())["kinds"] if args.against else {}
    held = True
    for kind, draw in KINDS.items():
        if not any(part in kind for part in args.only):
            continue
        rows = record["kinds"][kind] = [measure(problem) for problem in draw(args)]
        text, good = compare(kind, rows, before[kind]) if kind in before else ("", True)
        held &= good
        print(line(kind, rows) + (f" | {text}" if text else "") + ("" if good else " NOT HELD"), flush=True)
        if args.output:
            args.output.write_text(json.dumps(record, indent=1, default=str))
    raise SystemExit(not held)


if __name__ == "__main__":
    main()
