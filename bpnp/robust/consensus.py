"""Random sample consensus on candidate pairs, for a whole batch at once and with a fixed amount of work.

No shape, loop or branch depends on the data, so nothing waits for the device.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.checks import check_positive, checked_shapes
from bpnp.geometry import MIN_POINTS, bearings
from bpnp.precision import full_precision
from bpnp.robust.local_refinement import refine_locally
from bpnp.robust.p3p import poses_of_triples
from bpnp.robust.sampling import distinct_triples, growing_pool, take
from bpnp.robust.scoring import Pairs, in_scene, normalised, residuals, truncated_scores

SUBSET = 512  # pairs of largest weight, on which all hypotheses are scored; with 256, poses are lost at 10 % inliers
SHORTLIST = 256  # hypotheses that are then scored on all pairs
REFINED = 16  # hypotheses that are refined locally on the subset
LOCAL_STEPS, FINAL_STEPS = 4, 6  # Gauss-Newton steps of these, and of the best one on all pairs


class Consensus(NamedTuple):
    """The best pose of each sample, camera = R p + t. A sample without one holds NaN, no inliers and `found` False.

    score: sum over the usable pairs of min(r^2, threshold^2), r the distance in the normalised image plane.
    """

    rotation: Float[Tensor, "b 3 3"]
    translation: Float[Tensor, "b 3"]
    inliers: Bool[Tensor, "b k"]
    score: Float[Tensor, " b"]
    found: Bool[Tensor, " b"]


@checked_shapes
@full_precision
@torch.no_grad()
def consensus(
    points2d: Float[Tensor, "b k 2"],
    points3d: Float[Tensor, "b k 3"],
    weights: Float[Tensor, "b k"],
    *,
    mask: Bool[Tensor, "b k"] | None = None,
    threshold: float = 0.01,
    hypotheses: int = 2048,
    seed: int = 0,
) -> Consensus:
    """Pose of lowest truncated squared reprojection error sum_i min(r_i^2, threshold^2) over candidate pairs.

    points2d[:, i] and points3d[:, i] are pair i, for instance the top-k entries of an assignment, and `weights` their
    probabilities. A point may be in many pairs. Only the order of the weights matters: triples come from a pool of the
    pairs of largest weight that grows to all pairs (PROSAC; Chum, Matas, CVPR 2005), `p3p` solves each, all poses are
    scored (MSAC; a point behind the camera is an outlier), and the best are refined. A last fit uses Cauchy's loss with
    a scale of four times the median squared residual of the inliers (95 % efficient for normal noise), which reduces
    the influence of wrong pairs below the threshold.

    mask: False for pairs to leave out; pairs with NaN or infinity are left out too. threshold: normalised image units.
    hypotheses: number of triples. Computed in float64 but for the scores. Not differentiable. A pose needs at least 4
    inliers. Raises ValueError for arguments of wrong shape or type and options that are not positive.

    >>> points3d = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0))
    >>> camera = points3d + torch.tensor([0.0, 0.0, 4.0])
    >>> found = consensus(camera[..., :2] / camera[..., 2:], points3d, torch.ones(1, 50))
    >>> torch.allclose(found.translation, torch.tensor([[0.0, 0.0, 4.0]]), atol=1e-3)
    True
    """
    check_positive(threshold=threshold, hypotheses=hypotheses)
    usable = points2d.isfinite().all(-1) & points3d.isfinite().all(-1) & weights.isfinite()
    usable = usable if mask is None else usable & mask
    order = torch.where(usable, weights, -torch.inf).argsort(dim=-1, descending=True, stable=True)
    pairs, centre, scale = normalised(Pairs(*(take(values, order) for values in (points2d, points3d, usable))))
    pose = _best_pose(pairs, threshold**2, hypotheses, seed)

    squared, inlier, *_ = (values.squeeze(1) for values in residuals(pose, pairs, threshold**2))
    score = torch.where(inlier, squared, threshold**2).mul(pairs.real).sum(-1)
    rotation, translation = (values.squeeze(1) for values in in_scene(pose, centre, scale))
    found = (inlier.sum(-1) >= MIN_POINTS) & translation.isfinite().all(-1)
    return Consensus(
        torch.where(found[:, None, None], rotation, torch.nan).to(points3d.dtype),
        torch.where(found[:, None], translation, torch.nan).to(points3d.dtype),
        torch.zeros_like(usable).scatter(1, order, inlier) & found.unsqueeze(-1),
        torch.where(found, score, torch.inf).to(points3d.dtype),
        found,
    )


def _best_pose(pairs: Pairs, threshold2: float, hypotheses: int, seed: int) -> Float[Tensor, "b 1 3 4"]:
    """Draw, solve, score, refine; the pairs are normalised and in order of weight, those that are not real last."""
    subset = Pairs(*(values[:, :SUBSET] for values in pairs))
    triples = distinct_triples(growing_pool(pairs.real.sum(-1), hypotheses), seed)
    triples = triples.clamp(max=pairs.real.shape[1] - 1).flatten(1)  # fewer than three pairs: repeated ones, no pose
    rays, scene = (take(v, triples).unflatten(1, (hypotheses, 3)) for v in (bearings(pairs.points2d), pairs.points3d))
    poses = poses_of_triples(rays, scene)
    poses = _best(poses, truncated_scores(poses, subset, threshold2), SHORTLIST)
    poses = _best(poses, truncated_scores(poses, pairs, threshold2), REFINED)
    poses = refine_locally(poses, subset, threshold2, LOCAL_STEPS)
    pose = _best(poses, truncated_scores(poses, pairs, threshold2), 1)
    pose = refine_locally(pose, pairs, threshold2, FINAL_STEPS)
    squared, inlier, *_ = residuals(pose, pairs, threshold2)
    median = torch.where(inlier, squared, torch.nan).nanmedian(-1).values.nan_to_num(threshold2)
    return refine_locally(pose, pairs, threshold2, FINAL_STEPS, cauchy=4 * median)


def _best(poses: Float[Tensor, "b c 3 4"], score: Float[Tensor, "b c"], size: int) -> Float[Tensor, "b s 3 4"]:
    """The poses of lowest score; NaN, that of a slot without a pose, counts as the highest."""
    return take(poses, score.topk(min(size, score.shape[1]), largest=False).indices)
