"""Hypotheses, each a minimal problem: solved, checked on the points beside it, refined on its matches, kept, varied."""

import math
from typing import Any, NamedTuple

from bpnp.loops.compilation import compiler
from bpnp.search.enumeration.matching import Matches, evidence, fits, match, nearest, sight, step
from bpnp.search.enumeration.minimal_solvers import chords_between, p2p, p3p, part
from bpnp.search.enumeration.points import Array, Places, Triangles
from bpnp.search.kernels.vectors import rotated

compiled = compiler(_nrt=False)


class Block(NamedTuple):
    """Image sets (t, 3) against triangles of the scene, each in every order; where two matches fix a pose, the last
    place of either is the one before it again. Image sets below `old_image` meet triangles from `old_scene` on alone.

    size: matches that fix a pose, 3 or 2. orders: (6, 3) or (2, 3) of a set. witnesses: (n, w) near points, of which
    `need` must be matched within `reach` radii for a pose to be looked at further.
    """

    size: int
    sets: Places
    orders: Places
    triangles: Triangles
    old_image: int
    old_scene: int
    witnesses: Places
    need: int
    reach: float


@compiled
def sweep(row: int, first: int, budget: int, stop: float, block: Any, problem: Any, kept: Any, work: Any) -> Any:
    """Solve up to `budget` hypotheses from row `row` on, one of an image set in one order, there from triangle `first`.

    Ends after an image set too when the best pose's evidence is `stop` nats. Returns the next row, the next triangle of
    it, and the number of hypotheses that were solved.
    """
    scene, image, prior = problem.scene, problem.image, problem.prior
    triangles, orders, rays, best = block.triangles, block.orders, image.rays, kept.best
    solved, t = 0, first
    while row < len(orders) * len(block.sets) and not (
        t == 0 and row % len(orders) == 0 and kept.evidence[best[0]] >= stop
    ):
        place, order = row // len(orders), row % len(orders)
        image_set, turn = block.sets[place], orders[order]
        i, j, k = image_set[turn[0]], image_set[turn[1]], image_set[turn[2]]
        if place < block.old_image and t < block.old_scene:
            t = block.old_scene
        chords, hand = chords_between(rays, i, j, k), 3
        if block.size == 3:
            hand = 1 if _determinant(rays[i], rays[j], rays[k]) > 0 else 2
        while t < len(triangles.triples):
            if solved >= budget:
                return row, t, solved
            a, b, c = triangles.triples[t, 0], triangles.triples[t, 1], triangles.triples[t, 2]
            t += 1
            if not triangles.orientation[t - 1] & hand:
                continue
            if not (
                fits(image.labels[i], scene.labels[a])
                and fits(image.labels[j], scene.labels[b])
                and fits(image.labels[k], scene.labels[c])
            ):
                continue
            known = kept.point[best[0]]
            if kept.counts[best[0]] >= problem.rules.skipped and known[i] == a and known[j] == b and known[k] == c:
                continue
            solved += 1
            if block.size == 3:
                count = p3p(rays, (i, j, k), chords, triangles, t - 1, work.depths, work.axes, work.poses)
            else:
                count = p2p(i, j, a, b, problem, work.poses)
            for s in range(count):
                pose = work.poses[s]
                if not (facing(pose, problem, a, i) and facing(pose, problem, b, j) and facing(pose, problem, c, k)):
                    continue
                if allowed(pose, prior) and witnessed(pose, (a, b, c), (i, j, k), block, problem):
                    consider(pose, block.reach, problem, kept, work)
        row, t = row + 1, 0
    return row, t, solved


@part
def _determinant(f: Any, g: Any, h: Any) -> float:
    """Positive where three rays turn right-handed."""
    return f[0] * (g[1] * h[2] - g[2] * h[1]) + f[1] * (g[2] * h[0] - g[0] * h[2]) + f[2] * (g[0] * h[1] - g[1] * h[0])


@part
def facing(pose: Any, problem: Any, a: int, i: int) -> bool:
    """Whether point a faces the camera that sees it along ray i."""
    normals, rays = problem.scene.normals, problem.image.rays
    if not len(normals):
        return True
    x, y, z = rotated(pose, normals[a, 0], normals[a, 1], normals[a, 2])
    return -(x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]) > problem.rules.matched_cosine


