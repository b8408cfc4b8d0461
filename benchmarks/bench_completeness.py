"""The miss probability 2^-h of a search, counted on symmetric objects while their motions are not used.

    python -m benchmarks completeness --seed 31 --limit 12

Every search takes `TURNS` turns and never ends before. After each turn the best pose has h hits (its basin count). For
each h the table has how many poses had at least h hits when they first reached that number, how many of these were
wrong, and 2^-h, which claims to bound that fraction. Objects have eight or more unique points, so that one pose is
right. --limit: problems of each kind.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
import symmetric
from record import Problem, parser

from bpnp.search.pool import Pool
from bpnp.search.scene import Scene
from bpnp.search.schedule import turns
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import no_pose, starts_met
from bpnp.solving.problem import problem_from

TURNS = 8
HITS = (1, 2, 3, 4, 6, 8, 10)
RIGHT_DEG = 3.0
# No motion maps more than all of the points: no competitor is proposed, and no scene counts as symmetric.
BLIND = replace(
    DEFAULT.evidence, repetitions=replace(DEFAULT.evidence.repetitions, share=2.0, share_of_scene=2.0, symmetric=2.0)
)


def reached(problem: Problem) -> dict[int, bool]:
    """Return, for each number of hits that a best pose reached, whether the first one that did was right."""
    points2d, points3d = problem.solve.args  # type: ignore[attr-defined]
    sets, settings = problem_from(points2d, points3d, None).sets, replace(DEFAULT, evidence=BLIND)
    pool = Pool(Scene(sets, 0, settings), sets, no_pose("no pose was found"))
    found: dict[int, bool] = {}
    drawn = turns(pool, None, None)
    for _ in range(TURNS):
        pool.merge(next(drawn))
        leaders = pool.leaders()
        if not len(leaders) or leaders.log10_false_alarms[0] > BLIND.false_alarms:
            continue
        hits = starts_met(leaders, sets, BLIND)
        turn = leaders.rotation[0].T @ problem.poses[0][0]
        right = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < RIGHT_DEG
        for least in HITS:
            if hits >= least and least not in found:
                found[least] = bool(right)
    return found


def main() -> None:
    options = parser(__doc__).parse_args()
    kinds = [kind for kind in symmetric.KINDS if kind.unique >= 8 and kind.name != "few"]
    counts: Counter[tuple[int, bool]] = Counter()
    for kind in kinds:
        for problem in symmetric.problems(kind, options.limit, options.seed):
            counts.update(reached(problem).items())
    print("| hits | poses that had them | wrong | fraction | 2^-h |\n| --- | --- | --- | --- | --- |")
    for least in HITS:
        right, wrong = counts[least, True], counts[least, False]
        fraction = wrong / max(right + wrong, 1)
        print(f"| {least} | {right + wrong} | {wrong} | {fraction:.3f} | {0.5**least:.3f} |")


if __name__ == "__main__":
    main()
