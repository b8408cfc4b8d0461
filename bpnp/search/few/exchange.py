"""Poses beside the best one that rest on other matches: one is left out, or goes to another scene point. Compiled.

A single wrong match can turn a pose of few points by some degrees and still be near its image point. The pose without
it, or with the partner that the others would give it, is found by no refinement: the wrong match holds it.
"""

from typing import Any

from bpnp.compilation import compiler
from bpnp.search.few.adjustment import refine
from bpnp.search.few.kept import allowed, settle
from bpnp.search.few.matching import WIDEST_MATCHED, sight

compiled = compiler(error_model="numpy", boundscheck=False)
STEPS = 3  # of Gauss-Newton on the matches that are left
FARTHEST = 4.0  # radii from an image point within which another partner is looked for


@compiled
def exchange(
    best: Any, own: Any, rays: Any, scene: Any, image: Any, used: int, density: float, prior: Any, found: Any, work: Any
) -> None:  # fmt: skip
    """Keep the poses that follow from the best one (12,) and its matches (m,) when one match is left out, or replaced.

    The other arguments are those of `kept.try_pose`.
    """
    pose, matched = work[2], work[3]
    count = 0
    for i in range(len(own)):
        count += own[i] >= 0
    for i in range(len(own)):
        if own[i] < 0 or count - 1 <= used:
            continue
        pose[:], matched[:] = best, own
        matched[i] = -1
        if not _refined(pose, rays, scene, prior, work):
            continue
        other = _nearest_other(pose, i, own[i], scene, image)
        if allowed(pose, prior, work[9]):
            settle(rays, scene, image, used, density, prior, found, work)
        if other < 0:
            continue
        pose[:], matched[:] = best, own
        for k in range(len(own)):
            if own[k] == other:
                matched[k] = -1
        matched[i] = other
        if _refined(pose, rays, scene, prior, work) and allowed(pose, prior, work[9]):
            settle(rays, scene, image, used, density, prior, found, work)


@compiled
def _refined(pose: Any, rays: Any, scene: Any, prior: Any, work: Any) -> bool:
    """Gauss-Newton steps, in place, on the matches in `work`."""
    steps = 0
    while steps < STEPS and refine(pose, rays, scene[0], work[3], prior, work[5], work[6], work[7]):
        steps += 1
    return steps == STEPS


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
