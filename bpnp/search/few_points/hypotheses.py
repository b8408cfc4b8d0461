"""Hypotheses of the enumeration: solve a minimal problem, preverify, refine the pose on its matches, and keep it.

Compiled; the poses that are kept become `bpnp.search.hypotheses.Hypotheses`.
"""

import math
from typing import Any, NamedTuple

from bpnp.arrays import Array, Indices
from bpnp.poses import SAME
from bpnp.search.few_points.matching import (
    MATCHED_COSINE,
    EnumerationTables,
    Matches,
    cell_of,
    evidence,
    fits,
    match,
    nearest,
    sight,
    step,
)
from bpnp.search.few_points.points import PriorArrays
from bpnp.search.kernels.vectors import copy_pose, rotated
from bpnp.search.propose.minimal_solvers import Triangles, chords_between, compiled, part, solve_p2p, solve_p3p

LACKING = 0.25  # matches subtracted from a hypothesis for each expected but missing point [matches; calibration]
# Pairs of an image set and a scene set that a sweep may visit per hypothesis of its budget. Those whose labels differ
# are no hypothesis; this many take about as long as one.
VISITED_PAIRS = 256  # [pairs; cost]
BEHIND = 1.0  # matches that a hypothesis may lack against the best of its stage to be refined [matches; calibration]
SKIPPED_MATCHES = 5  # matches of the best pose from which its own triples are not solved again [matches; calibration]
SKIPPED_BASIN_COUNT = 12  # basin count of the best pose that skipping requires too [hypotheses; calibration]
TIGHTER = 0.55  # factor of the radius from one step of a refinement to the next [factor; calibration]
FINAL_STEPS = 3  # steps of a refinement at its last radius [steps; calibration]
# Smallest trace of the rotation between two poses that are the same (`Tolerance`).
SAME_TRACE = 1 + 2 * math.cos(math.radians(SAME.degrees))  # [1; derived]
SAME_SHIFT = SAME.shift  # largest shift between them, as a fraction of the scene's distance [fraction; derived]


class Block(NamedTuple):
    """Image sets paired with scene triangles, each in every order.

    Sets below `old_image` are paired only with triangles from `old_scene` on: the other pairs were tried before.
    """

    size: int  # matches that fix a pose, 3 or 2
    sets: Indices  # (t, 3) image points; with size 2 the last index repeats the second
    orders: Indices  # (6, 3) or (2, 3) orders of a set
    triangles: Triangles  # triangles of the scene; with size 2 the last point repeats the second
    by_label: Indices  # (t,) indices of the triangles in the order of the label of their first point, -1 first
    # (m,) index in `by_label` of the first triangle whose first point has the label of an image point, or has a label
    # if that is -1.
    low: Indices
    high: Indices  # (m,) index behind the last one
    free: int  # number of triangles whose first point has the label -1
    old_image: int  # number of sets of an earlier block
    old_scene: int  # number of triangles of an earlier block
    witnesses: Indices  # (n, w) preverification points near each scene point
    need: int  # preverification points that must be matched
    reach: float  # radius of their matches, in match radii


@compiled
def explore(
    row: int,
    first: int,
    budget: int,
    stop: float,
    reach: float,
    block: Block,
    problem: EnumerationTables,
    kept: "Kept",
    work: "Work",
) -> Any:
    """Call `sweep`, or `settle` the first pose in `work` if the budget is 0.

    One entry point for both, so that their common code is compiled once.
    """
    if budget > 0:
        return sweep(row, first, budget, stop, block, problem, kept, work)
    kept.at[0] = -1
    settle(work.poses[0], reach, problem, kept, work)
    return row, first, 0, 0


