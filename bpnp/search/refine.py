"""Pose refinement without correspondences: anneal the soft assignment from poses of which one is roughly right."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.distinct_poses import SAME_DEG, distinct
from bpnp.geometry import is_finite
from bpnp.search.annealing import (
    COARSE,
    COARSE_ROUNDS,
    COARSE_SCALE,
    FINE_OUTLIERS,
    MIDDLE,
    MIDDLE_ROUNDS,
    MIDDLE_SCALE,
    RECIPES,
    SHAKEN,
    SHAKES,
    cooling,
    descend_on_clusters,
    finish,
    refine_batch,
)
from bpnp.search.candidates import Pool, is_safe
from bpnp.search.scene import Scene, degenerate
from bpnp.search.starts import Array
from bpnp.types import SolveStats

FEW = 8  # starts that are annealed on all points; more compete on clusters for these places
COMPETITORS = 32  # from the coarse clusters to the finer ones
# Clusters of each side, first and last scale in spreads of the bearings, rounds, starts that go on.
HEATS = (
    (COARSE, RECIPES[0].first_scale, COARSE_SCALE, COARSE_ROUNDS, COMPETITORS),
    (MIDDLE, COARSE_SCALE, MIDDLE_SCALE, MIDDLE_ROUNDS, FEW),
)


def refine(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b s 3 3"],
    translation: Float[Tensor, "b s 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    outliers: float = FINE_OUTLIERS,
    seed: int = 0,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """The likeliest pose that annealing reaches from s starts of each sample and from poses shaken around them.

    The objective is that of `bpnp.layers.search_candidates`; a start may be some 10 degrees off, and more where there
    are many: those beyond 8 are first annealed on clusters, as the search does, and the likeliest go on. bearings: unit
    vectors. points3d: any unit. rotation, translation: the starts; NaN for one that is missing.
    outliers: share of the points without a partner to expect, in (0, 1).

    Returns rotation, translation and stats (iterations: starts annealed; residual: scale of the residuals, radians;
    converged: the pose is safe by `is_safe`). A sample without a start, or whose points do not fix
    a pose, holds NaN and `converged` False. Not differentiable; runs on the host's cores. A sample's result depends
    neither on the other samples nor on padding.
    Raises ValueError for `outliers` out of range.
    """
    if not 0 < outliers < 1:
        raise ValueError(f"expected `outliers` in (0, 1), a share of the points, got {outliers}")
    b = len(bearings)
    out_r, out_t = np.full((b, 3, 3), np.nan), np.full((b, 3), np.nan)
    annealed, scale, safe = np.zeros(b, np.int64), np.full(b, np.inf), np.zeros(b, bool)
    for i in range(b):
        f = bearings[i] if mask2d is None else bearings[i][mask2d[i]]
        p = points3d[i] if mask3d is None else points3d[i][mask3d[i]]
        image, cloud = f.detach().double().cpu().numpy(), p.detach().double().cpu().numpy()
        found = is_finite(rotation[i], translation[i])
        if not bool(found.any()) or degenerate(image) or degenerate(cloud):
            continue
        scene = Scene(image, cloud, seed)
        turns, shifts = rotation[i][found].detach().double(), translation[i][found].detach().double()
        starts = scene.enter(turns.cpu().numpy(), shifts.cpu().numpy())
        crowd = len(turns)
        if crowd > FEW:
            starts = _winnowed(scene, *starts, outliers)
        few = len(starts[0])
        annealed[i] = crowd + min(few, SHAKEN) * SHAKES
        none = np.zeros((few, 3), np.float32), np.zeros(few, np.int64)
        pool = refine_batch(scene, Pool(*starts, *none), outliers) if few else Pool(*starts, *none)
        if len(pool.hits):
            pool = finish(scene, pool, outliers)
            turned, shifted = scene.leave(pool.rotation[:1], pool.translation[:1])
            out_r[i], out_t[i], scale[i], safe[i] = turned[0], shifted[0], pool.result[0, 2], is_safe(pool, scene)
    stats = SolveStats(*(torch.as_tensor(x, device=bearings.device) for x in (annealed, scale, safe)))
    return torch.as_tensor(out_r).to(points3d), torch.as_tensor(out_t).to(points3d), stats


def _winnowed(scene: Scene, rotation: Array, translation: Array, outliers: float) -> tuple[Array, Array]:
    """The starts that are likeliest when annealed on clusters, where they ended, best first."""
    outlier = scene.outlier_density(outliers)
    for count, first, last, rounds, kept in HEATS:
        ends, score = (rotation.copy(), translation.copy()), np.empty(len(rotation), np.float32)
        descend_on_clusters(scene, count, *ends, cooling(scene.spread, first, last, rounds), outlier, score)
        best = distinct(*ends, score, kept, SAME_DEG, math.inf)
        rotation, translation = ends[0][best], ends[1][best]
    return rotation, translation


class Refine(nn.Module):
    """`refine` with its options as a module."""

    def __init__(self, *, outliers: float = FINE_OUTLIERS, seed: int = 0) -> None:
        super().__init__()
        self.outliers, self.seed = outliers, seed

    def forward(
        self,
        bearings: Float[Tensor, "b m 3"],
        points3d: Float[Tensor, "b n 3"],
        rotation: Float[Tensor, "b s 3 3"],
        translation: Float[Tensor, "b s 3"],
        mask2d: Bool[Tensor, "b m"] | None = None,
        mask3d: Bool[Tensor, "b n"] | None = None,
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        return refine(
            bearings, points3d, rotation, translation, mask2d=mask2d, mask3d=mask3d, outliers=self.outliers,
            seed=self.seed,
        )  # fmt: skip
