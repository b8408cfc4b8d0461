"""Every hypothesis of a block: image triples against scene triples, each a P3P, checked on the points beside it."""

from typing import Any

from bpnp.search.few.kept import allowed, consider
from bpnp.search.few.matching import WIDEST_MATCHED, compiled, nearest, part, sight, turned
from bpnp.search.few.p3p import p3p_depths
from bpnp.search.few.triangles import pose_of_triangle

SKIPPED = 5  # matches of the best pose from which its own triples are not solved again


@compiled
def sweep(
    first: int, last: int, old_image: int, old_scene: int, new_scene: int, stop: float, budget: int,
    rays: Any, image_triples: Any, scene_triples: Any, witnesses: Any, need: int, reach: float,
    scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any,
) -> tuple[int, int]:  # fmt: skip
    """Solve image triples `first` to `last` against scene triples below `new_scene`; those below `old_image` only
    against scene triples from `old_scene` on.

    Ends after an image triple when the best pose's evidence is `stop` nats, or `budget` hypotheses were solved.
    image_triples, scene_triples: of `orders_of_triples` and `triangle_table`. witnesses: (n, w) near points, of
    which `need` must be matched within `reach` radii for a pose to be looked at further. found: the kept poses.
    Returns the next image triple and the number of hypotheses.
    """
    orders, chords, hands = image_triples
    triples3d, sides, frames, middles, orientation = scene_triples
    labels3d, labels2d = scene[2], image[2]
    depths, axes, pose = work[0], work[1], work[2]
    best = found[5]
    solved = 0
    place = first
    while place < last and solved < budget and found[1][best[0]] < stop:
        begin = old_scene if place < old_image else 0
        for permutation in range(6):
            row = 6 * place + permutation
            i, j, k = orders[row, 0], orders[row, 1], orders[row, 2]
            chord = chords[row, 0], chords[row, 1], chords[row, 2]
            for t in range(begin, new_scene):
                if not orientation[t] & hands[row]:
                    continue
                a, b, c = triples3d[t, 0], triples3d[t, 1], triples3d[t, 2]
                if not (
                    fits(labels2d[i], labels3d[a]) and fits(labels2d[j], labels3d[b]) and fits(labels2d[k], labels3d[c])
                ):
                    continue
                known, pairs = found[3][best[0]], found[2][best[0]]
                if pairs >= SKIPPED and known[i] == a and known[j] == b and known[k] == c:
                    continue
                solved += 1
                for s in range(p3p_depths(*chord, sides[t, 0], sides[t, 1], depths)):
                    if not pose_of_triangle(rays, i, j, k, depths[s], sides[t, 2], frames[t], middles[t], axes, pose):
                        continue
                    if not (faces(pose, scene, rays, a, i, b, j) and faces(pose, scene, rays, b, j, c, k)):
                        continue
                    if not allowed(pose, prior, work[7]):
                        continue
                    if witnessed(pose, a, b, c, i, j, k, witnesses, need, reach, scene, image):
                        consider(pose, reach, rays, scene, image, used, density, prior, found, work)
        place += 1
    return place, solved


@part
def fits(one: int, other: int) -> bool:
    return one < 0 or other < 0 or one == other


@part
def faces(pose: Any, scene: Any, rays: Any, a: int, i: int, b: int, j: int) -> bool:
    """Whether points a and b face the camera that sees them along the rays i and j."""
    normals = scene[1]
    return len(normals) == 0 or (
        _cosine(pose, normals, a, rays, i) > WIDEST_MATCHED and _cosine(pose, normals, b, rays, j) > WIDEST_MATCHED
    )


@part
def _cosine(pose: Any, normals: Any, a: int, rays: Any, i: int) -> float:
    x, y, z = turned(pose, normals[a, 0], normals[a, 1], normals[a, 2])
    return -(x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2])


@part
def witnessed(
    pose: Any, a: int, b: int, c: int, i: int, j: int, k: int, witnesses: Any, need: int, reach: float, scene: Any,
    image: Any,
) -> bool:  # fmt: skip
    """Whether `need` of the points near a, other than b and c, are seen near image points other than i, j, k."""
    points, normals, labels3d = scene
    flat, gain, labels2d, corner, starts, items = image
    hits, left = 0, witnesses.shape[1]
    for w in range(witnesses.shape[1]):
        if hits + left < need:
            return False
        left -= 1
        p = witnesses[a, w]
        if p in (b, c):
            continue
        u, v, cosine = sight(pose, points, normals, p)
        if cosine < WIDEST_MATCHED:
            continue
        q, _ = nearest(u, v, labels3d[p], reach * reach, flat, gain, labels2d, corner, starts, items)
        if q >= 0 and q != i and q != j and q != k:
            hits += 1
            if hits >= need:
                return True
    return hits >= need
