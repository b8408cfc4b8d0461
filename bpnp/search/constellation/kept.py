"""The distinct poses that an enumeration keeps: which are refined, and how they compare. Compiled.

`found`: poses (c, 12), evidence (c,), counts (c, 3) of matches, points in sight and points expected, matches (c, m),
squared distances (c, m), the place of the best (1,), and (2,) numbers of the sweep. `work`: depths (4, 3), axes (3, 3),
the pose at hand (12,), its matches (m,) and squared distances (m,), and a 6 x 6 system.
"""

import math
from typing import Any

from bpnp.compilation import compiler
from bpnp.search.constellation.adjustment import refine
from bpnp.search.constellation.matching import evidence, match

compiled = compiler(error_model="numpy", boundscheck=False)
SAME = 1 + 2 * math.cos(math.radians(3.0))  # trace of the turn between two poses that are the same
SAME_SHIFT, SAME_DEPTH = 0.1, 0.05  # of the scene's extent and of its distance
TIGHTENING = 4  # rounds of a refinement: matches, then a step
BEHIND = 1.0  # matches that a hypothesis may have less than any other had, to be refined
LACKING = 0.25  # matches that an expected but missing point takes away


@compiled
def consider(
    pose: Any, rays: Any, scene: Any, image: Any, reach: float, used: int, density: float, prior: Any, found: Any,
    work: Any,
) -> None:  # fmt: skip
    """Refine a pose that matches about as many points as any hypothesis did at this reach."""
    ahead = found[6]
    count, _, expected = match(pose, reach, scene, image, work[3], work[4])
    ahead[1] = max(ahead[1], count - LACKING * max(expected - count, 0))
    if count > used and count - LACKING * max(expected - count, 0) >= ahead[1] - BEHIND:
        try_pose(rays, scene, image, reach, used, density, prior, found, work)


@compiled
def try_pose(
    rays: Any, scene: Any, image: Any, reach: float, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:
    """Refine the pose in `work`, on matches within a radius that shrinks to the one that exceeds chance most, and keep
    it."""
    pose, matched, distance2 = work[2], work[3], work[4]
    if not tightened(pose, rays, scene, image, reach, 1.0, prior, work):
        return
    for turn in range(2):
        count, visible, expected = match(pose, 1.0, scene, image, matched, distance2)
        if count <= used:
            return
        value, radius = evidence(count, visible, expected, distance2, matched, used, density)
        keep(pose, value, count, visible, expected, found, work)
        if turn or radius == 1 or not tightened(pose, rays, scene, image, 2 * radius, radius, prior, work):
            return


@compiled
def tightened(
    pose: Any, rays: Any, scene: Any, image: Any, reach: float, last: float, prior: Any, work: Any
) -> bool:  # fmt: skip
    """Gauss-Newton steps, in place, on matches within a radius that shrinks from `reach` to `last`."""
    for _ in range(TIGHTENING):
        count, _, _ = match(pose, reach, scene, image, work[3], work[4])
        if count < 3 or not refine(pose, rays, scene[0], work[3], prior, work[5], work[6], work[7]):
            return False
        reach = max(last, 0.6 * reach)
    return True


@compiled
def keep(pose: Any, value: float, count: int, visible: int, expected: int, found: Any, work: Any) -> None:
    """Put a pose among the kept ones: in the place of the same pose, of an empty one, or of the worst."""
    poses, values, counts, matches, distances2, best, _ = found
    place = -1
    for c in range(len(values)):
        if values[c] > -math.inf and _same(pose, poses[c]):
            if values[c] >= value:
                return
            if place >= 0:
                values[c] = -math.inf  # both are this pose
            else:
                place = c
    if place < 0:
        place = 0
        for c in range(1, len(values)):
            if values[c] < values[place]:
                place = c
    if values[place] >= value:
        return
    poses[place], values[place] = pose, value
    counts[place, 0], counts[place, 1], counts[place, 2] = count, visible, expected
    matches[place], distances2[place] = work[3], work[4]
    for c in range(len(values)):
        if values[c] > values[best[0]]:
            best[0] = c


@compiled
def _same(one: Any, other: Any) -> bool:
    trace = shift2 = depth2 = 0.0
    for k in range(9):
        trace += one[k] * other[k]
    for k in range(9, 12):
        shift2 += (one[k] - other[k]) ** 2
        depth2 += other[k] ** 2
    return trace > SAME and shift2 < (SAME_SHIFT + SAME_DEPTH * math.sqrt(depth2)) ** 2
