"""Competing poses of symmetric and repeated structures, such as a facade shifted by a window."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.arrays import Array, PoseArrays
from bpnp.poses import SAME
from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.image_statistics import Outline
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.problem import Problem
from bpnp.search.propose.collinear import find_line, rotations_about
from bpnp.search.propose.symmetries import (
    Motions,
    extent_and_spacing,
    matching_tolerance,
    mirror_pose,
    reflection,
    self_motions,
    tolerance_of,
)
from bpnp.search.verdict.false_alarms import SHARES, alarms_of, directions_of, point_evidence
from bpnp.search.verdict.reasons import Unfinished

# With fewer, the three that fix a pose are too large a part.
FEWEST_MATCHED = 6  # smallest number of matched points [points; derived]
MAPPED = 0.3  # smallest fraction of the matched points that a motion maps [fraction; calibration]
MAPPED_OF_SCENE = 0.2  # smallest fraction of all points that a motion of a whole scene maps [fraction; calibration]
SYMMETRIC = 0.5  # fraction of the matched points of a motion that could explain a better pose [fraction; calibration]
WHOLE_SCENE = 64  # largest scene that is registered as a whole, once for all its problems [points; cost]
# A motion of a third of the points is missed by at most (1 - 1/27)^128 = 0.8 % of the registrations.
BASES_OF_SCENE = 128  # number of bases of that registration [bases; derived]
AROUND_MATCHED = 4096  # points nearest to the matched ones that are registered, in a larger scene [points; cost]
MANY_AROUND = 500  # points up to which such a registration has `BASES_OF_FEW`, else `BASES_OF_MANY` [points; cost]
BASES_OF_FEW = 16  # number of bases with few points [bases; cost]
# A motion of nine tenths of the matches is missed by (1 - 0.9^3)^8 = 3e-5 of the registrations.
BASES_OF_MANY = 8  # number of bases with many points [bases; derived]
SIZE_RATIO = 4.0  # largest ratio of the sizes of a part and its copy, up to `MANY_AROUND` points [factor; not tuned]
KEPT_REPETITIONS = 6  # largest number of competing poses; those with the fewest false alarms are kept [poses; cost]
SCORED_AT_ONCE = 100_000  # points, times poses, that are scored between two checks of the deadline [points; cost]
CACHED_SCENES = 64  # number of scenes whose motions stay in the cache [scenes; cost]
MOST_MISSING = 1 / 3  # largest fraction of its points that a map may lack [fraction; not tuned]


class Repeated(NamedTuple):
    """Competing poses due to the motions of a scene, and to the mirror image of a flat one."""

    poses: Hypotheses  # (c,) unrefined poses
    scale: Array  # (c,) scale of the motion of each pose, 1 for rigid ones
    motions: Motions  # all motions, from which the poses were chosen


def registered(problem: Problem, rotation: Array, translation: Array, scale: float) -> Motions:
    """Return the motions that map the matched points of a pose onto other scene points, the largest fraction first.

    If a pose is wrong because of a symmetry or a repetition, one of these motions maps nearly all of its matched points
    onto those of the correct pose. They may be any fraction of the scene. There are none if too few points are matched.
    The residuals of the pose have the standard deviation `scale`, radians.
    """
    return _motions_of(problem, rotation, translation, scale, matched_points(problem, rotation, translation, scale))


def reflections(problem: Problem, rotation: Array, translation: Array, scale: float) -> Motions:
    """Return the reflections that map the matched points of a pose onto other scene points; see `registered`."""
    matched = matched_points(problem, rotation, translation, scale)
    return _motions_of(problem, rotation, translation, scale, matched, reflected=True)


def _motions_of(
    problem: Problem,
    rotation: Array,
    translation: Array,
    scale: float,
    matched: NDArray[np.int64],
    *,
    reflected: bool = False,
) -> Motions:
    """Return the motions that map the matched points (k,) of a pose onto other scene points; see `registered`."""
    points = problem.points3d
    if len(matched) < FEWEST_MATCHED:
        return Motions.none()
    noise = scale * float(np.median(np.linalg.norm(points[matched] @ rotation.T + translation, axis=-1)))
    labels, normals = problem.labels3d, problem.normals3d if problem.cosines3d is None else None
    if len(points) <= WHOLE_SCENE:
        arrays = [_frozen(x) for x in (points, labels, normals)]
        tolerance = tolerance_of(*_extent_of_scene(arrays[0]), noise)
        motions = _of_scene(*arrays, tolerance, MAPPED_OF_SCENE, BASES_OF_SCENE, SIZE_RATIO, reflected)
        return motions.of(points, matched, tolerance, MAPPED, labels3d=labels, normals3d=normals)
    centre = np.median(points[matched], 0)
    near = np.sort(np.argsort(np.linalg.norm(points - centre, axis=-1), kind="stable")[:AROUND_MATCHED])
    sources = np.flatnonzero(np.isin(near, matched))
    if len(sources) < FEWEST_MATCHED:
        return Motions.none()
    part = points[near]
    return self_motions(
        part,
        matching_tolerance(part, sources, noise),
        sources=sources,
        labels3d=None if labels is None else labels[near],
        normals3d=None if normals is None else normals[near],
        least=MAPPED,
        bases=BASES_OF_FEW if len(part) <= MANY_AROUND else BASES_OF_MANY,
        factor=SIZE_RATIO if len(part) <= MANY_AROUND else 1.0,
        reflected=reflected,
    )


def matched_points(problem: Problem, rotation: Array, translation: Array, scale: float) -> NDArray[np.int64]:
    """Return the indices of the scene points that a pose shows at an image point, by residuals of `scale` radians."""
    camera = problem.points3d @ rotation.T + translation
    depth = np.linalg.norm(camera, axis=-1)
    away, nearest = cKDTree(camera / np.maximum(depth, 1e-300)[:, None]).query(problem.bearings)
    return np.unique(nearest[away < MATCH_REACH * scale])


Frozen = tuple[bytes, str, tuple[int, ...]] | None


def _frozen(array: NDArray[Any] | None) -> Frozen:
    """Convert an array to a key of a cache."""
    return None if array is None else (np.ascontiguousarray(array).tobytes(), array.dtype.str, array.shape)


def _thawed(content: Frozen) -> NDArray[Any] | None:
    """Convert a key of a cache back to an array."""
    return None if content is None else np.frombuffer(content[0], content[1]).reshape(content[2]).copy()


@lru_cache(maxsize=CACHED_SCENES)
def _extent_of_scene(points: Frozen) -> tuple[float, float]:
    """Return the extent and the spacing of a whole scene, cached for all problems of it."""
    array = _thawed(points)
    assert array is not None
    return extent_and_spacing(array, np.arange(len(array)))


@lru_cache(maxsize=CACHED_SCENES)
def _of_scene(
    points: Frozen,
    labels: Frozen,
    normals: Frozen,
    tolerance: float,
    least: float,
    bases: int,
    factor: float,
    reflected: bool,
) -> Motions:
    """Return the motions of a whole scene, cached for all problems of it."""
    arrays = [_thawed(each) for each in (points, labels, normals)]
    assert arrays[0] is not None
    options: dict[str, Any] = {"labels3d": arrays[1], "normals3d": arrays[2], "reflected": reflected}
    return self_motions(arrays[0], tolerance, least=least, bases=bases, factor=factor, **options)


def competing_poses(
    problem: Problem, rotation: Array, translation: Array, scale: float, *, least: float = 0.0
) -> tuple[Array, Array, Array, Motions]:
    """Return the competing poses of a pose, with the scales (c,) of their motions, and all motions.

    They differ from the pose, whose residuals have the `scale` in radians, by over `SAME`. They are images by motions
    of its matched points, about a line of these, and from afar by reflections of these or the mirror image of a flat
    scene. A motion maps at least the fraction `least` of the matched points.
    """
    matched = matched_points(problem, rotation, translation, scale)
    motions = _motions_of(problem, rotation, translation, scale, matched).mapping(least)
    poses = motions.competitors(rotation, translation)
    every = [rotation[None], poses[0]], [translation[None], poses[1]], [np.ones(1), motions.scale]
    if (line := find_line(problem.points3d[matched])) is not None:
        turned = rotations_about(problem, rotation, translation, line, scale)
        for parts, some in zip(every, (*turned, np.ones(len(turned[0]))), strict=True):
            parts.append(some)
    if (mirrored := mirror_pose(problem.points3d, rotation, translation)) is not None:
        for parts, one in zip(every, (*mirrored, np.ones(())), strict=True):
            parts.append(one[None])
    if _is_far(problem, rotation, translation, scale, matched):
        reflections = _motions_of(problem, rotation, translation, scale, matched, reflected=True)
        images = reflections.mirror_images(rotation, translation, problem.points3d[matched].mean(0))
        for parts, some in zip(every, (*images, reflections.scale), strict=True):
            parts.append(some)
    rotations, translations, scales = (np.concatenate(parts) for parts in every)
    other = np.flatnonzero(~problem.same_as((rotation, translation), rotations, translations, SAME))
    return rotations[other], translations[other], scales[other], motions


def _is_far(problem: Problem, rotation: Array, translation: Array, scale: float, matched: NDArray[np.int64]) -> bool:
    """Return whether half of the matched points (k,) would still be matched if their depths were reversed."""
    if len(matched) < FEWEST_MATCHED:
        return False
    camera = problem.points3d[matched] @ rotation.T + translation
    seen = camera.mean(0)
    mirrored = seen + (camera - seen) @ reflection(seen)
    one, other = (x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-300) for x in (camera, mirrored))
    near = np.linalg.norm(one - other, axis=-1) < MATCH_REACH * scale
    return float(near.mean()) >= SYMMETRIC


def repeated_poses(
    problem: Problem,
    rotation: Array,
    translation: Array,
    scale: float,
    *,
    least: float = 0.0,
    deadline: Deadline = NEVER,
) -> Repeated:
    """Return the competing poses of a pose with residuals of `scale` radians due to motions of the scene, and these.

    The unrefined poses differ from the given one by over `SAME`; there are at most `KEPT_REPETITIONS`, the fewest false
    alarms first. A flat scene adds the mirror image. Poses that are not scored at the end of the deadline are left out.

    >>> import numpy as np
    >>> motif = np.random.default_rng(0).uniform(0, 1, (12, 3))
    >>> scene = np.concatenate([motif + [2 * k, 0, 6] for k in range(3)])
    >>> image = motif + [0, 0, 6]  # the first of three equal things
    >>> problem = Problem(image / np.linalg.norm(image, axis=1, keepdims=True), scene)
    >>> repeated = repeated_poses(problem, np.eye(3), np.zeros(3), 1e-3)
    >>> sorted(repeated.poses.translation[:2, 0].round(6).tolist())
    [-4.0, -2.0]
    """
    rotations, translations, sizes, motions = competing_poses(problem, rotation, translation, scale, least=least)
    scales = np.full(len(rotations), scale)
    alarms = np.full(len(scales), math.inf)
    step = max(SCORED_AT_ONCE // (len(problem.bearings) + len(problem.points3d)), 1)
    for k in range(0, len(scales), step):
        if k and deadline.ended(Unfinished.competing_poses):
            break
        part = slice(k, k + step)
        alarms[part] = alarms_of(problem, rotations[part], translations[part], scales[part]).own
    poses = Hypotheses.from_poses(
        rotations, translations, scale=scales, log10_false_alarms=alarms, log10_rough=alarms.copy()
    )
    kept = np.argsort(alarms, kind="stable")[:KEPT_REPETITIONS]
    kept = kept[np.isfinite(alarms[kept])]
    return Repeated(poses[kept], sizes[kept], motions)


def repetition_margins(
    problem: Problem,
    best: PoseArrays,
    repeated: PoseArrays,
    competitors: PoseArrays,
    scale: float,
    most_missing: float = MOST_MISSING,
    *,
    fraction: float = 0.0,
) -> Array:
    """Return the margins (c,), in decades, by which competing poses explain the image points worse than the best one.

    All poses are compared at one scale, radians, and against an even density of scene points, since their actual
    density does not distinguish between copies of a structure. An image point does not count against a competing pose
    if the map may end there. It then lies outside the projected points of that pose, and a motion of the `repeated`
    poses, unrefined and by rigid motions, maps its scene point onto another one: a map does not go on with ever smaller
    copies. Any point may be missing in the map. With q the fraction of image points that the best pose does not
    explain, no point counts for more than (1 - q) / q; q is at most `most_missing`, and 1 - `fraction` if every motion
    maps this fraction of the matched points.
    """
    seen = [directions_of(problem, *best), *(directions_of(problem, r, t) for r, t in zip(*competitors, strict=True))]
    logs = np.stack([point_evidence(problem, one, np.array([scale]), SHARES[-1:], even=True)[:, 0, 0] for one in seen])
    count = logs.shape[1]
    missing = min((int((logs[0] < 0).sum()) + 1) / (count + 2), (count * (1 - fraction) + 1) / (count + 2))
    missing = min(missing, most_missing)
    most = math.log((1 - missing) / missing)
    is_repeated = _is_repeated(problem, best, repeated, MATCH_REACH * scale)
    points = problem.bearings[problem.image.chosen]
    counted = np.stack([Outline(problem.image, one).contains(points) for one in seen[1:]]) | ~is_repeated
    return np.asarray(np.where(counted, np.clip(logs[0] - logs[1:], -most, most), 0).sum(-1) / math.log(10))


def _is_repeated(problem: Problem, best: PoseArrays, repeated: PoseArrays, reach: float) -> NDArray[np.bool_]:
    """Return for each chosen image point (k,) if a motion, or its inverse, maps its scene point onto another one.

    A motion is p -> Q p + d. A repeated pose sees the point Q p + d where the best pose sees p.
    """
    points, (rotation, translation) = problem.points3d, best
    camera = points @ rotation.T + translation
    depth = np.linalg.norm(camera, axis=-1)
    _, nearest = cKDTree(camera / np.maximum(depth, 1e-300)[:, None]).query(problem.bearings[problem.image.chosen])
    own, reach = points[nearest], reach * float(np.median(depth[nearest]))
    moved = [
        target
        for r, t in zip(*repeated, strict=True)
        for target in ((own @ rotation.T + translation - t) @ r, (own @ r.T + t - translation) @ rotation)
    ]
    each = np.reshape(moved, (-1, len(own), 3))
    return np.asarray(np.isfinite(cKDTree(points).query(each, distance_upper_bound=reach)[0]).any(0))
