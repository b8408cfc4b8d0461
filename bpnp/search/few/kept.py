"""The distinct poses that an enumeration keeps: which are refined, and how they compare. Compiled.

`found`: poses (c, 12), evidence (c,), numbers of matches (c,), matches (c, m), squared distances (c, m), the place of
the best (1,), and (2,) numbers of the sweep. `work`: depths (4, 3), axes (3, 3), the pose at hand (12,), its matches
(m,) and squared distances (m,), the normal equations (8, 6), poses (2, 12) of two pairs, the place (4,) that a prior
allows, and a pose (12,) with its matches (m,) that others are compared with.
"""

import math
from typing import Any

from bpnp.search.few.matching import WIDEST_MATCHED, compiled, evidence, match, part, refine, sight, turned

SAME = 1 + 2 * math.cos(math.radians(2.0))  # trace of the turn between two poses that are the same
SAME_SHIFT, SAME_DEPTH = 0.1, 0.05  # of the scene's extent and of its distance
TIGHTER, FINAL = 0.55, 3  # factor of the radius from one step of a refinement to the next, and steps at the last
BEHIND = 1.0  # matches that a hypothesis may have less than any other had, to be refined
MOVED = 1 + 2 * math.cos(math.radians(0.3))  # trace of the turn beyond which a pose without a match is looked at
EXCHANGED = 3  # Gauss-Newton steps on the matches that are left when one is taken away
FARTHEST = 4.0  # radii from an image point within which another partner is looked for
LACKING = 0.25  # matches that an expected but missing point takes away


@part
def copy(values: Any, to: Any) -> None:
    """Element by element: numba compiles an assignment of arrays for more than a second."""
    for k in range(len(values)):
        to[k] = values[k]


@part
def consider(
    pose: Any, reach: float, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any,
    work: Any,
) -> None:  # fmt: skip
    """Refine a pose that matches about as many points as any hypothesis did at this reach."""
    ahead = found[6]
    count, _, expected = match(pose, reach, scene, image, work[3], work[4])
    ahead[1] = max(ahead[1], count - LACKING * max(expected - count, 0))
    if count > used and count - LACKING * max(expected - count, 0) >= ahead[1] - BEHIND:
        settle(reach, rays, scene, image, used, density, prior, found, work)


@part
def settle(
    reach: float, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:
    """Refine the pose in `work` on matches within a radius that shrinks from `reach` to 1, and keep it; then within the
    radius that exceeds chance most, and keep that too. reach: 0 if it is refined already."""
    pose, matched, distance2, last = work[2], work[3], work[4], 1.0
    for _ in range(2):
        if reach > 0 and not tightened(pose, rays, scene, image, reach, last, prior, work):
            return
        count, visible, expected = match(pose, 1.0, scene, image, matched, distance2)
        if count <= used:
            return
        value, last = evidence(count, visible, expected, distance2, matched, used, density)
        keep(pose, value, count, found, matched, distance2)
        if last == 1:
            return
        reach = 2 * last


@part
def tightened(
    pose: Any, rays: Any, scene: Any, image: Any, reach: float, last: float, prior: Any, work: Any
) -> bool:  # fmt: skip
    """Gauss-Newton steps, in place, on matches within a radius that shrinks from `reach` to `last`, and two at it."""
    left = FINAL
    while left > 0:
        count, _, _ = match(pose, reach, scene, image, work[3], work[4])
        if count < 3 and count + len(prior) < 3:
            return False
        if not refine(pose, rays, scene[0], work[3], prior, work[5]):
            return False
        left -= reach <= last
        reach = max(last, TIGHTER * reach)
    return allowed(pose, prior, work[7])


@part
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


@part
def keep(pose: Any, value: float, count: int, found: Any, matched: Any, distance2: Any) -> None:
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
    copy(matched, matches[place])
    copy(distance2, distances2[place])
    for c in range(len(values)):
        if values[c] > values[best[0]]:
            best[0] = c


@part
def _trace(one: Any, other: Any) -> float:
    """Of the turn between two poses: 1 + 2 cos."""
    trace = 0.0
    for k in range(9):
        trace += one[k] * other[k]
    return trace


@part
def _same(one: Any, other: Any) -> bool:
    shift2 = depth2 = 0.0
    for k in range(9, 12):
        shift2 += (one[k] - other[k]) ** 2
        depth2 += other[k] ** 2
    return _trace(one, other) > SAME and shift2 < (SAME_SHIFT + SAME_DEPTH * math.sqrt(depth2)) ** 2


@compiled
def vary(
    reach: float, exchanged: bool, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any,
    work: Any,
) -> None:  # fmt: skip
    """Refine the pose in `work` from matches within `reach` radii, and keep it.

    exchanged: keep too what follows from the best pose when one of its matches is left out, or goes to the nearest
    other scene point. A single wrong match can turn a pose of few points by some degrees and still lie near its image
    point; no refinement finds the pose without it, since the wrong match holds it.
    """
    settle(reach, rays, scene, image, used, density, prior, found, work)
    pose, matched, best, own = work[2], work[3], work[8], work[9]
    count = 0
    if exchanged:
        copy(found[0][found[5][0]], best)
        copy(found[3][found[5][0]], own)
        count = found[2][found[5][0]]
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
            if _trace(pose, best) < MOVED and allowed(pose, prior, work[7]):
                settle(0.0, rays, scene, image, used, density, prior, found, work)
            if other < 0:
                break


@part
def _stepped(pose: Any, rays: Any, scene: Any, prior: Any, work: Any) -> bool:
    """Gauss-Newton steps, in place, on the matches in `work`."""
    steps = 0
    while steps < EXCHANGED and refine(pose, rays, scene[0], work[3], prior, work[5]):
        steps += 1
    return steps == EXCHANGED


@part
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
