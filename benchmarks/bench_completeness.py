"""Calibration of the miss probability 2^-h on symmetric objects, without the comparison of poses under their motions.

    python -m benchmarks completeness --seed 31 --limit 12

Every search runs `TURNS` rounds. After each round the best pose has the basin count h. For each h the table lists how
many best poses reached it, how many of them were wrong at that moment, and the bound 2^-h. Objects have eight or more
unique points, so that one pose is correct. The last line counts the problems in which a symmetry rotates the true pose,
and the motions found from the matches of the rotated pose give the true pose back. --limit: problems of each kind.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
import symmetric
from record import Problem, parser
from scipy.spatial.transform import Rotation

from bpnp.poses import Tolerance
from bpnp.search.config import DEFAULT
from bpnp.search.inputs import problem_from
from bpnp.search.plan import Plan
from bpnp.search.pool import Pool
from bpnp.search.propose.repetitions import competing_poses, registered
from bpnp.search.search_frame import Scene
from bpnp.search.verdict.decide import count_starts, no_pose

TURNS = 8
HITS = (1, 2, 3, 4, 6, 8, 10)
RIGHT_DEG = 3.0
# No motion maps more than all of the points: no competitor is proposed, and no scene counts as symmetric.
BLIND = replace(
    DEFAULT.evidence, repetitions=replace(DEFAULT.evidence.repetitions, share=2.0, share_of_scene=2.0, symmetric=2.0)
)


def reached(problem: Problem) -> dict[int, bool]:
    """Return, for each basin count that a best pose reached, whether the first pose that did was correct."""
    points2d, points3d = problem.solve.args  # type: ignore[attr-defined]
    points, settings = problem_from(points2d, points3d, None), replace(DEFAULT, evidence=BLIND)
    pool = Pool(Scene(points, 0, settings), points, no_pose())
    found: dict[int, bool] = {}
    plan = Plan.of(pool)
    for _ in range(TURNS):
        step = plan.next_step()
        assert step is not None
        pool.add(step, step.propose())
        leaders = pool.leaders()
        if not len(leaders) or leaders.log10_false_alarms[0] > BLIND.false_alarms:
            continue
        hits = count_starts(leaders, points, BLIND)
        turn = leaders.rotation[0].T @ problem.poses[0][0]
        right = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < RIGHT_DEG
        for least in HITS:
            if hits >= least and least not in found:
                found[least] = bool(right)
    return found


def leads_back(kind: symmetric.Kind, problem: Problem) -> bool:
    """Return whether the true pose is among the competitors of the pose rotated by one part of the object."""
    points2d, points3d = problem.solve.args  # type: ignore[attr-defined]
    points, (rotation, translation) = problem_from(points2d, points3d, None), problem.poses[0]
    one, other = problem.points3d[: kind.each], problem.points3d[kind.each : 2 * kind.each]
    turn = Rotation.align_vectors(other - other.mean(0), one - one.mean(0))[0].as_matrix()
    turned = rotation @ turn.T
    shift = translation - turned @ (other.mean(0) - turn @ one.mean(0))
    (turned, shift), (_, translation) = points.from_user(turned, shift), points.from_user(rotation, translation)
    motions = registered(points, turned, shift, symmetric.NOISE, DEFAULT.evidence)
    rotations, translations = competing_poses(points, turned, shift, motions, DEFAULT.evidence)
    poses = np.concatenate([rotation[None], rotations]), np.vstack([translation, translations])
    return bool(points.same_pose(*poses, Tolerance(RIGHT_DEG))[1:].any())


def main() -> None:
    options = parser(__doc__).parse_args()
    kinds = [kind for kind in symmetric.KINDS if kind.unique >= 8]
    counts: Counter[tuple[int, bool]] = Counter()
    led: list[bool] = []
    for kind in kinds:
        for problem in symmetric.problems(kind, options.limit, options.seed):
            if kind.name != "few":  # these are enumerated
                counts.update(reached(problem).items())
            led.append(leads_back(kind, problem))
    print("| basin count | poses that reached it | wrong | fraction | 2^-h |\n| --- | --- | --- | --- | --- |")
    for least in HITS:
        right, wrong = counts[least, True], counts[least, False]
        fraction = wrong / max(right + wrong, 1)
        print(f"| {least} | {right + wrong} | {wrong} | {fraction:.3f} | {0.5**least:.3f} |")
    print(f"\nmotions lead back to the true pose: {sum(led)} of {len(led)}")


if __name__ == "__main__":
    main()
