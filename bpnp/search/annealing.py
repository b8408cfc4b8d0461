"""From starts to distinct poses: annealed on coarse clusters, on finer ones, and on all points."""

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.distinct_poses import SAME_DEG, SAME_SHIFT, distinct
from bpnp.search.alignment import descend as descend_in_torch
from bpnp.search.candidates import Pool
from bpnp.search.kernels_dense import descend
from bpnp.search.kernels_grid import build_grid, descend_sparse
from bpnp.search.scene import Scene
from bpnp.search.starts import Array, Prior, Spread, draw_poses
from bpnp.thread_pool import spread


class Recipe(NamedTuple):
    """How the starts of a batch are drawn and annealed. Scales are relative to the spread of the bearings."""

    first_scale: float
    outliers: float  # share of the points without a partner that the assignment expects
    spread: Spread


RECIPES = (
    Recipe(0.30, 0.15, Spread(0.0, 0.5)),
    Recipe(0.45, 0.30, Spread(0.0, 0.5)),
    Recipe(0.30, 0.15, Spread(1.0, 0.8)),
    Recipe(0.35, 0.50, Spread(0.5, 1.2)),
)
STARTS = 1200
COARSE, COARSE_ROUNDS, COARSE_SCALE = 64, 10, 0.1
MIDDLE, MIDDLE_ROUNDS, MIDDLE_SCALE, MIDDLE_STARTS = 256, 16, 0.04, 48
FINE, FINE_STARTS, FINE_OUTLIERS, SMALLEST_SCALE = 1000, 10, 0.3, 2e-4
SHRINK, PATIENCE, SWEEPS = 0.82, 3, 4
RELAXATION = np.float32(1.7)  # of the steps while annealing: expectation-maximisation takes short ones
KEPT = 8
SHAKEN, SHAKES, SHAKE_DEG, SHAKE_SHIFT = 4, 6, 6.0, 0.1
FINISH_SCALES = 2.0
SHARES = (0.03, 0.6)  # of outliers, tried at the end beside the expected one


def run_batch(scene: Scene, recipe: Recipe, prior: Prior | None, pool: Pool | None, fine_outliers: float) -> Pool:
    """One batch of starts, from clusters to all points, and beside them starts around the best poses so far."""
    rotation, translation = draw_poses(scene.bearings, scene.near3d, STARTS, recipe.spread, prior, scene.rng)
    score = np.empty(len(rotation), np.float32)
    outlier = scene.outlier_density(recipe.outliers)
    scales = cooling(scene.spread, recipe.first_scale, COARSE_SCALE, COARSE_ROUNDS)
    descend_on_clusters(scene, COARSE, rotation, translation, scales, outlier, score)

    kept = distinct(rotation, translation, score, MIDDLE_STARTS, SAME_DEG, math.inf)
    rotation, translation = rotation[kept], translation[kept]
    fresh = len(kept)
    if pool is not None:
        around = shaken(scene, pool)
        rotation, translation = np.concatenate([rotation, around[0]]), np.concatenate([translation, around[1]])
    return _descend_further(scene, rotation, translation, fresh, recipe.outliers, fine_outliers)


def refine_batch(scene: Scene, pool: Pool, outliers: float) -> Pool:
    """From the poses of a pool, and from poses shaken around them, through the finer clusters to all points."""
    rotation, translation = shaken(scene, pool)
    rotation, translation = np.concatenate([pool.rotation, rotation]), np.concatenate([pool.translation, translation])
    clustered = _descend_further(scene, rotation, translation, 0, outliers, outliers)
    # A start that is right already needs no clusters, which would only shake it.
    direct = polish(
        scene, pool.rotation, pool.translation, pool.hits, MIDDLE_SCALE * scene.spread, outliers, bearings=FINE
    )
    return clustered.joined(direct, SHAKEN)


def _descend_further(
    scene: Scene, rotation: Array, translation: Array, fresh: int, outliers: float, fine_outliers: float
) -> Pool:
    """From coarse poses, of which the first `fresh` count as hits, through finer clusters to all points."""
    score = np.empty(len(rotation), np.float32)
    scales = cooling(scene.spread, COARSE_SCALE, MIDDLE_SCALE, MIDDLE_ROUNDS)
    outlier = scene.outlier_density(outliers)
    descend_on_clusters(scene, MIDDLE, rotation, translation, scales, outlier, score)
    kept = distinct(rotation, translation, score, FINE_STARTS, 1.0, math.inf)
    return polish(
        scene, rotation[kept], translation[kept], kept < fresh, MIDDLE_SCALE * scene.spread, fine_outliers,
        bearings=FINE,
    )  # fmt: skip


