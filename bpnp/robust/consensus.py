"""Random sample consensus on candidate pairs, for a whole batch at once and with a fixed amount of work.

No shape, loop or branch depends on the data, so nothing waits for the device.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import bearings
from bpnp.robust.local_refinement import refine_locally
from bpnp.robust.p3p import poses_of_triples
from bpnp.robust.sampling import distinct_triples, growing_pool, take
from bpnp.robust.scoring import Pairs, residuals, truncated_scores

SUBSET = 512  # pairs of largest weight, on which all hypotheses are scored; with 256, poses are lost at 10 % inliers
SHORTLIST = 256  # hypotheses that are then scored on all pairs
REFINED = 16  # hypotheses that are refined locally on the subset
LOCAL_STEPS, FINAL_STEPS = 4, 6  # Gauss-Newton steps of these, and of the best one on all pairs


def consensus(
    pairs: Pairs, threshold: float, hypotheses: int, seed: int
) -> tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]:
    """Pose [R | t] of lowest truncated squared reprojection error sum_i min(r_i^2, threshold^2), and `hypotheses`.

    pairs: as `bpnp.robust.scoring.normalised` gives them, most probable first. A point may be in many pairs.
    hypotheses: triples for each sample. They come from a pool of the most probable pairs that grows to all pairs
    (PROSAC; Chum, Matas, CVPR 2005), `p3p` solves each, all poses are scored (MSAC; a point behind the camera is an
    outlier), and the best are refined. A last fit uses Cauchy's loss with a scale of four times the median squared
    residual of the inliers (95 % efficient for normal noise), which reduces the influence of wrong pairs below the
    threshold. Computed in float64 but for the scores. A sample without a pose may hold any, or NaN.
    """
    threshold2 = threshold**2
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
    pose = refine_locally(pose, pairs, threshold2, FINAL_STEPS, cauchy=4 * median)
    return pose.squeeze(1), pairs.real.sum(-1).fill_(hypotheses)


def _best(poses: Float[Tensor, "b c 3 4"], score: Float[Tensor, "b c"], size: int) -> Float[Tensor, "b s 3 4"]:
    """The poses of lowest score; NaN, that of a slot without a pose, counts as the highest."""
    return take(poses, score.topk(min(size, score.shape[1]), largest=False).indices)
