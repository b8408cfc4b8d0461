"""The distinct poses that an enumeration keeps: which are refined, and how they compare. Compiled.

`found`: poses (c, 12), evidence (c,), numbers of matches (c,), matches (c, m), squared distances (c, m), the place of
the best (1,), and (2,) numbers of the sweep. `work`: depths (4, 3), axes (3, 3), the pose at hand (12,), its matches
(m,) and squared distances (m,), a 6 x 6 system, poses (2, 12) of two pairs, and the place (4,) that a prior allows.
"""

import math
from typing import Any

from bpnp.compilation import compiler
from bpnp.search.few.adjustment import refine
from bpnp.search.few.matching import WIDEST_MATCHED, evidence, match, sight, turned

compiled = compiler(error_model="numpy", boundscheck=False)
SAME = 1 + 2 * math.cos(math.radians(2.0))  # trace of the turn between two poses that are the same
SAME_SHIFT, SAME_DEPTH = 0.1, 0.05  # of the scene's extent and of its distance
TIGHTER, FINAL = 0.55, 3  # factor of the radius from one step of a refinement to the next, and steps at the last
BEHIND = 1.0  # matches that a hypothesis may have less than any other had, to be refined
MOVED = 1 + 2 * math.cos(math.radians(0.3))  # trace of the turn beyond which a pose without a match is looked at
EXCHANGED = 3  # Gauss-Newton steps on the matches that are left when one is taken away
FARTHEST = 4.0  # radii from an image point within which another partner is looked for
LACKING = 0.25  # matches that an expected but missing point takes away


@compiled
def copy(values: Any, to: Any) -> None:
    """Element by element: numba compiles an assignment of arrays for more than a second."""
    for k in range(len(values)):
        to[k] = values[k]


@compiled
def consider(
    pose: Any, reach: float, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any,
    work: Any,
) -> None:  # fmt: skip
    """Refine a pose that matches about as many points as any hypothesis did at this reach."""
    ahead = found[6]
    count, _, expected = match(pose, reach, scene, image, work[3], work[4])
    ahead[1] = max(ahead[1], count - LACKING * max(expected - count, 0))
    if count > used and count - LACKING * max(expected - count, 0) >= ahead[1] - BEHIND:
        try_pose(reach, rays, scene, image, used, density, prior, found, work)


