"""Calibration of the miss probability 2^-k on symmetric objects, without the comparison of poses under their motions.

    python -m benchmarks completeness    # 3 CPU minutes; writes benchmarks/completeness.json and docs/verdict.md

Every search runs `TURNS` rounds. After each round the best pose has the basin count k. For each k the table lists how
many best poses reached it, how many of them were wrong at that moment, and the bound 2^-k. Objects have eight or more
unique points, so that one pose is correct. The sentence below the table counts the trials in which a symmetry rotates
the true pose, and the motions found from the matches of the rotated pose give the true pose back.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import symmetric
from pages import markdown, publish
from record import ROOT, Problem, write
from scipy.spatial.transform import Rotation

from bpnp.poses import Tolerance
from bpnp.search.inputs import problem_from
from bpnp.search.pool import Pool
from bpnp.search.propose.repetitions import competing_poses
from bpnp.search.schedule import Plan
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS

FILE = ROOT / "benchmarks" / "completeness.json"
TURNS = 8
BASIN_COUNTS = (1, 2, 3, 4, 6, 8, 10)
UNIQUE = 8  # smallest number of points that no symmetry maps onto others
RIGHT_DEG = 3.0


@patch.multiple("bpnp.search.propose.repetitions", MAPPED=2.0, MAPPED_OF_SCENE=2.0, SYMMETRIC=2.0)
@patch("bpnp.search.verdict.completeness.SYMMETRIC", 2.0)
def reached(problem: Problem) -> dict[int, bool]:
    """Return, for each basin count that a best pose reached, whether the first pose that did was correct.

    No motion maps more than all of the points: no competitor is proposed, and no scene counts as symmetric.
    """
    points2d, points3d = problem.solve.args  # type: ignore[attr-defined]
    points = problem_from(points2d, points3d, None)
    pool = Pool(SearchFrame(points, 0, DEFAULT), points, Case.without_pose(points))
    found: dict[int, bool] = {}
    plan = Plan.of(pool)
    for _ in range(TURNS):
        step = plan.next_step()
        assert step is not None
        pool.add(step, step.propose())
        leaders = pool.leaders()
        if not len(leaders) or leaders.log10_false_alarms[0] > MOST_FALSE_ALARMS:
            continue
        hits = pool.symmetry.basin_count(leaders)
        turn = leaders.rotation[0].T @ problem.poses[0][0]
        right = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < RIGHT_DEG
        for least in BASIN_COUNTS:
            if hits >= least and least not in found:
                found[least] = bool(right)
    return found


def leads_back(kind: symmetric.Kind, problem: Problem) -> bool:
    """Return True if the true pose is among the competing poses of the pose rotated by one part of the object."""
    points2d, points3d = problem.solve.args  # type: ignore[attr-defined]
    points, (rotation, translation) = problem_from(points2d, points3d, None), problem.poses[0]
    one, other = problem.points3d[: kind.each], problem.points3d[kind.each : 2 * kind.each]
    turn = Rotation.align_vectors(other - other.mean(0), one - one.mean(0))[0].as_matrix()
    turned = rotation @ turn.T
    shift = translation - turned @ (other.mean(0) - turn @ one.mean(0))
    (turned, shift), (_, translation) = points.from_user(turned, shift), points.from_user(rotation, translation)
    rotations, translations, *_ = competing_poses(points, turned, shift, symmetric.NOISE)
    return bool(points.same_as((rotation, translation), rotations, translations, Tolerance(RIGHT_DEG)).any())


def measure(seed: int, limit: int, trials: int) -> dict[str, Any]:
    """Return the settings, how many best poses reached each basin count and were wrong, and the trials of motions.

    Of each kind, `limit` objects are searched, and the true pose of `trials` ones is rotated by a symmetry.
    """
    counts: Counter[tuple[int, bool]] = Counter()
    searched = 0
    led: list[bool] = []
    for kind in symmetric.KINDS:
        if kind.unique < UNIQUE:
            continue
        for k, problem in enumerate(symmetric.problems(kind, max(limit, trials), seed)):
            if k < limit and kind.name != "few":  # these are enumerated
                counts.update(reached(problem).items())
                searched += 1
            if k < trials:
                led.append(leads_back(kind, problem))
        print(f"{kind.label}: {searched} objects searched, true pose found in {sum(led)} of {len(led)}", flush=True)
    basins = {str(k): {"poses": counts[k, True] + counts[k, False], "wrong": counts[k, False]} for k in BASIN_COUNTS}
    settings = {"seed": seed, "limit": limit, "trials": trials}
    return {
        "settings": settings,
        "searched": searched,
        "basin_counts": basins,
        "motions": {"trials": len(led), "led_back": sum(led)},
    }


def tables(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the table of the fraction of wrong poses by basin count, with the motions and the command below."""
    head = ("basin count $k$", "poses that reached it", "wrong", "fraction", "$2^{-k}$")
    rows = []
    for k, found in record["basin_counts"].items():
        fraction = found["wrong"] / max(found["poses"], 1)
        rows.append((k, str(found["poses"]), str(found["wrong"]), f"{fraction:.3f}", f"{0.5 ** int(k):.3f}"))
    motions = record["motions"]
    options = " ".join(f"--{name} {value}" for name, value in record["settings"].items())
    text = "".join(
        [
            markdown(head, rows),
            f"\n{record['searched']:,} objects were searched. The motions gave the true pose back in ",
            f"{motions['led_back']:,} of {motions['trials']:,} trials.\n",
            f"\n`python -m benchmarks completeness {options}`.\n",
        ]
    )
    return {"data": text}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=41, help="of objects and searches (default: %(default)s)")
    parser.add_argument("--limit", type=int, default=25, help="objects of a kind to search (default: %(default)s)")
    parser.add_argument("--trials", type=int, default=130, help="of motions for each kind (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    chosen = parser.parse_args()
    write(chosen.output, measure(chosen.seed, chosen.limit, chosen.trials))
    publish("completeness", chosen.output)