@part
def sweep(
    row: int, first: int, budget: int, stop: float, block: Block, problem: EnumerationTables, kept: "Kept", work: "Work"
) -> Any:
    """Solve up to `budget` hypotheses from a row and one of its triangles on, and keep the refined poses.

    A row is an image set in one order, paired with the triangles whose first point fits the label of its first point.
    The sweep also ends after an image set once the best evidence reaches `stop`, nats, and after `VISITED_PAIRS` pairs
    of a row and a triangle per hypothesis: labels may exclude most pairs. Return the next row, its next triangle, and
    the numbers of hypotheses solved and of pairs visited.
    """
    triangles, orders, rays, best, poses = block.triangles, block.orders, problem.image.rays, kept.best, work.poses
    labels2d, labels3d, normals = problem.image.grid.labels, problem.scene.labels, problem.scene.normals
    old_image, old_scene, by_label, free = block.old_image, block.old_scene, block.by_label, block.free
    solved, visited, at = 0, 0, first
    while row < len(orders) * len(block.sets) and not (
        at == 0 and row % len(orders) == 0 and kept.evidence[best[0]] >= stop
    ):
        place, order = row // len(orders), row % len(orders)
        image_set, turn = block.sets[place], orders[order]
        i, j, k = image_set[turn[0]], image_set[turn[1]], image_set[turn[2]]
        offset, last = block.low[i] - free, free + block.high[i] - block.low[i]
        if place < old_image and at < old_scene and free == len(by_label):
            at = old_scene
        chords, hand = chords_between(rays, i, j, k), 3
        kept.at[0] = place
        if block.size == 3:
            hand = 1 if _determinant(rays[i], rays[j], rays[k]) > 0 else 2
        while at < last:
            if solved >= budget or visited >= VISITED_PAIRS * budget:
                return row, at, solved, visited
            t = by_label[at if at < free else offset + at]
            at, visited = at + 1, visited + 1
            if (place < old_image and t < old_scene) or not triangles.orientation[t] & hand:
                continue
            a, b, c = triangles.triples[t, 0], triangles.triples[t, 1], triangles.triples[t, 2]
            if not (
                fits(labels2d[i], labels3d[a]) and fits(labels2d[j], labels3d[b]) and fits(labels2d[k], labels3d[c])
            ):
                continue
            its_points = kept.point[best[0]]
            own = its_points[i] == a and its_points[j] == b and its_points[k] == c
            if own and kept.counts[best[0]] >= SKIPPED_MATCHES and kept.basin_count[best[0]] >= SKIPPED_BASIN_COUNT:
                continue
            solved += 1
            if block.size == 2:
                count = solve_p2p(i, j, a, b, problem.heading, rays, problem.scene.points, poses)
            else:
                count = solve_p3p(rays, (i, j, k), chords, triangles, t, poses)
            for s in range(count):
                pose = poses[s]
                if not (
                    facing(pose, normals, a, rays, i)
                    and facing(pose, normals, b, rays, j)
                    and facing(pose, normals, c, rays, k)
                ):
                    continue
                if allowed(pose, problem.prior) and witnessed(pose, (a, b, c), (i, j, k), block, problem):
                    consider(pose, block.reach, problem, kept, work)
        row, at = row + 1, 0
    return row, at, solved, visited


@part
def _determinant(f: Any, g: Any, h: Any) -> float:
    """Return the triple product of three rays, positive if they are right-handed."""
    return f[0] * (g[1] * h[2] - g[2] * h[1]) + f[1] * (g[2] * h[0] - g[0] * h[2]) + f[2] * (g[0] * h[1] - g[1] * h[0])


@part
def facing(pose: Array, normals: Array, a: int, rays: Array, i: int) -> bool:
    """Return whether point a faces the camera along ray i; always True without normals."""
    if not len(normals):
        return True
    x, y, z = rotated(pose, normals[a, 0], normals[a, 1], normals[a, 2])
    return -(x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]) > MATCHED_COSINE


@part
def witnessed(pose: Array, points: Any, seen: Any, block: Block, problem: EnumerationTables) -> bool:
    """Return whether enough preverification points near the first of three points are seen near image points.

    The three points of the hypothesis, and its own image points `seen`, do not count.
    """
    witnesses, need, reach, scene, grid = block.witnesses, block.need, block.reach, problem.scene, problem.image.grid
    hits, left = 0, witnesses.shape[1]
    for w in range(witnesses.shape[1]):
        if hits + left < need:
            return False
        left -= 1
        p = witnesses[points[0], w]
        if p == points[1] or p == points[2]:
            continue
        u, v, cosine = sight(pose, scene, p)
        if cosine < MATCHED_COSINE:
            continue
        q, _ = nearest(u, v, cell_of(u, v, grid), scene.labels[p], reach * reach, grid)
        if q >= 0 and q != seen[0] and q != seen[1] and q != seen[2]:
            hits += 1
            if hits >= need:
                return True
    return hits >= need


class Kept(NamedTuple):
    """Distinct poses of the enumeration, with their matches."""

    poses: Array  # (c, 4, 3)
    evidence: Array  # (c,) nats; -inf for an empty slot
    counts: Indices  # (c,) numbers of matches
    point: Indices  # (c, m) scene point of each image point, or -1
    distance2: Array  # (c, m) squared distances, in match radii
    best: Indices  # (1,) index of the best pose
    most: Array  # (1,) largest number of matches of a hypothesis in this stage, less `LACKING` for each missing point
    basin_count: Indices  # (c,) number of image sets with a hypothesis that ended at the pose
    last: Indices  # (c,) image set that was counted last
    at: Indices  # (1,) current image set; -1 for a pose from elsewhere


class Work(NamedTuple):
    """Buffers of the loops: poses (4, 4, 3) of a hypothesis, matches of the current pose, equations (8, 6)."""

    poses: Array
    matches: Matches
    system: Array


@part
def copy(values: Any, to: Any) -> None:
    """Copy element by element: numba compiles an assignment of arrays for more than a second."""
    for k in range(len(values)):
        to[k] = values[k]


