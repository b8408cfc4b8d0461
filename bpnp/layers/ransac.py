"""RANSAC on the most probable pairs: a robust first pose from a soft assignment (paper section 3.3)."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.geometry import MIN_POINTS
from bpnp.precision import full_precision
from bpnp.robust.backends import Estimator, mean_residual, opencv_ransac, poselib_ransac
from bpnp.robust.consensus import consensus
from bpnp.types import SolveStats

Backend = Literal["auto", "poselib", "opencv", "torch"]
ESTIMATORS: dict[str, Estimator] = {"poselib": poselib_ransac, "opencv": opencv_ransac}


class PairList(NamedTuple):
    """The most probable pairs of each sample, most probable first."""

    index2d: Int[Tensor, "b k"]
    index3d: Int[Tensor, "b k"]
    probability: Float[Tensor, "b k"]
    mask: Bool[Tensor, "b k"]


def top_pairs(
    assignment: Float[Tensor, "b m n"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    pairs_factor: float = 1.5,
) -> PairList:
    """The k = pairs_factor * min(m, n) pairs of highest probability, m and n counting a sample's real points."""
    b, m, n = assignment.shape
    real2d = assignment.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = assignment.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    count2d, count3d = real2d.sum(-1), real3d.sum(-1)
    count = torch.minimum((pairs_factor * torch.minimum(count2d, count3d)).long(), count2d * count3d)
    scores = assignment.detach()
    if mask2d is not None or mask3d is not None:
        scores = scores.masked_fill(~(real2d.unsqueeze(-1) & real3d.unsqueeze(-2)), -1)
    k = min(int(pairs_factor * min(m, n)), m * n)
    probability, flat = scores.flatten(1).topk(k, dim=-1)
    mask = torch.arange(k, device=flat.device) < count.unsqueeze(-1)
    return PairList(flat // n, flat % n, probability, mask)


@full_precision
def ransac_pnp(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    backend: Backend = "auto",
    pairs_factor: float = 1.5,
    threshold: float = 0.01,
    max_iterations: int = 1000,
    seed: int = 0,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """Pose from the k = pairs_factor * min(m, n) most probable pairs by RANSAC with a P3P solver.

    assignment: P; its order alone matters. points2d: normalised image coordinates. points3d: scene units.
    backend: "poselib", LO-RANSAC that samples in the order of P (PROSAC); "opencv", P3P-RANSAC, then EPnP on its
        inliers: the paper's, with 1000 iterations. Where EPnP loses inliers of the pose that it refits, as it may on
        points of one plane, SQPnP does it.
    threshold: largest reprojection error of an inlier, normalised units (0.01 is 8 px at a focal length of 800).
    seed: of the sampling, the same for each sample, so that a pose does not depend on the other samples.

    Returns rotation, translation and stats (residual: mean reprojection error of the inliers, root mean square for
    "torch"; iterations: hypotheses, or the bound on them where the backend does not tell, 0 without 4 pairs). A sample
    for which no pose has 4 inliers holds NaN and `converged` False. No gradient: the pose only starts a solver that has
    one.
    Raises ValueError for an unknown backend.
    """
    if backend not in ("auto", "torch", *ESTIMATORS):
        raise ValueError(f"expected `backend` auto, poselib, opencv or torch, got {backend!r}")
    if backend == "auto":
        backend = "torch" if assignment.device.type == "cuda" else "poselib"
    pairs = top_pairs(assignment, mask2d=mask2d, mask3d=mask3d, pairs_factor=pairs_factor)
    image, scene = _pick(points2d, pairs.index2d), _pick(points3d, pairs.index3d)
    if backend == "torch":
        rotation, translation, stats = _together(image, scene, pairs, threshold, max_iterations, seed)
    else:
        rotation, translation, stats = _one_by_one(
            ESTIMATORS[backend], image, scene, pairs, threshold, max_iterations, seed
        )
    return rotation.to(assignment), translation.to(assignment), stats


def _pick(points: Float[Tensor, "b m d"], index: Int[Tensor, "b k"]) -> Float[Tensor, "b k d"]:
    return points.detach().gather(1, index.unsqueeze(-1).expand(-1, -1, points.shape[-1])).double()


def _together(
    image: Tensor, scene: Tensor, pairs: PairList, threshold: float, hypotheses: int, seed: int
) -> tuple[Tensor, Tensor, SolveStats]:
    """All samples at once on their device, a fixed amount of work. Probability zero is a pair like any other."""
    weights = pairs.probability.double().clamp_min(torch.finfo(torch.float64).tiny)
    rotation, translation, inliers, score, found = consensus(
        image, scene, weights, mask=pairs.mask, threshold=threshold, hypotheses=hypotheses, seed=seed
    )
    outliers = pairs.mask.sum(-1) - inliers.sum(-1)
    # The score is the truncated sum of squares: what is left of it are the inliers'.
    squared = (score - outliers * threshold**2).clamp_min(0) / inliers.sum(-1).clamp_min(1)
    residual = torch.where(found, squared.sqrt(), torch.inf)
    return rotation, translation, SolveStats(torch.full_like(outliers, hypotheses), residual, found)


def _one_by_one(
    estimate: Estimator, image: Tensor, scene: Tensor, pairs: PairList, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor, SolveStats]:
    b = len(image)
    rotation, translation = np.full((b, 3, 3), np.nan), np.full((b, 3), np.nan)
    taken, residual, found = np.zeros(b, int), np.full(b, np.inf), np.zeros(b, bool)
    for i, count in enumerate(pairs.mask.sum(-1).tolist()):
        if count < MIN_POINTS:
            continue
        x, p = image[i, :count].cpu().numpy(), scene[i, :count].cpu().numpy()
        # Around the origin, so that a scene far from it loses no digits in the minimal solver.
        centre = p.mean(0)
        result = estimate(x, p - centre, threshold, iterations, seed)
        taken[i] = iterations if result is None else result.iterations
        error = None if result is None else mean_residual(result, x, p - centre, threshold)
        if result is None or error is None:
            continue
        rotation[i], translation[i] = result.rotation, result.translation - result.rotation @ centre
        residual[i], found[i] = error, True
    device = image.device
    stats = SolveStats(*(torch.as_tensor(x, device=device) for x in (taken, residual, found)))
    return torch.as_tensor(rotation, device=device), torch.as_tensor(translation, device=device), stats


class RansacPnP(nn.Module):
    """`ransac_pnp` with its options as a module."""

    def __init__(
        self,
        *,
        backend: Backend = "auto",
        pairs_factor: float = 1.5,
        threshold: float = 0.01,
        max_iterations: int = 1000,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.backend = backend
        self.pairs_factor = pairs_factor
        self.threshold = threshold
        self.max_iterations = max_iterations
        self.seed = seed

    def forward(
        self,
        assignment: Float[Tensor, "b m n"],
        points2d: Float[Tensor, "b m 2"],
        points3d: Float[Tensor, "b n 3"],
        mask2d: Bool[Tensor, "b m"] | None = None,
        mask3d: Bool[Tensor, "b n"] | None = None,
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        return ransac_pnp(
            assignment,
            points2d,
            points3d,
            mask2d=mask2d,
            mask3d=mask3d,
            backend=self.backend,
            pairs_factor=self.pairs_factor,
            threshold=self.threshold,
            max_iterations=self.max_iterations,
            seed=self.seed,
        )