@compiled
def try_pose(
    reach: float, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:
    """Refine the pose in `work`, on matches within a radius that shrinks to the one that exceeds chance most, and keep
    it."""
    if tightened(work[2], rays, scene, image, reach, 1.0, prior, work):
        settle(rays, scene, image, used, density, prior, found, work)


@compiled
def settle(
    rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:  # fmt: skip
    """Keep the pose in `work`, and what becomes of it on matches within the radius that exceeds chance most."""
    pose, matched, distance2 = work[2], work[3], work[4]
    for turn in range(2):
        count, visible, expected = match(pose, 1.0, scene, image, matched, distance2)
        if count <= used:
            return
        value, radius = evidence(count, visible, expected, distance2, matched, used, density)
        keep(pose, value, count, found, work)
        if turn or radius == 1 or not tightened(pose, rays, scene, image, 2 * radius, radius, prior, work):
            return


@compiled
def tightened(
    pose: Any, rays: Any, scene: Any, image: Any, reach: float, last: float, prior: Any, work: Any
) -> bool:  # fmt: skip
    """Gauss-Newton steps, in place, on matches within a radius that shrinks from `reach` to `last`, and two at it."""
    left = FINAL
    while left > 0:
        count, _, _ = match(pose, reach, scene, image, work[3], work[4])
        if count < 3 and count + len(prior) < 3:
            return False
        if not refine(pose, rays, scene[0], work[3], prior, work[5], work[6], work[7]):
            return False
        left -= reach <= last
        reach = max(last, TIGHTER * reach)
    return allowed(pose, prior, work[9])


@compiled
def allowed(pose: Any, prior: Any, place: Any) -> bool:
    """Whether the pose agrees with what is known of it: directions a that R takes to b, rows (a, b, weight, largest
    squared distance) of `prior`; and the translation, (t, largest squared distance) in `place`."""
    shift2 = 0.0
    for k in range(3):
        shift2 += (pose[9 + k] - place[k]) ** 2
    if shift2 > place[3]:
        return False
    for k in range(len(prior)):
        x, y, z = turned(pose, prior[k, 0], prior[k, 1], prior[k, 2])
        dx, dy, dz = x - prior[k, 3], y - prior[k, 4], z - prior[k, 5]
        if dx * dx + dy * dy + dz * dz > prior[k, 7]:
            return False
    return True


@compiled
def keep(pose: Any, value: float, count: int, found: Any, work: Any) -> None:
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
    values[place] = value
    copy(pose, poses[place])
    counts[place] = count
    copy(work[3], matches[place])
    copy(work[4], distances2[place])
    for c in range(len(values)):
        if values[c] > values[best[0]]:
            best[0] = c


@compiled
def _trace(one: Any, other: Any) -> float:
    """Of the turn between two poses: 1 + 2 cos."""
    trace = 0.0
    for k in range(9):
        trace += one[k] * other[k]
    return trace


@compiled
def _same(one: Any, other: Any) -> bool:
    shift2 = depth2 = 0.0
    for k in range(9, 12):
        shift2 += (one[k] - other[k]) ** 2
        depth2 += other[k] ** 2
    return _trace(one, other) > SAME and shift2 < (SAME_SHIFT + SAME_DEPTH * math.sqrt(depth2)) ** 2


@compiled
def exchange(
    best: Any, own: Any, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:  # fmt: skip
    """Keep the poses that follow from the best one (12,) and its matches (m,) when one of them is left out, or goes to
    the nearest other scene point.

    A single wrong match can turn a pose of few points by some degrees and still lie near its image point; no refinement
    finds the pose without it, since the wrong match holds it.
    """
    pose, matched = work[2], work[3]
    count = 0
    for i in range(len(own)):
        count += own[i] >= 0
    for i in range(len(own)):
        if own[i] < 0 or count - 1 <= used:
            continue
        other = -1
        for turn in range(2):
            copy(best, pose)
            copy(own, matched)
            for k in range(len(own)):
                if turn and own[k] == other:
                    matched[k] = -1
            matched[i] = other
            if not _stepped(pose, rays, scene, prior, work):
                break
            other = _nearest_other(pose, i, own[i], scene, image)
            if _trace(pose, best) < MOVED and allowed(pose, prior, work[9]):
                settle(rays, scene, image, used, density, prior, found, work)
            if other < 0:
                break


@compiled
def _stepped(pose: Any, rays: Any, scene: Any, prior: Any, work: Any) -> bool:
    """Gauss-Newton steps, in place, on the matches in `work`."""
    steps = 0
    while steps < EXCHANGED and refine(pose, rays, scene[0], work[3], prior, work[5], work[6], work[7]):
        steps += 1
    return steps == EXCHANGED


@compiled
def _nearest_other(pose: Any, i: int, own: int, scene: Any, image: Any) -> int:
    """The scene point nearest to image point i, of those that are not its own and that fit its label; -1 for none."""
    points, normals, labels3d = scene
    flat, gain, labels2d = image[0], image[1], image[2]
    found, least = -1, (FARTHEST / gain[i]) ** 2
    for j in range(len(points)):
        if j == own or (labels3d[j] >= 0 and labels2d[i] >= 0 and labels3d[j] != labels2d[i]):
            continue
        u, v, cosine = sight(pose, points, normals, j)
        d2 = (u - flat[i, 0]) ** 2 + (v - flat[i, 1]) ** 2
        if cosine >= WIDEST_MATCHED and d2 < least:
            found, least = j, d2
    return found
