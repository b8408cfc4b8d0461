"""Every hypothesis of a block: image points against scene points, each solved as a minimal problem, and checked on the
points beside it."""

from typing import Any, NamedTuple

from bpnp.search.enumeration.matching import fits, nearest, sight
from bpnp.search.enumeration.p3p import chords_between, p3p, part
from bpnp.search.enumeration.points import Places, Triangles
from bpnp.search.enumeration.priors import p2p
from bpnp.search.enumeration.refinement import allowed, compiled, consider
from bpnp.search.kernels.vectors import rotated


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
