"""Pose from two unmatched point sets, without training: many starts, annealed; batch after batch until one is safe."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from bpnp.search.annealing import FINE_OUTLIERS, KEPT, RECIPES, finish, run_batch
from bpnp.search.candidates import BETTER, Pool, is_exhausted, is_safe, plausible
from bpnp.search.scene import Scene, degenerate
from bpnp.search.starts import Array, Prior
from bpnp.types import SolveStats

Progress = Callable[[int, int, float], None]  # pair, batch, seconds
LEAST_CLUTTER = 0.02


class Candidates(NamedTuple):
    """Distinct poses of each sample, best first; NaN in empty slots.

    score: mean log-likelihood of the bearings, nats. matched: expected share of min(m, n) that is matched.
    scale: standard deviation of the residuals per axis, radians, at which score and matched were taken.
    stats: iterations are batches of starts; converged where more of them would hardly have changed the best pose.
    plausible: whether the best pose fits about as closely as the bearings lie and matches enough of them.
    """

    rotation: Float[Tensor, "b c 3 3"]
    translation: Float[Tensor, "b c 3"]
    score: Float[Tensor, "b c"]
    matched: Float[Tensor, "b c"]
    scale: Float[Tensor, "b c"]
    stats: SolveStats
    plausible: Bool[Tensor, " b"]


def search_candidates(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    prior: Prior | None = None,
    clutter: float | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    max_batches: int = 32,
    device: torch.device | None = None,
    progress: Progress | None = None,
) -> Candidates:
    """Every distinct pose (R, t) found that explains the bearings f_i by the points p_j, in no known order.

    Maximises the likelihood of the bearings under the mixture
    p(f_i) = (1 - w)/n sum_j exp((f_i . g(R p_j + t) - 1)/s^2) / 2 pi s^2 + w/A, g(y) = y/|y|, over pose and scale s,
    A the solid angle of the view, by annealing s from starts over all rotations.

    bearings: unit vectors of any field of view. points3d: any unit, any origin. prior: what is known of the pose.
    clutter: share of the points without a partner to expect, from 0 to below 1; None tries several.
    seed: of the starts, the same for each sample, so that no pose depends on the other samples.
    time_limit: seconds a sample, after which no batch of starts begins; the result then depends on the machine.
    max_batches: of starts, at most. progress: called after each batch with sample, batch and seconds.
    device: of the coarse rounds, by default that of the bearings; the fine ones look up neighbours on the host.

    A sample with fewer than 4 points of a side, or with all its bearings or all its points on one line or in one
    place, has no candidates. Not differentiable.
    Raises ValueError for a `time_limit` or `max_batches` that is not positive.
    """
    if max_batches < 1 or (time_limit is not None and not time_limit > 0):
        raise ValueError(f"expected a positive `max_batches` and `time_limit`, got {max_batches} and {time_limit}")
    if clutter is not None and not 0 <= clutter < 1:
        raise ValueError(f"expected `clutter` in [0, 1), a share of the points, got {clutter}")
    found, on = [], bearings.device if device is None else device
    for i in range(len(bearings)):
        f = bearings[i] if mask2d is None else bearings[i][mask2d[i]]
        p = points3d[i] if mask3d is None else points3d[i][mask3d[i]]
        found.append(
            _search_pair(
                f.detach().double().cpu().numpy(),
                p.detach().double().cpu().numpy(),
                _Budget(max_batches, math.inf if time_limit is None else time_limit, time.monotonic()),
                prior,
                clutter,
                seed,
                None if on.type == "cpu" else on,
                None if progress is None else partial(progress, i),
            )
        )
    return _stacked(found, points3d)


def search(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    prior: Prior | None = None,
    clutter: float | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    max_batches: int = 32,
    progress: Progress | None = None,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """The best of `search_candidates`, whose arguments these are: rotation, translation and stats.

    A sample without a candidate holds NaN and `converged` False; `residual` is the scale of its residuals, radians.
    """
    found = search_candidates(
        bearings, points3d, mask2d=mask2d, mask3d=mask3d, prior=prior, clutter=clutter, seed=seed,
        time_limit=time_limit, max_batches=max_batches, progress=progress,
    )  # fmt: skip
    return found.rotation[:, 0], found.translation[:, 0], found.stats


class _Found(NamedTuple):
    poses: (
        tuple[NDArray[np.float64], NDArray[np.float64], Array] | None
    )  # rotations, translations in scene units, results
    batches: int
    safe: bool
    plausible: bool = False


class _Budget(NamedTuple):
    batches: int
    seconds: float
    start: float

    def spent(self) -> float:
        return time.monotonic() - self.start


def _search_pair(
    bearings: NDArray[np.float64],
    points3d: NDArray[np.float64],
    budget: _Budget,
    prior: Prior | None,
    clutter: float | None,
    seed: int,
    device: torch.device | None,
    progress: Callable[[int, float], None] | None,
) -> _Found:
    if degenerate(bearings) or degenerate(points3d):
        return _Found(None, 0, False)
    scene = Scene(bearings, points3d, seed, device)
    known = None if prior is None else scene.enter_prior(prior)
    share = FINE_OUTLIERS if clutter is None else max(clutter, LEAST_CLUTTER)
    pool: Pool | None = None
    batch, stalled, best = 0, 0, -math.inf
    safe = exhausted = False
    while batch < budget.batches and not (safe or exhausted) and budget.spent() < budget.seconds:
        recipe = RECIPES[batch % len(RECIPES)]
        recipe = recipe if clutter is None else recipe._replace(outliers=share)
        found = run_batch(scene, recipe, known, pool, share)
        pool = found if pool is None else pool.joined(found, KEPT)
        batch += 1
        if len(pool.hits):
            stalled = stalled + 1 if pool.result[0, 0] < best + BETTER else 0
            best = float(pool.result[0, 0])
            safe, exhausted = is_safe(pool, scene), is_exhausted(pool, scene, stalled)
        if progress is not None:
            progress(batch, budget.spent())
    if pool is None or not len(pool.hits):
        return _Found(None, batch, False)
    pool = finish(scene, pool, share)
    rotation, translation = scene.leave(pool.rotation, pool.translation)
    return _Found((rotation, translation, pool.result), batch, safe, plausible(pool, scene))


def _stacked(found: list[_Found], like: Tensor) -> Candidates:
    b = len(found)
    shape = (b, KEPT)
    rotation, translation = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
    result = np.full((*shape, 3), np.nan)
    for i, one in enumerate(found):
        if one.poses is not None:
            count = len(one.poses[0])
            rotation[i, :count], translation[i, :count], result[i, :count] = one.poses
    score, matched, scale = (torch.as_tensor(values).to(like) for values in np.moveaxis(result, -1, 0))
    stats = SolveStats(
        torch.tensor([one.batches for one in found], device=like.device),
        torch.nan_to_num(scale[:, 0], nan=torch.inf),
        torch.tensor([one.safe for one in found], device=like.device, dtype=torch.bool),
    )
    fits = torch.tensor([one.plausible for one in found], device=like.device, dtype=torch.bool)
    turned, shifted = torch.as_tensor(rotation).to(like), torch.as_tensor(translation).to(like)
    return Candidates(turned, shifted, score, matched, scale, stats, fits)
