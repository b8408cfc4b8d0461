"""Candidates that did not come out of one search: poses of a module, and the poses of two searches."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from bpnp.distinct_poses import SAME_DEG, SAME_SHIFT, distinct, near
from bpnp.search.annealing import FINE_OUTLIERS, KEPT, SMALLEST_SCALE, finish
from bpnp.search.candidates import OTHER_DEG, Pool, is_safe, plausible
from bpnp.search.many import Candidates
from bpnp.search.scene import Scene
from bpnp.solving.problem import Array, Problem
from bpnp.types import SolveStats


def scored(problem: Problem, rotation: Array, translation: Array) -> Candidates:
    """Poses (c, 3, 3), (c, 3) annealed a little and scored as those of a search; NaN for a missing one.

    Nothing but unique matches makes them safe, for no other starts were tried.
    """
    found = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    if not found.any():
        return as_candidates(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 3)), 0, safe=False, fits=False)
    scene = Scene(problem.bearings, problem.local3d, 0)
    turned, moved = scene.enter(rotation[found], translation[found])
    tree = cKDTree(scene.bearings)
    camera = scene.points3d @ turned.transpose(0, 2, 1) + moved[:, None]
    seen = camera / np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12)
    distance = np.stack([np.median(tree.query(points)[0]) for points in seen])
    result = np.zeros((len(seen), 3), np.float32)
    result[:, 2] = np.maximum(distance, SMALLEST_SCALE)
    pool = finish(scene, Pool(turned, moved, result, np.zeros(len(seen), np.int64)), FINE_OUTLIERS)
    some = len(pool.hits) > 0
    safe, fits = some and is_safe(pool, scene), some and plausible(pool, scene)
    poses = scene.leave(pool.rotation, pool.translation)
    return as_candidates(*poses, pool.result.astype(np.float64), len(seen), safe=safe, fits=fits)


def merged(problem: Problem, around: Candidates, anywhere: Candidates) -> Candidates:
    """The distinct poses of two searches, best first; safe if both found the best one and one of them was sure."""
    rotation, translation, score, matched, scale = (
        torch.cat([first[0], second[0]]).double().numpy()
        for first, second in zip(_values(around), _values(anywhere), strict=True)
    )
    scene = Scene(problem.bearings, problem.local3d, 0)
    turned, moved = scene.enter(rotation, translation)
    kept = distinct(turned, moved, score.astype(np.float32), KEPT, SAME_DEG, SAME_SHIFT)
    second_best = len(around.score[0])
    agree = len(kept) > 0 and bool(near(turned, moved, int(kept[0]), OTHER_DEG, np.inf)[second_best])
    return as_candidates(
        rotation[kept],
        translation[kept],
        np.stack([score, matched, scale], -1)[kept],
        int(around.stats.iterations[0] + anywhere.stats.iterations[0]),
        safe=agree and bool(anywhere.stats.converged[0] | around.stats.converged[0]),
        fits=len(kept) > 0 and bool((around if kept[0] < second_best else anywhere).plausible[0]),
    )


def as_candidates(
    rotation: Array, translation: Array, result: Array, rounds: int, *, safe: bool, fits: bool
) -> Candidates:
    """One sample's poses and their (score, matched, scale) (c, 3), with as many slots as a search has."""
    slots = max(KEPT, len(rotation))
    padded = [np.full((1, slots, *values.shape[1:]), np.nan) for values in (rotation, translation, result)]
    for target, values in zip(padded, (rotation, translation, result), strict=True):
        target[0, : len(values)] = values
    turns, shifts, numbers = (torch.as_tensor(values) for values in padded)
    score, matched, scale = numbers.unbind(-1)
    stats = SolveStats(
        torch.tensor([rounds]), torch.nan_to_num(scale[:, 0], nan=torch.inf), torch.tensor([safe], dtype=torch.bool)
    )  # fmt: skip
    return Candidates(turns, shifts, score, matched, scale, stats, torch.tensor([fits]))


def _values(candidates: Candidates) -> tuple[torch.Tensor, ...]:
    return (
        candidates.rotation, candidates.translation, candidates.score, candidates.matched, candidates.scale,
    )  # fmt: skip
