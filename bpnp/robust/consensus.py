"""Random sample consensus on candidate matches for a whole batch at once: sampling, scoring and local refinement.

The random numbers are a hash of a seed and a counter, the same on every device and for every sample of a batch, so that
a pose depends neither on the other samples nor on padding. No shape depends on the data: the minimal problems alone are
solved on the CPU, of all samples at once.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.geometry import bearings, retract, transform
from bpnp.robust.minimal_solvers import poses_of_triples, take

SMALLEST_POOL = 16  # matches of largest weight, from which the first triples of a growing pool are drawn


def growing_pool(count: Int[Tensor, " b"], draws: int) -> Float[Tensor, "b d"]:
    """Size of the pool of each draw: it grows geometrically from SMALLEST_POOL to `count`.

    The order of growth is that of PROSAC (Chum, Matas, CVPR 2005): matches of large weight are tried first.
    """
    progress = (torch.arange(draws, device=count.device, dtype=torch.float64) + 0.5) / draws
    last = count.clamp(min=3).unsqueeze(-1).double()
    first = last.clamp(max=SMALLEST_POOL)
    return (first * (last / first) ** progress).ceil()


def distinct_triples(pool: Float[Tensor, "b d"], seed: int, *, skip: int = 0) -> Int[Tensor, "b d 3"]:
    """Three different indices below the pool size of each draw, uniform and in random order.

    skip: draws of earlier calls with this seed; their random numbers are not used again.
    """
    draws = pool.shape[1]
    uniform = hashed_uniform(3 * draws, seed, pool.device, skip=3 * skip).view(3, draws)
    first, second, third = ((uniform[i] * (pool - i)).long() for i in range(3))
    # A draw from pool - i numbers skips the i numbers already taken.
    second = second + (second >= first)
    third = third + (third >= torch.minimum(first, second))
    third = third + (third >= torch.maximum(first, second))
    return torch.stack([first, second, third], -1)


def weighted_draws(weights: Float[Tensor, "b k"], count: int, seed: int) -> Int[Tensor, "b c"]:
    """Indices drawn with replacement in proportion to the weights, which are not negative and not all zero."""
    total = weights.double().cumsum(-1)
    uniform = hashed_uniform(count, seed, weights.device)
    # The first sum above the number drawn: never an index of weight zero.
    return torch.searchsorted(total, uniform * total[:, -1:], right=True).clamp(max=weights.shape[1] - 1)


def hashed_uniform(size: int, seed: int, device: torch.device, *, skip: int = 0) -> Float[Tensor, " k"]:
    """float64 in (0, 1): a 32-bit integer hash (two multiplications and shifts) of the counter and the seed."""
    state = torch.arange(skip, skip + size, device=device)
    for salt in (0, (seed * 0x9E3779B1 + 1) & 0xFFFFFFFF):
        state = (state + salt) & 0xFFFFFFFF
        for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
            state = ((state ^ (state >> shift)) * factor) & 0xFFFFFFFF
        state = state ^ (state >> 15)
    return (state + 0.5) / 2.0**32


CHUNK = 2**18  # residuals scored at a time: 1 MiB in float32, which stays in the cache of a core


class Matches(NamedTuple):
    """Candidate matches of a 2D and a 3D point; `real` is False for padding, whose points are zero."""

    points2d: Float[Tensor, "b k 2"]
    points3d: Float[Tensor, "b k 3"]
    real: Bool[Tensor, "b k"]


class Residuals(NamedTuple):
    """Of c poses on k matches. inlier: real, in front of the camera, and with an error below the threshold."""

    squared: Float[Tensor, "b c k"]
    inlier: Bool[Tensor, "b c k"]
    residual: Float[Tensor, "b c k 2"]
    camera: Float[Tensor, "b c k 3"]


def normalised(matches: Matches) -> tuple[Matches, Float[Tensor, "b 3"], Float[Tensor, "b 1"]]:
    """The matches in float64 with 3D points q, centred and of unit variance; centre and scale in p = scale q + centre.

    A scene far from its origin then loses no digits in the minimal solver. Points with NaN or infinity are not real.
    """
    usable = matches.real & matches.points2d.isfinite().all(-1) & matches.points3d.isfinite().all(-1)
    real = usable.unsqueeze(-1)
    image, scene = (torch.where(real, points, 0).double() for points in matches[:2])
    count = usable.sum(-1, keepdim=True).clamp(min=1)
    centre = scene.sum(1) / count
    scene = torch.where(real, scene - centre.unsqueeze(1), 0)
    scale = (scene.square().sum((1, 2)).unsqueeze(-1) / count).sqrt().clamp(min=1e-300)
    return Matches(image, scene / scale.unsqueeze(-1), usable), centre, scale


def in_scene(
    poses: Float[Tensor, "b c 3 4"], centre: Float[Tensor, "b 3"], scale: Float[Tensor, "b 1"]
) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """Rotation and translation, in the scene's own coordinates, of poses that were found on normalised matches."""
    rotation = poses[..., :3]
    return rotation, scale.unsqueeze(1) * poses[..., 3] - (rotation @ centre[:, None, :, None]).squeeze(-1)


