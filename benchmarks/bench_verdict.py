"""How often `confident` is said of points that have no pose in common, and of problems on which it is easily wrong.

    python -m benchmarks verdict --limit 100 --kinds noise shuffled hard

noise: image points and scene points drawn evenly and independently. shuffled: keypoints of one photo against the points
that another one sees. hard: repeated structures, points that depend on each other, wrong models (`hard_scenes.py`); an
error of a tenth of the distance counts as one of 3 degrees.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from bench_search import of_data
from hard_scenes import CAMERA, HEIGHT, SCENES, WIDTH, Pair
from record import TIME_LIMIT, Outcome, measured, parser, solved

from bpnp import solve

NOISE_SIZES = ((6, 6), (10, 17), (30, 30), (20, 100), (100, 100), (400, 400))
SHUFFLED = ("castle-P30", "fountain-P11", "south_building", "statue_of_liberty", "walkthrough", "psb")
SHUFFLED_SIZES = (15, 40, 120, 400)
KINDS = ("noise", "shuffled", "hard")
WRONG_DEG, WRONG_SHIFT = 3.0, 0.1


def noise(m: int, n: int, limit: int, seed: int) -> list[Outcome]:
    rng = np.random.default_rng([seed, m, n])
    drawn = [(rng.uniform((0, 0), (WIDTH, HEIGHT), (m, 2)), rng.uniform(-1, 1, (n, 3))) for _ in range(limit)]
    return [unrelated(partial(solve, *points, CAMERA, time_limit=TIME_LIMIT)) for points in drawn]


def shuffled(size: int, data: Path, limit: int, seed: int) -> list[Outcome]:
    rng, found = np.random.default_rng([seed, size]), []
    problems = {name: list(of_data(name, 0.0, data, 8, seed)) for name in SHUFFLED}
    for _ in range(limit):
        one, other = (problems[name] for name in rng.choice(SHUFFLED, 2, replace=False))
        points2d, points3d = one[rng.integers(len(one))][1], other[rng.integers(len(other))][2]
        few = (rng.permutation(points2d)[:size], rng.permutation(points3d)[:size])
        found.append(unrelated(partial(solve, *few, time_limit=TIME_LIMIT)))
    return found


def hard(draw: Callable[[np.random.Generator], Pair], limit: int, seed: int) -> list[Outcome]:
    rng, found = np.random.default_rng(seed), []
    for _ in range(limit):
        points2d, points3d, poses = draw(rng)
        solution = solve(points2d, points3d, CAMERA, time_limit=TIME_LIMIT)
        middle = points3d.mean(0)
        tried = []
        for rotation, translation in poses:
            one = solved(draw.__name__, rotation, translation, lambda: solution)  # noqa: B023
            there = rotation @ middle + translation
            shift = np.linalg.norm(solution.rotation @ middle + solution.translation - there) / np.linalg.norm(there)
            tried.append(max(one.rotation_deg, WRONG_DEG / WRONG_SHIFT * float(shift)))
        found.append(Outcome(draw.__name__, min(tried, default=180.0), 0.0, solution.verdict, 0.0))
    return found


def unrelated(search: Callable[[], object]) -> Outcome:
    """Of points for which no pose is right."""
    return solved("", np.full((3, 3), np.nan), np.zeros(3), search)  # type: ignore[arg-type]


def rows(kinds: list[str], data: Path, limit: int, seed: int) -> Iterator[tuple[str, list[Outcome]]]:
    for m, n in NOISE_SIZES if "noise" in kinds else ():
        yield f"noise {m} x {n}", noise(m, n, limit, seed)
    for size in SHUFFLED_SIZES if "shuffled" in kinds and data.is_dir() else ():
        yield f"shuffled, {size} points", shuffled(size, data, limit, seed)
    for draw in SCENES if "hard" in kinds else ():
        yield f"hard, {draw.__name__}", hard(draw, limit, seed)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    chosen = options.parse_args()
    measured(rows(chosen.kinds, chosen.data, chosen.limit, chosen.seed), chosen, WRONG_DEG)


if __name__ == "__main__":
    main()