def descend_on_clusters(
    scene: Scene, count: int, rotation: Array, translation: Array, scales: Array, outlier: np.float32, score: Array
) -> None:
    """Anneal poses on `count` clusters of each side, in place, with their scores."""
    clusters = scene.clusters(count)
    if scene.device is not None:
        f, a, p, b = (torch.as_tensor(x, device=scene.device) for x in clusters)
        turns, shifts = (torch.as_tensor(x, device=scene.device) for x in (rotation, translation))
        ends = descend_in_torch(f.T, a, p.T, b, turns, shifts, scales.tolist(), float(outlier), float(RELAXATION))
        rotation[:], translation[:], score[:] = (x.cpu().numpy() for x in ends)
        return
    spread(
        lambda i, j: descend(*clusters, rotation[i:j], translation[i:j], scales, outlier, RELAXATION, score[i:j]),
        len(rotation),
    )


def shaken(scene: Scene, pool: Pool) -> tuple[Array, Array]:
    """Starts around the best poses: a way out of a narrow optimum beside a better one."""
    rotation = np.repeat(pool.rotation[:SHAKEN], SHAKES, 0)
    turn = Rotation.from_rotvec(math.radians(SHAKE_DEG) * scene.rng.standard_normal((len(rotation), 3))).as_matrix()
    translation = np.repeat(pool.translation[:SHAKEN], SHAKES, 0)
    depth = np.linalg.norm(translation, axis=-1, keepdims=True)
    translation = translation + SHAKE_SHIFT * depth * scene.spread * scene.rng.standard_normal(translation.shape)
    return (turn @ rotation).astype(np.float32), translation.astype(np.float32)


def polish(
    scene: Scene, rotation: Array, translation: Array, hits: NDArray[Any], first_scale: float, outliers: float,
    *, bearings: int | None,
) -> Pool:  # fmt: skip
    """Anneal poses on all points and the first `bearings` bearings (None for all)."""
    rounds = max(4, math.ceil(math.log(SMALLEST_SCALE / first_scale) / math.log(SHRINK)))
    scales = (first_scale * SHRINK ** np.arange(rounds)).astype(np.float32)
    result = np.empty((len(rotation), 3), np.float32)
    grid = build_grid(scene.bearings[:bearings], float(scales[-1]))
    rotation, translation = rotation.copy(), translation.copy()
    points, outlier = np.ascontiguousarray(scene.points3d.T), scene.outlier_density(outliers)
    spread(
        lambda i, j: descend_sparse(
            tuple(grid)[:5], points, rotation[i:j], translation[i:j], scales, outlier, SWEEPS, np.float32(1), PATIENCE,
            result[i:j],
        ),
        len(rotation),
    )  # fmt: skip
    result[:, 0] += math.log(1 - outliers)  # the mixture's factor, for shares to be compared
    kept = distinct(rotation, translation, result[:, 0], len(result), SAME_DEG, SAME_SHIFT)
    return Pool(rotation[kept], translation[kept], result[kept], hits[kept].astype(np.int64))


def finish(scene: Scene, pool: Pool, outliers: float) -> Pool:
    """The poses, annealed once more on every bearing, the best of them for several shares of outliers too."""
    ends = [_again(scene, pool, i, outliers) for i in range(len(pool.hits))]
    ends += [_again(scene, pool, i, share) for i in range(min(2, len(pool.hits))) for share in SHARES]
    return functools.reduce(lambda joined, end: joined.joined(end, KEPT), ends)


def _again(scene: Scene, pool: Pool, i: int, outliers: float) -> Pool:
    first_scale = FINISH_SCALES * float(pool.result[i, 2])
    own = pool.rotation[[i]], pool.translation[[i]], pool.hits[[i]]
    return polish(scene, *own, first_scale, outliers, bearings=None)


def cooling(spread: float, first: float, last: float, rounds: int) -> Array:
    """Scales of the rounds, falling by the same factor each; `first` and `last` are relative to the spread."""
    return (spread * np.geomspace(first, last, rounds)).astype(np.float32)