def truncated_scores(
    poses: Float[Tensor, "b c 3 4"], matches: Matches, threshold2: float | Float[Tensor, "b 1 1"]
) -> Float[Tensor, "b c"]:
    """sum_i min(r_i^2, threshold2) over the real matches, r_i the reprojection error, infinite behind the camera.

    Computed in float32. NaN for a pose that is NaN.
    """
    x, y = matches.points2d.float().unsqueeze(1).unbind(-1)
    scene = torch.cat([matches.points3d.float(), torch.ones_like(x).mT], -1).mT
    real = matches.real.unsqueeze(1).float()
    # x' - x = (row_0 - x row_2) [p; 1] / depth: one product for the numerator, and the depth is only squared.
    along_x, along_y = torch.cat([scene, -x * scene], 1), torch.cat([scene, -y * scene], 1)
    scores = []
    for part in poses.float().split(max(1, CHUNK // (x.shape[0] * x.shape[2])), dim=1):
        row0, row1, row2 = part.unbind(2)
        squared = (torch.cat([row0, row2], -1) @ along_x).square_()
        squared += (torch.cat([row1, row2], -1) @ along_y).square_()
        depth = (row2 @ scene).clamp_(min=1e-12)  # behind the camera: an infinite residual
        squared.div_(depth.square_()).clamp_(max=threshold2)
        scores.append((squared @ real.mT).squeeze(-1))
    return torch.cat(scores, 1)


def residuals(poses: Float[Tensor, "b c 3 4"], matches: Matches, threshold2: float) -> Residuals:
    """Reprojection error of every match under every pose, in the type of the points."""
    points3d = matches.points3d.unsqueeze(1).expand(-1, poses.shape[1], -1, -1)
    camera = transform(poses[..., :3], poses[..., 3], points3d)
    residual = camera[..., :2] / camera[..., 2:] - matches.points2d.unsqueeze(1)
    squared = residual.square().sum(-1)
    inlier = (squared < threshold2) & (camera[..., 2] > 0) & matches.real.unsqueeze(1)
    return Residuals(squared, inlier, residual, camera)


SUBSET = 512  # matches of largest weight, on which all hypotheses are scored; with 256, poses are lost at 10 % inliers
SHORTLIST = 256  # hypotheses that are then scored on all matches
REFINED = 16  # hypotheses that are refined locally on the subset
LOCAL_STEPS, FINAL_STEPS = 4, 6  # Gauss-Newton steps of these, and of the best one on all matches
DAMPING = 1e-9  # share of the Hessian's mean diagonal


def consensus(
    matches: Matches, threshold: float, hypotheses: int, seed: int
) -> tuple[Float[Tensor, "b 3 4"], Int[Tensor, " b"]]:
    """Pose [R | t] of lowest truncated squared reprojection error sum_i min(r_i^2, threshold^2), and `hypotheses`.

    matches: as `bpnp.robust.consensus.normalised` gives them, most probable first. A point may be in many matches.
    hypotheses: triples for each sample. They come from a pool of the most probable matches that grows to all matches
    (PROSAC; Chum, Matas, CVPR 2005), `p3p` solves each, all poses are scored (MSAC; a point behind the camera is an
    outlier), and the best are refined. A last fit uses Cauchy's loss with a scale of four times the median squared
    residual of the inliers (95 % efficient for normal noise), which reduces the influence of wrong matches below the
    threshold. Computed in float64 but for the scores. A sample without a pose may hold any, or NaN.
    """
    threshold2 = threshold**2
    subset = Matches(*(values[:, :SUBSET] for values in matches))
    triples = distinct_triples(growing_pool(matches.real.sum(-1), hypotheses), seed)
    # Fewer than three matches: repeated ones, no pose.
    triples = triples.clamp(max=matches.real.shape[1] - 1).flatten(1)
    rays, scene = (
        take(v, triples).unflatten(1, (hypotheses, 3)) for v in (bearings(matches.points2d), matches.points3d)
    )
    poses = poses_of_triples(rays, scene)
    poses = _best(poses, truncated_scores(poses, subset, threshold2), SHORTLIST)
    poses = _best(poses, truncated_scores(poses, matches, threshold2), REFINED)
    poses = refine_locally(poses, subset, threshold2, LOCAL_STEPS)
    pose = _best(poses, truncated_scores(poses, matches, threshold2), 1)
    pose = refine_locally(pose, matches, threshold2, FINAL_STEPS)
    squared, inlier, *_ = residuals(pose, matches, threshold2)
    median = torch.where(inlier, squared, torch.nan).nanmedian(-1).values.nan_to_num(threshold2)
    pose = refine_locally(pose, matches, threshold2, FINAL_STEPS, cauchy=4 * median)
    return pose.squeeze(1), matches.real.sum(-1).fill_(hypotheses)


def _best(poses: Float[Tensor, "b c 3 4"], score: Float[Tensor, "b c"], size: int) -> Float[Tensor, "b s 3 4"]:
    """The poses of lowest score; NaN, that of a slot without a pose, counts as the highest."""
    return take(poses, score.topk(min(size, score.shape[1]), largest=False).indices)


def refine_locally(
    poses: Float[Tensor, "b c 3 4"],
    matches: Matches,
    threshold2: float,
    steps: int,
    *,
    cauchy: Float[Tensor, "b c"] | None = None,
) -> Float[Tensor, "b c 3 4"]:
    """Reduce sum_i min(r_i^2, threshold2), or with Cauchy's loss sum_i min(s log(1 + r_i^2 / s), s log(1 + t / s)).

    Each step is a Gauss-Newton step on the inliers of the current pose, weighted by the derivative of the loss in r^2.
    Poses are refined independently, and the best one met on the way is returned, the initial pose included.

    threshold2: squared reprojection error t of an inlier. cauchy: scale s, squared residual units; None for r^2.
    """
    scale = None if cauchy is None else cauchy.clamp(min=1e-24).unsqueeze(-1)
    best = poses
    lowest = torch.full(poses.shape[:2], torch.inf, dtype=poses.dtype, device=poses.device)
    damping = DAMPING * torch.eye(6, dtype=poses.dtype, device=poses.device)
    for _ in range(steps + 1):
        squared, inlier, residual, camera = residuals(poses, matches, threshold2)
        loss, weight = torch.where(inlier, squared, threshold2), inlier.to(squared.dtype)
        if scale is not None:
            loss, weight = scale * (loss / scale).log1p(), weight / (1 + loss / scale)
        score = loss.mul(matches.real.unsqueeze(1)).sum(-1)
        better = score < lowest
        best, lowest = torch.where(better[..., None, None], poses, best), torch.where(better, score, lowest)
        jacobian = _jacobian(camera, camera - poses[..., None, :, 3], inlier)
        residual = torch.where(inlier.unsqueeze(-1), residual, 0)
        weighted = jacobian * weight.repeat(1, 1, 2).unsqueeze(-2)
        hessian = weighted @ jacobian.mT
        gradient = weighted @ residual.mT.flatten(-2).unsqueeze(-1)
        hessian = hessian + damping * (1e-9 + hessian.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None])
        step = -torch.cholesky_solve(gradient, torch.linalg.cholesky_ex(hessian).L).squeeze(-1)
        rotation, translation = retract(step, poses[..., :3], poses[..., 3])
        poses = torch.cat([rotation, translation.unsqueeze(-1)], -1)
    return best


def _jacobian(
    camera: Float[Tensor, "b c k 3"], turned: Float[Tensor, "b c k 3"], inlier: Bool[Tensor, "b c k"]
) -> Float[Tensor, "b c 6 2*k"]:
    """Derivatives of x/z, then of y/z, by the step (w, s) of `retract`; zero for outliers.

    camera: y = R p + t, which a step moves by w x R p + s. turned: R p.
    """
    inverse = torch.where(inlier, 1 / camera[..., 2], 0)
    u, v = camera[..., 0] * inverse, camera[..., 1] * inverse
    a, b, c = (turned * inverse.unsqueeze(-1)).unbind(-1)
    zero = torch.zeros_like(u)
    along_x = torch.stack([-u * b, c + u * a, -b, inverse, zero, -u * inverse], -2)
    along_y = torch.stack([-c - v * b, v * a, a, zero, inverse, -v * inverse], -2)
    return torch.cat([along_x, along_y], -1)
