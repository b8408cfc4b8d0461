"""RANSAC on the most probable matches: a robust initial pose from a soft assignment (paper section 3.3)."""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.checks import check_positive, check_shapes, check_within
from bpnp.layers.ransac.consensus import BACKENDS
from bpnp.layers.ransac.matches import Matches, in_scene, normalise_matches, residuals
from bpnp.layers.ransac.minimal_solvers import take
from bpnp.poses import MIN_POINTS
from bpnp.precision import full_precision
from bpnp.types import SolveStats

Backend = Literal["auto", "poselib", "opencv", "torch"]


def top_matches(
    assignment: Float[Tensor, "b m n"],
    mask2d: Bool[Tensor, "b m"] | None,
    mask3d: Bool[Tensor, "b n"] | None,
    matches_factor: float,
    min_matches: int = 1,
    max_matches: int | None = None,
) -> tuple[Int[Tensor, "b k"], Int[Tensor, "b k"], Bool[Tensor, "b k"]]:
    """Select the most probable matches of each sample: indices of 2D points and of 3D points, and which are no padding.

    A sample with m' and n' real points has floor(matches_factor * min(m', n')) matches, at least `min_matches`, at most
    `max_matches` and m' n', the most probable first. The width k of the result is the same of the padded sizes m and n,
    and at least 1. Matches of equal probability are in the order of their 2D points, then of their 3D points, so that
    the result does not depend on padding. Without a mask all points are real.
    """
    b, m, n = assignment.shape
    real2d = assignment.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = assignment.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    count2d, count3d = real2d.sum(-1), real3d.sum(-1)
    wanted = (matches_factor * torch.minimum(count2d, count3d).double()).long().clamp(min_matches, max_matches)
    count = torch.minimum(wanted, count2d * count3d)
    scores = assignment.masked_fill(~(real2d.unsqueeze(-1) & real3d.unsqueeze(-2)), -1)
    k = min(max(min_matches, int(matches_factor * min(m, n))), max_matches or m * n, m * n)
    flat = _stable_top(scores.flatten(1), k)
    return flat // n, flat % n, torch.arange(k, device=flat.device) < count.unsqueeze(-1)


def _stable_top(scores: Float[Tensor, "b s"], k: int) -> Int[Tensor, "b k"]:
    """Return the indices of the k largest scores, largest first, equal ones by index; NaN is larger than any number.

    `torch.topk` orders equal scores by chance, and a stable sort of all scores takes much longer.
    """
    scores = scores.nan_to_num(torch.inf, posinf=torch.inf, neginf=-torch.inf)
    least = scores.topk(k, dim=-1).values[:, -1:]
    above, equal = scores > least, scores == least
    room = k - above.sum(-1, keepdim=True)
    chosen = above | (equal & (equal.cumsum(-1, dtype=torch.int32) <= room))
    by_index = chosen.nonzero()[:, 1].view(-1, k)
    order = scores.gather(1, by_index).sort(dim=-1, descending=True, stable=True).indices
    return by_index.gather(1, order)