@part
def witnessed(pose: Any, points: Any, seen: Any, block: Any, problem: Any) -> bool:
    """Whether enough of the points near the first of a hypothesis, other than its own, are seen near image points other
    than its own."""
    witnesses, need, reach = block.witnesses, block.need, block.reach
    hits, left = 0, witnesses.shape[1]
    for w in range(witnesses.shape[1]):
        if hits + left < need:
            return False
        left -= 1
        p = witnesses[points[0], w]
        if p == points[1] or p == points[2]:
            continue
        u, v, cosine = sight(pose, problem.scene, p)
        if cosine < problem.rules.matched_cosine:
            continue
        q, _ = nearest(u, v, problem.scene.labels[p], reach * reach, problem.image)
        if q >= 0 and q != seen[0] and q != seen[1] and q != seen[2]:
            hits += 1
            if hits >= need:
                return True
    return hits >= need


class Kept(NamedTuple):
    """Distinct poses (c, 4, 3), their evidence (c,), numbers of matches (c,), matches (c, m) and squared distances
    (c, m). best: (1,) the place of the best. most: (1,) matches that any hypothesis of the stage had."""

    poses: Array
    evidence: Array
    counts: Places
    point: Places
    distance2: Array
    best: Places
    most: Array


class Work(NamedTuple):
    """What the loops overwrite: depths (4, 3) and axes (3, 3) of a triangle, poses (4, 4, 3) of a hypothesis, the pose
    (4, 3) at hand, its matches, the normal equations (8, 6), and another pose with the points (m,) of its matches."""

    depths: Array
    axes: Array
    poses: Array
    pose: Array
    matches: Matches
    system: Array
    other_pose: Array
    other_point: Places


@part
def copy(values: Any, to: Any) -> None:
    """Element by element: numba compiles an assignment of arrays for more than a second."""
    for k in range(len(values)):
        to[k] = values[k]


@part
def copy_pose(pose: Any, to: Any) -> None:
    for r in range(4):
        copy(pose[r], to[r])


@part
def consider(pose: Any, reach: float, problem: Any, kept: Any, work: Any) -> None:
    """Refine a pose that matches about as many points as any hypothesis did at this reach."""
    rules = problem.rules
    count, _, expected = match(pose, reach, problem, work.matches)
    value = count - rules.lacking * max(expected - count, 0)
    kept.most[0] = max(kept.most[0], value)
    if count > problem.fixing and value >= kept.most[0] - rules.behind:
        settle(pose, reach, problem, kept, work)


@part
def settle(pose: Any, reach: float, problem: Any, kept: Any, work: Any) -> None:
    """Refine a pose, in place, on matches within a radius that shrinks from `reach` to 1, and keep it; then within the
    radius that exceeds chance most, and keep that too. reach: 0 if it is refined already."""
    last = 1.0
    for _ in range(2):
        if reach > 0 and not tightened(pose, reach, last, problem, work):
            return
        count, visible, expected = match(pose, 1.0, problem, work.matches)
        if count <= problem.fixing:
            return
        value, last = evidence(count, visible, expected, work.matches, problem)
        keep(pose, value, count, work.matches, kept, problem.rules)
        if last == 1:
            return
        reach = 2 * last


@part
def tightened(pose: Any, reach: float, last: float, problem: Any, work: Any) -> bool:
    """Gauss-Newton steps, in place, on matches within a radius that shrinks from `reach` to `last`, and two at it."""
    left, directions = problem.rules.final, len(problem.prior.directions)
    while left > 0:
        count, _, _ = match(pose, reach, problem, work.matches)
        if count < 3 and count + directions < 3:
            return False
        if not step(pose, work.matches.point, problem, work.system):
            return False
        left -= reach <= last
        reach = max(last, problem.rules.tighter * reach)
    return allowed(pose, problem.prior)


