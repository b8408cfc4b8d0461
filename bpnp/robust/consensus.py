"""Random sample consensus on candidate pairs, for a whole batch at once and with a fixed amount of work.

No shape, loop or branch depends on the data, so nothing waits for the device. The random numbers are a hash of the seed
and of the hypothesis' number: the same on every device and for every sample, so that a pose depends (up to rounding)
neither on the other samples of the batch nor on padding.
"""

from typing import NamedTuple

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import MIN_POINTS, bearings, transform
from bpnp.robust.p3p import p3p

SUBSET = 512  # heaviest pairs, on which all hypotheses are tried; with 256, poses are lost at 10 % inliers
SHORTLIST = 256  # hypotheses that are then tried on all pairs
SMALLEST_POOL = 16  # heaviest pairs, from which the first triples are drawn
FINAL_STEPS = 6


class Consensus(NamedTuple):
    """The best pose of each sample, camera = R p + t. A sample without one holds NaN, no inliers and `found` False.

    score: sum over the usable pairs of min(r^2, threshold^2), r the distance in the normalised image plane.
    """

    rotation: Float[Tensor, "b 3 3"]
    translation: Float[Tensor, "b 3"]
    inliers: Bool[Tensor, "b k"]
    score: Float[Tensor, " b"]
    found: Bool[Tensor, " b"]


class _Pairs(NamedTuple):
    """Pairs by falling weight, the unusable ones last and zero; 3D points centred and scaled to unit variance."""

    points2d: Tensor
    points3d: Tensor
    real: Tensor


def consensus(
    points2d: Float[Tensor, "b k 2"],
    points3d: Float[Tensor, "b k 3"],
    weights: Float[Tensor, "b k"],
    *,
    mask: Bool[Tensor, "b k"] | None = None,
    threshold: float = 0.01,
    hypotheses: int = 2048,
    local_best: int = 16,
    local_steps: int = 4,
    chunk: int | None = None,
    seed: int = 0,
) -> Consensus:
    """Pose of lowest truncated squared reprojection error sum_i min(r_i^2, threshold^2) over candidate pairs.

    points2d[:, i] and points3d[:, i] are pair i, for instance the top-k entries of an assignment, and `weights` their
    probabilities. A point may be in many pairs. Only the order of the weights matters: as in PROSAC (Chum, Matas, CVPR
    2005) triples come from a growing pool of the heaviest pairs; here its size grows geometrically, up to all pairs.
    Each triple is solved by `p3p`; all poses are scored (MSAC; a point behind the camera is an outlier), the best
    `local_best` improved by `local_steps` truncated Gauss-Newton steps, and the best of these refined on all pairs. A
    last fit with Cauchy's loss, its scale four times the median squared residual of the inliers (95 % efficient for
    normal noise), takes the pull from wrong pairs that happen to lie under the threshold.

    mask: False for pairs to leave out; pairs with NaN or infinity are left out too. threshold: normalised image units.
    hypotheses: number of triples. chunk: residuals computed at a time, which bounds the memory (default by device).
    Computed in float64 but for the scores. Not differentiable. A pose needs at least 4 inliers.
    Raises ValueError where the numbers of pairs differ or are zero, and for options that are not positive.
    """
    sizes = [tuple(values.shape[:2]) for values in (points2d, points3d, weights, weights if mask is None else mask)]
    _check(sizes, {"threshold": threshold, "hypotheses": hypotheses, "local_best": local_best})
    chunk = chunk or (2**18 if points2d.device.type == "cpu" else 2**26)
    bound = threshold**2
    # float32 products in bfloat16, as under autocast, would spoil the scores.
    with torch.no_grad(), torch.autocast(points2d.device.type, enabled=False):
        usable = points2d.isfinite().all(-1) & points3d.isfinite().all(-1) & weights.isfinite()
        usable = usable if mask is None else usable & mask
        order = torch.where(usable, weights, -torch.inf).argsort(dim=-1, descending=True, stable=True)
        pairs, centre, scale = _arrange(points2d, points3d, usable, order)
        subset = _Pairs(*(values[:, :SUBSET] for values in pairs))

        poses = _solve(pairs, _draw(pairs.real.sum(-1), hypotheses, seed))
        poses = _best(poses, _score(poses, subset, bound, chunk), SHORTLIST)
        poses = _best(poses, _score(poses, pairs, bound, chunk), local_best)
        poses = _refine(poses, subset, bound, local_steps)
        poses = _best(poses, _score(poses, pairs, bound, chunk), 1)
        poses = _refine(poses, pairs, bound, FINAL_STEPS)
        poses = _refine(poses, pairs, bound, FINAL_STEPS, cauchy=4 * _median(poses, pairs, bound))

        residual2, inlier, *_ = _reproject(poses, pairs, bound)
        score = torch.where(inlier, residual2, bound).mul(pairs.real.unsqueeze(1)).sum(-1).squeeze(1)
        rotation, translation = poses[:, 0, :, :3], poses[:, 0, :, 3]
        translation = scale * translation - (rotation @ centre.unsqueeze(-1)).squeeze(-1)
        found = (inlier.sum(-1).squeeze(1) >= MIN_POINTS) & translation.isfinite().all(-1)
        inliers = torch.zeros_like(usable).scatter(1, order, inlier.squeeze(1)) & found.unsqueeze(-1)
        rotation = torch.where(found[:, None, None], rotation, torch.nan).to(points3d.dtype)
        translation = torch.where(found[:, None], translation, torch.nan).to(points3d.dtype)
        score = torch.where(found, score, torch.inf).to(points3d.dtype)
    return Consensus(rotation, translation, inliers, score, found)