@part
def consider(pose: Array, reach: float, problem: EnumerationTables, kept: "Kept", work: "Work") -> None:
    """Refine a pose with about as many matches as the best hypothesis of the stage."""
    count, _, expected = match(pose, reach, problem.scene, problem.image.grid, work.matches)
    value = count - LACKING * (expected - count if expected > count else 0)
    kept.most[0] = max(kept.most[0], value)
    if count > problem.fixing and value >= kept.most[0] - BEHIND:
        settle(pose, reach, problem, kept, work)


@part
def settle(pose: Array, reach: float, problem: EnumerationTables, kept: "Kept", work: "Work") -> None:
    """Refine a pose (4, 3) in place and keep it, at radius 1 and then at its most significant radius.

    The matches are those within a radius that shrinks from `reach` match radii to 1; 0 for a pose that is refined
    already. If the evidence is largest at a smaller radius, the pose is refined there too, and also kept.
    """
    last = 1.0
    for _ in range(2):
        if reach > 0 and not tightened(pose, reach, last, problem, work.matches, work.system):
            return
        count, visible, expected = match(pose, 1.0, problem.scene, problem.image.grid, work.matches)
        if count <= problem.fixing:
            return
        value, last = evidence(count, visible, expected, work.matches, problem.fixing, problem.density)
        keep(pose, value, count, work.matches, kept)
        if last == 1:
            return
        reach = 2 * last


@part
def tightened(
    pose: Array, reach: float, last: float, problem: EnumerationTables, matches: Matches, system: Any
) -> bool:
    """Refine a pose in place by Gauss-Newton steps on matches within a shrinking radius.

    The radius shrinks from `reach` to `last`, in match radii; `FINAL_STEPS` steps follow there. Return False for too
    few matches, a singular step, or a pose that the prior excludes.
    """
    left, directions = FINAL_STEPS, len(problem.prior.in_scene)
    while left > 0:
        count, _, _ = match(pose, reach, problem.scene, problem.image.grid, matches)
        if count < 3 and count + directions < 3:
            return False
        if not step(pose, matches.point, problem, system):
            return False
        left -= reach <= last
        reach = max(last, TIGHTER * reach)
    return allowed(pose, problem.prior)


@part
def allowed(pose: Array, prior: PriorArrays) -> bool:
    """Return whether a pose agrees with the prior translation and directions."""
    in_scene, in_camera, shift2, off2 = prior.in_scene, prior.in_camera, 0.0, 0.0
    for k in range(3):
        shift2 += (pose[3, k] - prior.translation[k]) ** 2
    if shift2 > prior.farthest_shift2:
        return False
    for k in range(len(in_scene)):
        x, y, z = rotated(pose, in_scene[k, 0], in_scene[k, 1], in_scene[k, 2])
        dx, dy, dz = x - in_camera[k, 0], y - in_camera[k, 1], z - in_camera[k, 2]
        off2 += dx * dx + dy * dy + dz * dz
    return off2 <= prior.farthest2


@part
def keep(pose: Array, value: float, count: int, matches: Matches, kept: "Kept") -> None:
    """Store a pose in the slot of the same pose, of an empty one, or of the worst; count its basin."""
    values, best, place, is_new = kept.evidence, kept.best, -1, False
    for c in range(len(values)):
        if values[c] > -math.inf and _same(pose, kept.poses[c]):
            if kept.at[0] >= 0 and kept.last[c] != kept.at[0]:
                kept.basin_count[c], kept.last[c] = kept.basin_count[c] + 1, kept.at[0]
            if values[c] >= value:
                return
            if place >= 0:
                values[c] = -math.inf  # both are this pose
                kept.basin_count[place] = max(kept.basin_count[place], kept.basin_count[c])
            else:
                place = c
    if place < 0:
        place, is_new = 0, True
        for c in range(1, len(values)):
            if values[c] < values[place]:
                place = c
    if values[place] >= value:
        return
    values[place], kept.counts[place] = value, count
    if is_new:
        kept.basin_count[place], kept.last[place] = kept.at[0] >= 0, kept.at[0]
    copy_pose(pose, pose[3], kept.poses[place], kept.poses[place, 3])
    copy(matches.point, kept.point[place])
    copy(matches.distance2, kept.distance2[place])
    for c in range(len(values)):
        if values[c] > values[best[0]]:
            best[0] = c


@part
def _same(pose: Array, other: Array) -> bool:
    """Return whether two poses (4, 3) are the same within the tolerances of `SAME`."""
    shift2 = depth2 = trace = 0.0  # trace of the rotation between them: 1 + 2 cos
    for k in range(3):
        shift2 += (pose[3, k] - other[3, k]) ** 2
        depth2 += other[3, k] ** 2
        for c in range(3):
            trace += pose[k, c] * other[k, c]
    near = shift2 < SAME_SHIFT**2 * depth2
    return near and trace > SAME_TRACE