@part
def allowed(pose: Any, prior: Any) -> bool:
    """Whether the pose agrees with what is known of its translation and of directions."""
    place, directions, shift2 = prior.place, prior.directions, 0.0
    for k in range(3):
        shift2 += (pose[3, k] - place[k]) ** 2
    if shift2 > place[3]:
        return False
    for k in range(len(directions)):
        x, y, z = rotated(pose, directions[k, 0], directions[k, 1], directions[k, 2])
        dx, dy, dz = x - directions[k, 3], y - directions[k, 4], z - directions[k, 5]
        if dx * dx + dy * dy + dz * dz > directions[k, 7]:
            return False
    return True


@part
def keep(pose: Any, value: float, count: int, matches: Any, kept: Any, rules: Any) -> None:
    """Put a pose among the kept ones: in the place of the same pose, of an empty one, or of the worst."""
    values, best, place = kept.evidence, kept.best, -1
    for c in range(len(values)):
        if values[c] > -math.inf and _same(pose, kept.poses[c], rules):
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
    values[place], kept.counts[place] = value, count
    copy_pose(pose, kept.poses[place])
    copy(matches.point, kept.point[place])
    copy(matches.distance2, kept.distance2[place])
    for c in range(len(values)):
        if values[c] > values[best[0]]:
            best[0] = c


@part
def _trace(pose: Any, other: Any) -> float:
    """Of the turn between two poses: 1 + 2 cos."""
    trace = 0.0
    for r in range(3):
        for c in range(3):
            trace += pose[r, c] * other[r, c]
    return trace


@part
def _same(pose: Any, other: Any, rules: Any) -> bool:
    shift2 = depth2 = 0.0
    for k in range(3):
        shift2 += (pose[3, k] - other[3, k]) ** 2
        depth2 += other[3, k] ** 2
    near = shift2 < (rules.same_shift + rules.same_depth * math.sqrt(depth2)) ** 2
    return near and _trace(pose, other) > rules.same_trace


@compiled
def vary(reach: float, exchanged: bool, problem: Any, kept: Any, work: Any) -> None:
    """Refine the pose in `work` from matches within `reach` radii, and keep it.

    exchanged: keep too what follows from the best pose when one of its matches is left out, or goes to the nearest
    other scene point. A single wrong match can turn a pose of few points by some degrees and still lie near its image
    point; no refinement finds the pose without it, since the wrong match holds it.
    """
    pose, matched, best, points = work.pose, work.matches.point, work.other_pose, work.other_point
    settle(pose, reach, problem, kept, work)
    count = 0
    if exchanged:
        copy_pose(kept.poses[kept.best[0]], best)
        copy(kept.point[kept.best[0]], points)
        count = kept.counts[kept.best[0]]
    for i in range(len(points)):
        if points[i] < 0 or count - 1 <= problem.fixing:
            continue
        other = -1
        for turn in range(2):
            copy_pose(best, pose)
            copy(points, matched)
            for k in range(len(points)):
                if turn and points[k] == other:
                    matched[k] = -1
            matched[i] = other
            if not _stepped(pose, problem, work):
                break
            other = _nearest_other(pose, i, points[i], problem)
            if _trace(pose, best) < problem.rules.moved_trace and allowed(pose, problem.prior):
                settle(pose, 0.0, problem, kept, work)
            if other < 0:
                break


@part
def _stepped(pose: Any, problem: Any, work: Any) -> bool:
    """Gauss-Newton steps, in place, on the matches in `work`."""
    steps = 0
    while steps < problem.rules.exchanged and step(pose, work.matches.point, problem, work.system):
        steps += 1
    return steps == problem.rules.exchanged


@part
def _nearest_other(pose: Any, i: int, matched: int, problem: Any) -> int:
    """The scene point nearest to image point i, of those that are not its match and fit its label; -1 for none."""
    scene, image, rules = problem.scene, problem.image, problem.rules
    place, least = -1, (rules.farthest / image.gain[i]) ** 2
    for j in range(len(scene.points)):
        if j == matched or not fits(scene.labels[j], image.labels[i]):
            continue
        u, v, cosine = sight(pose, scene, j)
        d2 = (u - image.flat[i, 0]) ** 2 + (v - image.flat[i, 1]) ** 2
        if cosine >= rules.matched_cosine and d2 < least:
            place, least = j, d2
    return place
