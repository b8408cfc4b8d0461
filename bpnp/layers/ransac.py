"""RANSAC on the most probable pairs: a robust first pose from a soft assignment (paper section 3.3)."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import cv2
import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.types import SolveStats

Backend = Literal["poselib", "opencv"]
MIN_INLIERS = 4  # three points fit up to four poses exactly


class PairList(NamedTuple):
    """The most probable pairs of each sample, most probable first."""

    index2d: Int[Tensor, "b k"]
    index3d: Int[Tensor, "b k"]
    probability: Float[Tensor, "b k"]
    mask: Bool[Tensor, "b k"]


class _Found(NamedTuple):
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    iterations: int


_Estimator = Callable[[NDArray[np.float64], NDArray[np.float64], float, int, int], _Found | None]


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
    scores = assignment.detach().masked_fill(~(real2d.unsqueeze(-1) & real3d.unsqueeze(-2)), -1)
    k = min(int(pairs_factor * min(m, n)), m * n)
    probability, flat = scores.flatten(1).topk(k, dim=-1)
    mask = torch.arange(k, device=flat.device) < count.unsqueeze(-1)
    return PairList(flat // n, flat % n, probability, mask)


def ransac_pnp(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    backend: Backend = "poselib",
    pairs_factor: float = 1.5,
    threshold: float = 0.01,
    max_iterations: int = 10_000,
    seed: int = 0,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """Pose from the k = pairs_factor * min(m, n) most probable pairs by RANSAC with a P3P solver.

    assignment: P; its order alone matters. points2d: normalised image coordinates. points3d: scene units.
    backend: "poselib", LO-RANSAC that samples in the order of P (PROSAC); "opencv", P3P-RANSAC, then EPnP on its
        inliers: the paper's, with 1000 iterations.
    threshold: largest reprojection error of an inlier, normalised units (0.01 is 8 px at a focal length of 800).
    seed: of the sampling, the same for each sample, so that a pose does not depend on the other samples.

    Returns rotation, translation and stats (residual: mean reprojection error of the inliers; iterations: hypotheses,
    or the bound on them where the backend does not tell). A sample for which no pose has 4 inliers holds NaN and
    `converged` False. No gradient: the pose only starts a solver that has one.
    Raises ValueError for an unknown backend.
    """
    if backend not in _ESTIMATORS:
        raise ValueError(f"expected `backend` one of {sorted(_ESTIMATORS)}, got {backend!r}")
    estimate = _ESTIMATORS[backend]
    pairs = top_pairs(assignment, mask2d=mask2d, mask3d=mask3d, pairs_factor=pairs_factor)
    image = _gather(points2d, pairs.index2d)
    scene = _gather(points3d, pairs.index3d)
    b = len(assignment)
    rotation, translation = np.full((b, 3, 3), np.nan), np.full((b, 3), np.nan)
    iterations, residual, found = np.zeros(b, int), np.full(b, np.inf), np.zeros(b, bool)
    for i, count in enumerate(pairs.mask.sum(-1).tolist()):
        x, p = image[i, :count], scene[i, :count]
        # Around the origin, so that a scene far from it loses no digits in the minimal solver.
        centre = p.mean(0) if count else np.zeros(3)
        result = estimate(x, p - centre, threshold, max_iterations, seed) if count >= MIN_INLIERS else None
        if result is None:
            continue
        error = _residual(result, x, p - centre)
        if error is None:
            continue
        rotation[i], translation[i] = result.rotation, result.translation - result.rotation @ centre
        iterations[i], residual[i], found[i] = result.iterations, error, True
    stats = SolveStats(
        torch.as_tensor(iterations, device=assignment.device),
        torch.as_tensor(residual).to(assignment),
        torch.as_tensor(found, device=assignment.device),
    )
    return torch.as_tensor(rotation).to(assignment), torch.as_tensor(translation).to(assignment), stats


def _gather(points: Tensor, index: Tensor) -> NDArray[np.float64]:
    picked = points.detach().gather(1, index.unsqueeze(-1).expand(-1, -1, points.shape[-1]))
    return picked.double().cpu().numpy()


def _residual(found: _Found, points2d: NDArray[np.float64], points3d: NDArray[np.float64]) -> float | None:
    """Mean reprojection error of the inliers; None if the pose is not finite or too few inliers lie in front."""
    if not (np.isfinite(found.rotation).all() and np.isfinite(found.translation).all()):
        return None
    y = points3d[found.inliers] @ found.rotation.T + found.translation
    front = y[:, 2] > 0
    if front.sum() < MIN_INLIERS:
        return None
    error = y[front, :2] / y[front, 2:] - points2d[found.inliers][front]
    return float(np.linalg.norm(error, axis=-1).mean())


def _poselib(
    points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float, max_iterations: int, seed: int
) -> _Found | None:
    options = {
        "max_reproj_error": threshold,
        "max_iterations": max_iterations,
        "min_iterations": min(1000, max_iterations),
        "progressive_sampling": True,
        "seed": seed,
    }
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [1.0, 0.0, 0.0]}
    pose, info = poselib.estimate_absolute_pose(points2d, points3d, camera, options, {})
    return _Found(pose.R, pose.t, np.asarray(info["inliers"], bool), int(info["iterations"]))


def _opencv(
    points2d: NDArray[np.float64], points3d: NDArray[np.float64], threshold: float, max_iterations: int, seed: int
) -> _Found | None:
    del seed  # OpenCV's generator starts afresh at each call
    try:
        ok, rotvec, translation, inliers = cv2.solvePnPRansac(
            points3d,
            points2d,
            np.eye(3),
            None,
            iterationsCount=max_iterations,
            reprojectionError=threshold,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not ok or inliers is None or len(inliers) < MIN_INLIERS:
            return None
        chosen = inliers.ravel()
        _, rotvec, translation = cv2.solvePnP(
            points3d[chosen], points2d[chosen], np.eye(3), None, flags=cv2.SOLVEPNP_EPNP
        )
    except cv2.error:  # degenerate inliers: OpenCV has no pose to offer
        return None
    mask = np.zeros(len(points2d), bool)
    mask[chosen] = True
    rotation = np.asarray(cv2.Rodrigues(rotvec)[0], float)
    return _Found(rotation, np.asarray(translation, float).ravel(), mask, max_iterations)


_ESTIMATORS: dict[str, _Estimator] = {"poselib": _poselib, "opencv": _opencv}


class RansacPnP(nn.Module):
    """`ransac_pnp` with its options as a module."""

    def __init__(
        self,
        *,
        backend: Backend = "poselib",
        pairs_factor: float = 1.5,
        threshold: float = 0.01,
        max_iterations: int = 10_000,
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