def _check(sizes: list[tuple[int, ...]], positive: dict[str, int | float]) -> None:
    if len(set(sizes)) > 1 or sizes[0][1] == 0:
        names = "`points2d`, `points3d`, `weights` and `mask`"
        raise ValueError(f"expected {names} of the same batch size and number of pairs, at least one, got {sizes}")
    for name, value in positive.items():
        if not value > 0:
            raise ValueError(f"expected a positive `{name}`, got {value}")


def _take(values: Tensor, index: Tensor) -> Tensor:
    """values[b, index[b, i], ...]."""
    trailing = values.shape[2:]
    return values.gather(1, index.view(*index.shape, *(1 for _ in trailing)).expand(*index.shape, *trailing))


def _best(poses: Tensor, score: Tensor, size: int) -> Tensor:
    """The poses of lowest score; NaN, that of a slot without a pose, counts as the highest."""
    return _take(poses, score.topk(min(size, score.shape[1]), largest=False).indices)


def _arrange(points2d: Tensor, points3d: Tensor, usable: Tensor, order: Tensor) -> tuple[_Pairs, Tensor, Tensor]:
    """The pairs in order, and the centre (b, 3) and scale (b, 1) with p = scale * p_arranged + centre."""
    real = usable.gather(1, order)
    world = torch.where(real.unsqueeze(-1), _take(points3d, order), 0).double()
    count = real.sum(-1, keepdim=True).clamp(min=1)
    centre = world.sum(1) / count
    world = torch.where(real.unsqueeze(-1), world - centre.unsqueeze(1), 0)
    scale = (world.square().sum((1, 2)).unsqueeze(-1) / count).sqrt()
    image = torch.where(real.unsqueeze(-1), _take(points2d, order), 0).double()
    return _Pairs(image, world / scale.unsqueeze(-1), real), centre, scale


def _draw(count: Tensor, hypotheses: int, seed: int) -> Tensor:
    """Three different places (b, hypotheses, 3) below the pool size, which grows from SMALLEST_POOL to count (b,)."""
    progress = (torch.arange(hypotheses, device=count.device, dtype=torch.float64) + 0.5) / hypotheses
    whole = count.clamp(min=3).unsqueeze(-1).double()
    start = whole.clamp(max=SMALLEST_POOL)
    pool = (start * (whole / start) ** progress).ceil()
    uniform = _uniform(3 * hypotheses, seed, count.device).view(3, hypotheses)
    first, second, third = ((uniform[i] * (pool - i)).long() for i in range(3))
    # A draw from pool - i places skips the i places already taken.
    second = second + (second >= first)
    third = third + (third >= torch.minimum(first, second))
    third = third + (third >= torch.maximum(first, second))
    return torch.stack([first, second, third], -1)


def _uniform(size: int, seed: int, device: torch.device) -> Tensor:
    """float64 in (0, 1): a 32-bit integer hash (two multiplications and shifts) of the counter and the seed."""
    state = torch.arange(size, device=device)
    for salt in (0, (seed * 0x9E3779B1 + 1) & 0xFFFFFFFF):
        state = (state + salt) & 0xFFFFFFFF
        for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
            state = ((state ^ (state >> shift)) * factor) & 0xFFFFFFFF
        state = state ^ (state >> 15)
    return (state + 0.5) / 2.0**32


def _solve(pairs: _Pairs, triples: Tensor) -> Tensor:
    """Poses [R | t] (b, slots, 3, 4) of all triples, NaN in empty slots.

    P3P fills fewer than two of its four slots on average, so the solutions are moved to the front of half of them.
    """
    hypotheses = triples.shape[1]
    triples = triples.clamp(max=pairs.real.shape[1] - 1).flatten(1)
    rays = bearings(_take(pairs.points2d, triples)).unflatten(1, (hypotheses, 3))
    solution = p3p(rays, _take(pairs.points3d, triples).unflatten(1, (hypotheses, 3)))
    poses = torch.cat([solution.rotation, solution.translation.unsqueeze(-1)], -1).flatten(1, 2)
    filled = solution.valid.flatten(1).byte().argsort(dim=1, descending=True, stable=True)
    return _take(poses, filled[:, : 2 * hypotheses + 2])


