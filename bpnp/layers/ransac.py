"""RANSAC on the most probable matches: a robust first pose from a soft assignment (paper section 3.3)."""

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.checks import check_positive, check_shapes
from bpnp.poses import MIN_POINTS
from bpnp.precision import full_precision
from bpnp.robust.matches import Matches, in_scene, normalised, residuals
from bpnp.robust.minimal_solvers import take
from bpnp.robust.ransac import BACKENDS
from bpnp.types import SolveStats

Backend = Literal["auto", "poselib", "opencv", "torch"]


def top_matches(
    assignment: Float[Tensor, "b m n"],
    mask2d: Bool[Tensor, "b m"] | None,
    mask3d: Bool[Tensor, "b n"] | None,
    matches_factor: float,
) -> tuple[Int[Tensor, "b k"], Int[Tensor, "b k"], Bool[Tensor, "b k"]]:
    """The k = matches_factor * min(m, n) matches of highest probability, most probable first: indices of their 2D and
    3D points, and which of them there are; m and n count a sample's real points."""
    b, m, n = assignment.shape
    real2d = assignment.new_ones(b, m, dtype=torch.bool) if mask2d is None else mask2d
    real3d = assignment.new_ones(b, n, dtype=torch.bool) if mask3d is None else mask3d
    count2d, count3d = real2d.sum(-1), real3d.sum(-1)
    count = torch.minimum((matches_factor * torch.minimum(count2d, count3d)).long(), count2d * count3d)
    scores = assignment.masked_fill(~(real2d.unsqueeze(-1) & real3d.unsqueeze(-2)), -1)
    k = min(max(1, int(matches_factor * min(m, n))), m * n)
    flat = scores.flatten(1).topk(k, dim=-1).indices
    return flat // n, flat % n, torch.arange(k, device=flat.device) < count.unsqueeze(-1)


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
    threshold: float = 0.01,
    max_iterations: int = 1000,
    seed: int = 0,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """Pose from the k = matches_factor * min(m, n) most probable matches by RANSAC with a P3P solver.

    assignment: P; only the order of its entries matters. points2d: normalised image coordinates. points3d: scene units.
    backend: "poselib", LO-RANSAC that samples in the order of P (PROSAC); "opencv", P3P-RANSAC with 1000 iterations,
        then EPnP on its inliers, the paper's, or SQPnP where EPnP loses inliers, as it may on points of one plane;
        "torch", a whole batch at once on its device, in the order of P too; "auto", torch on cuda, else poselib.
    threshold: largest reprojection error of an inlier, normalised units (0.01 is 8 px at a focal length of 800).
    seed: of the sampling, the same for each sample, so that a pose does not depend on the other samples.

    Returns rotation, translation and stats (residual: mean reprojection error of the inliers; iterations: hypotheses,
    or the bound on them where the backend does not tell). A sample for which no pose has 4 inliers holds NaN and
    `converged` False. No gradient: the pose is the initial pose of a solver that has one.
    Raises ValueError for arguments of wrong shape or type, an unknown backend and options that are not positive.

    >>> points3d = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0))
    >>> camera = points3d + torch.tensor([0.0, 0.0, 4.0])
    >>> points2d = camera[..., :2] / camera[..., 2:]
    >>> rotation, translation, stats = ransac_pnp(torch.eye(50)[None], points2d, points3d, matches_factor=1.0)
    >>> torch.allclose(translation, torch.tensor([[0.0, 0.0, 4.0]]), atol=1e-3)
    True
    """
    if backend not in ("auto", *BACKENDS):
        raise ValueError(f"expected `backend` auto, poselib, opencv or torch, got {backend!r}")
    check_positive(matches_factor=matches_factor, threshold=threshold, max_iterations=max_iterations)
    if backend == "auto":
        backend = "torch" if assignment.device.type == "cuda" else "poselib"
    index2d, index3d, real = top_matches(assignment, mask2d, mask3d, matches_factor)
    matches = Matches(take(points2d, index2d).double(), take(points3d, index3d).double(), real)
    local, centre, scale = normalised(matches)
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
    """`ransac_pnp` with its options as a module.

    Args:
        backend: poselib (LO-RANSAC, PROSAC order), opencv (the paper's P3P-RANSAC and EPnP), torch (the whole batch on
            its device), or auto (torch on cuda, else poselib).
        matches_factor: RANSAC sees the matches_factor * min(m, n) most probable matches.
        threshold: inlier threshold, normalised image coordinates.
        max_iterations: most hypotheses; the paper has 1000.
        seed: of the sampling.
    """

    def __init__(
        self,
        *,
        backend: Backend = "auto",
        matches_factor: float = 1.5,
        threshold: float = 0.01,
        max_iterations: int = 1000,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.backend, self.matches_factor, self.threshold = backend, matches_factor, threshold
        self.max_iterations, self.seed = max_iterations, seed

    def forward(
        self,
        assignment: Tensor,
        points2d: Tensor,
        points3d: Tensor,
        mask2d: Tensor | None = None,
        mask3d: Tensor | None = None,
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        return ransac_pnp(
            assignment,
            points2d,
            points3d,
            mask2d=mask2d,
            mask3d=mask3d,
            backend=self.backend,
            seed=self.seed,
            matches_factor=self.matches_factor,
            threshold=self.threshold,
            max_iterations=self.max_iterations,
        )