@check_shapes
@full_precision
@torch.no_grad()
def ransac_pnp(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    backend: Backend = "auto",
    matches_factor: float = 1.5,
    min_matches: int = 1,
    max_matches: int | None = None,
    threshold: float = 0.01,
    max_iterations: int = 1000,
    seed: int = 0,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """Estimate a pose from the most probable matches by RANSAC with a P3P solver.

    With m and n real points the floor(matches_factor * min(m, n)) most probable matches are used, within the limits.
    The pose has no gradient: it is the initial pose of a layer that has one.

    Args:
        assignment: P (b, m, n); only the order of its entries matters.
        points2d: Normalised image coordinates (b, m, 2).
        points3d: Scene points (b, n, 3), scene units.
        mask2d: True at real image points (b, m). Default: all are real.
        mask3d: True at real scene points (b, n). Default: all are real.
        backend: "poselib" is LO-RANSAC that samples in the order of P (PROSAC). "opencv" is the paper's P3P-RANSAC
            followed by EPnP on its inliers, or by SQPnP where EPnP loses inliers, as it may for coplanar points.
            "torch" samples in the order of P too and solves the whole batch at once on its device. "auto", the default,
            is "torch" on cuda, else "poselib".
        matches_factor: Number of matches per point of the smaller side, default 1.5.
        min_matches: Smallest number of matches, default 1; 10 in the authors' code.
        max_matches: Largest number of matches, at least `min_matches`; 1000 in the authors' code. Default: None, no
            limit.
        threshold: Largest reprojection error of an inlier, normalised units, default 0.01 (8 px at a focal length of
            800).
        max_iterations: Largest number of hypotheses, 1000 by default and in the paper.
        seed: Seed of the sampling, default 0. It is the same for each sample, so that a pose does not depend on the
            other samples.

    Returns:
        Rotation (b, 3, 3) and translation (b, 3) in the dtype of the assignment, float32 for half precision, and stats.
            `residual` (float64) is the mean reprojection error of the inliers, normalised units. `iterations` is the
            number of hypotheses, or its limit where the backend does not report it. A sample without a pose of 4 or
            more inliers has a pose of NaN, an infinite `residual`, and `converged` is False.

    Raises:
        ValueError: An argument has a wrong shape or dtype, the backend is unknown, or an option is not positive.

    >>> import torch
    >>> from bpnp.layers import ransac_pnp
    >>> points3d = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0))
    >>> camera = points3d + torch.tensor([0.0, 0.0, 4.0])
    >>> points2d = camera[..., :2] / camera[..., 2:]
    >>> rotation, translation, stats = ransac_pnp(torch.eye(50)[None], points2d, points3d, matches_factor=1.0)
    >>> torch.allclose(translation, torch.tensor([[0.0, 0.0, 4.0]]), atol=1e-3)
    True
    """
    if backend not in ("auto", *BACKENDS):
        raise ValueError(f"`backend` is {backend!r}; it is one of auto, {', '.join(BACKENDS)}")
    check_positive(matches_factor=matches_factor, threshold=threshold, max_iterations=max_iterations)
    check_within(1, math.inf, min_matches=min_matches)
    if max_matches is not None:
        check_within(min_matches, math.inf, max_matches=max_matches)
    if backend == "auto":
        backend = "torch" if assignment.device.type == "cuda" else "poselib"
    index2d, index3d, real = top_matches(assignment, mask2d, mask3d, matches_factor, min_matches, max_matches)
    matches = Matches(take(points2d, index2d).double(), take(points3d, index3d).double(), real)
    local, centre, scale = normalise_matches(matches)
    poses, iterations = BACKENDS[backend](local, threshold, max_iterations, seed)
    rotation, translation = (values.squeeze(1) for values in in_scene(poses.unsqueeze(1), centre, scale))
    # The returned pose itself is scored: a refit to the inliers of another pose may have lost them.
    poses = torch.cat([rotation, translation.unsqueeze(-1)], -1).unsqueeze(1)
    squared, inlier, *_ = (values.squeeze(1) for values in residuals(poses, matches, threshold**2))
    count = inlier.sum(-1)
    found = count >= MIN_POINTS
    error = torch.where(inlier, squared, 0).sqrt().sum(-1) / count
    stats = SolveStats(iterations, torch.where(found, error, torch.inf), found)
    rotation = torch.where(found[:, None, None], rotation, torch.nan)
    return rotation.to(assignment), torch.where(found[:, None], translation, torch.nan).to(assignment), stats


class RansacPnP(nn.Module):
    """RANSAC as a module; see `ransac_pnp`.

    Args:
        backend: "poselib" (LO-RANSAC, PROSAC order), "opencv" (the paper's P3P-RANSAC and EPnP), "torch" (the whole
            batch on its device), or "auto", the default ("torch" on cuda, else "poselib").
        matches_factor: Number of matches per point of the smaller side, default 1.5; RANSAC uses the most probable
            ones.
        min_matches: Smallest number of matches, default 1; 10 in the authors' code.
        max_matches: Largest number of matches; 1000 in the authors' code. Default: None, no limit.
        threshold: Largest reprojection error of an inlier, normalised image coordinates, default 0.01.
        max_iterations: Largest number of hypotheses, 1000 by default and in the paper.
        seed: Seed of the sampling, default 0.
    """

    def __init__(
        self,
        *,
        backend: Backend = "auto",
        matches_factor: float = 1.5,
        min_matches: int = 1,
        max_matches: int | None = None,
        threshold: float = 0.01,
        max_iterations: int = 1000,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.backend, self.matches_factor, self.threshold = backend, matches_factor, threshold
        self.min_matches, self.max_matches = min_matches, max_matches
        self.max_iterations, self.seed = max_iterations, seed

    def forward(
        self,
        assignment: Tensor,
        points2d: Tensor,
        points3d: Tensor,
        mask2d: Tensor | None = None,
        mask3d: Tensor | None = None,
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        """Return rotation (b, 3, 3), translation (b, 3) and stats; see `ransac_pnp`.

        Args:
            assignment: P (b, m, n).
            points2d: Normalised image coordinates (b, m, 2).
            points3d: Scene points (b, n, 3), scene units.
            mask2d: True at real image points (b, m). Default: all are real.
            mask3d: True at real scene points (b, n). Default: all are real.
        """
        return ransac_pnp(
            assignment,
            points2d,
            points3d,
            mask2d=mask2d,
            mask3d=mask3d,
            backend=self.backend,
            seed=self.seed,
            matches_factor=self.matches_factor,
            min_matches=self.min_matches,
            max_matches=self.max_matches,
            threshold=self.threshold,
            max_iterations=self.max_iterations,
        )