def _score(poses: Tensor, pairs: _Pairs, bound: float, chunk: int) -> Tensor:
    """Truncated squared error (b, c) of poses (b, c, 3, 4), in float32, in parts of `chunk` residuals."""
    x, y = pairs.points2d.float().unsqueeze(1).unbind(-1)
    world = torch.cat([pairs.points3d.float(), torch.ones_like(x).mT], -1).mT
    real = pairs.real.unsqueeze(1).float()
    # x' - x = (row_0 - x row_2) [p; 1] / depth: one product for the numerator, and the depth only squared.
    along_x, along_y = torch.cat([world, -x * world], 1), torch.cat([world, -y * world], 1)
    scores = []
    for part in poses.float().split(max(1, chunk // max(1, x.shape[0] * x.shape[2])), dim=1):
        row0, row1, row2 = part.unbind(2)
        residual2 = (torch.cat([row0, row2], -1) @ along_x).square_()
        residual2 += (torch.cat([row1, row2], -1) @ along_y).square_()
        depth = (row2 @ world).clamp_(min=1e-12)  # behind the camera: an infinite residual
        residual2.div_(depth.square_()).clamp_(max=bound)
        scores.append((residual2 @ real.mT).squeeze(-1))
    return torch.cat(scores, 1)


def _reproject(poses: Tensor, pairs: _Pairs, bound: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared residual and inlier flag (b, c, k), residual (b, c, k, 2) and camera points (b, c, k, 3)."""
    points3d = pairs.points3d.unsqueeze(1).expand(-1, poses.shape[1], -1, -1)
    camera = transform(poses[..., :3], poses[..., 3], points3d)
    residual = camera[..., :2] / camera[..., 2:] - pairs.points2d.unsqueeze(1)
    residual2 = residual.square().sum(-1)
    inlier = (residual2 < bound) & (camera[..., 2] > 0) & pairs.real.unsqueeze(1)
    return residual2, inlier, residual, camera


def _median(poses: Tensor, pairs: _Pairs, bound: float) -> Tensor:
    """Median squared residual of the inliers (b, c, 1); infinite without any."""
    residual2, inlier, *_ = _reproject(poses, pairs, bound)
    ascending = torch.where(inlier, residual2, torch.inf).sort(-1).values
    return ascending.gather(-1, inlier.sum(-1, keepdim=True) // 2)


def _refine(poses: Tensor, pairs: _Pairs, bound: float, steps: int, *, cauchy: Tensor | None = None) -> Tensor:
    """Gauss-Newton on min(r^2, bound), or on its Cauchy loss s log(1 + min(r^2, bound)/s) with scale s (b, c, 1).

    Every pose for itself; returns the best one met on the way.
    """
    scale = None if cauchy is None else cauchy.clamp(min=1e-24)
    best = poses
    lowest = torch.full(poses.shape[:2], torch.inf, dtype=poses.dtype, device=poses.device)
    damping = 1e-9 * torch.eye(6, dtype=poses.dtype, device=poses.device)
    for _ in range(steps + 1):
        residual2, inlier, residual, camera = _reproject(poses, pairs, bound)
        loss, weight = torch.where(inlier, residual2, bound), inlier.to(residual2.dtype)
        if scale is not None:
            loss, weight = scale * (loss / scale).log1p(), weight / (1 + loss / scale)
        score = loss.mul(pairs.real.unsqueeze(1)).sum(-1)
        better = score < lowest
        best, lowest = torch.where(better[..., None, None], poses, best), torch.where(better, score, lowest)
        jacobian, residual = _jacobian(camera, inlier), torch.where(inlier.unsqueeze(-1), residual, 0)
        weighted = jacobian * weight.repeat(1, 1, 2).unsqueeze(-2)
        hessian = weighted @ jacobian.mT
        gradient = weighted @ residual.mT.flatten(-2).unsqueeze(-1)
        hessian = hessian + damping * (1e-9 + hessian.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None])
        step = -torch.cholesky_solve(gradient, torch.linalg.cholesky_ex(hessian).L)
        poses = roma.rotvec_to_rotmat(step[..., :3, 0]) @ poses
        poses = torch.cat([poses[..., :3], poses[..., 3:] + step[..., 3:, :]], -1)
    return best


def _jacobian(camera: Tensor, inlier: Tensor) -> Tensor:
    """Derivatives (b, c, 6, 2k) of x/z, then of y/z, by (w, s) in y -> y + w x y + s; any finite value for outliers."""
    x, y, z = camera.unbind(-1)
    inverse = torch.where(inlier, 1 / z, 0)
    u, v = torch.where(inlier, x * inverse, 0), torch.where(inlier, y * inverse, 0)
    zero = torch.zeros_like(u)
    along_x = torch.stack([-u * v, 1 + u * u, -v, inverse, zero, -u * inverse], -2)
    along_y = torch.stack([-1 - v * v, u * v, u, zero, inverse, -v * inverse], -2)
    return torch.cat([along_x, along_y], -1)
