"""Many poses from one soft assignment: minimal samples of its pairs, for a search that needs no assignment to judge.

An assignment that places each point to within a tenth of the others has few true pairs among its most probable ones,
and a consensus on these is often wrong. Among poses of triples drawn from it some are near the truth all the same.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bpnp.distinct_poses import distinct
from bpnp.geometry import bearings, transform
from bpnp.precision import full_precision
from bpnp.robust.p3p import p3p
from bpnp.types import SolveStats

DRAWN = 4  # triples drawn for each that is solved: those of the widest triangles
SCORED = 512  # pairs drawn to score the poses on
MINIMUM_PAIRS = 3


@full_precision
def pose_hypotheses(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    *,
    count: int,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    triples: int = 1024,
    threshold: float = 0.2,
    apart_deg: float = 15.0,
    seed: int = 0,
) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"], SolveStats]:
    """The `count` best poses, any two of them `apart_deg` apart, of triples of pairs drawn in proportion to P.

    Of the triples drawn those with the largest products of their triangles' areas on both sides are solved (`p3p`):
    a small triangle turns the errors of its pairs into large ones of the pose. A pose scores
    sum_k min(r_k^2, threshold^2) over other pairs k drawn from P, r_k the reprojection error and infinite behind the
    camera, which estimates the expectation under P.

    assignment: P, non-negative, of any sum. points2d: normalised image coordinates. points3d: scene units.
    count: s, slots of the result. triples: solved for each sample. seed: of the draws, the same for each sample.
    threshold: in root mean square distances of the sample's image points from their mean.

    Returns rotation, translation, best first, NaN in empty slots, and stats (iterations: triples solved; residual:
    root mean truncated square of the best pose, normalised units; converged: there is a pose). A sample whose P has no
    mass or is not finite, or with fewer than 3 points of a side, has none. Not differentiable. A sample's result
    depends neither on the other samples nor on padding.
    Raises ValueError for options out of range.
    """
    b = len(assignment)
    for name, value in {"count": count, "triples": triples, "threshold": threshold}.items():
        if not value > 0:
            raise ValueError(f"expected a positive `{name}`, got {value}")
    if not 0 <= apart_deg < 180:
        raise ValueError(f"expected `apart_deg` in [0, 180), got {apart_deg}")
    rotation, translation = points3d.new_full((b, count, 3, 3), torch.nan), points3d.new_full((b, count, 3), torch.nan)
    solved = torch.zeros(b, dtype=torch.long, device=assignment.device)
    residual = points3d.new_full((b,), torch.inf)
    for i in range(b):
        real2d = slice(None) if mask2d is None else mask2d[i]
        real3d = slice(None) if mask3d is None else mask3d[i]
        probability = assignment[i].detach()[real2d][:, real3d]
        image, scene = points2d[i].detach()[real2d].double(), points3d[i].detach()[real3d].double()
        total = probability.double().sum()
        if min(probability.shape) < MINIMUM_PAIRS or not (total.isfinite() and total > 0):
            continue
        # Around the origin and of unit extent: a scene far from it loses no digits in the minimal solver.
        centre = scene.mean(0)
        size = (scene - centre).square().sum(-1).mean().sqrt().clamp(min=1e-30)
        bound = (threshold * (image - image.mean(0)).square().sum(-1).mean().sqrt()) ** 2
        index2d, index3d = _draw(probability, 3 * DRAWN * triples + SCORED, seed)
        pairs2d, pairs3d = image[index2d], ((scene - centre) / size)[index3d]
        turns, shifts = _poses(pairs2d[SCORED:].unflatten(0, (-1, 3)), pairs3d[SCORED:].unflatten(0, (-1, 3)), triples)
        cost = _cost(turns, shifts, pairs2d[:SCORED], pairs3d[:SCORED], bound)
        turned, shifted, score = (x.cpu().numpy().astype(np.float32) for x in (turns, shifts, -cost))
        best = torch.as_tensor(distinct(turned, shifted, score, count, apart_deg, math.inf), device=cost.device)
        solved[i] = triples
        if len(best):
            rotation[i, : len(best)] = turns[best].to(rotation)
            moved = size * shifts[best] - turns[best] @ centre
            translation[i, : len(best)] = moved.to(translation)
            residual[i] = cost[best[0]].sqrt().to(residual)
    return rotation, translation, SolveStats(solved, residual, residual.isfinite())


def _draw(probability: Float[Tensor, "m n"], count: int, seed: int) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Pairs, each in proportion to its probability."""
    total = probability.double().flatten().cumsum(0)
    uniform = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(total.device)
    # The first sum above the number drawn: never a pair of probability zero.
    flat = torch.searchsorted(total, uniform * total[-1], right=True).clamp(max=len(total) - 1)
    return flat // probability.shape[1], flat % probability.shape[1]


def _poses(
    image: Float[Tensor, "k 3 2"], scene: Float[Tensor, "k 3 3"], triples: int
) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"]]:
    """Every pose of the `triples` widest triples."""
    (x, y), (along, across) = (image[:, 1:] - image[:, :1]).unbind(1), (scene[:, 1:] - scene[:, :1]).unbind(1)
    area2d = (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).abs()
    area3d = torch.linalg.cross(along, across).norm(dim=-1)
    widest = (area2d * area3d).topk(triples).indices
    found = p3p(bearings(image[widest]), scene[widest])
    return found.rotation[found.valid], found.translation[found.valid]


def _cost(
    rotation: Float[Tensor, "s 3 3"],
    translation: Float[Tensor, "s 3"],
    image: Float[Tensor, "k 2"],
    scene: Float[Tensor, "k 3"],
    bound: Float[Tensor, ""],
) -> Float[Tensor, " s"]:
    """Mean truncated squared reprojection error of each pose, in float32."""
    camera = transform(rotation.float(), translation.float(), scene.float().expand(len(rotation), -1, -1))
    depth = camera[..., 2]
    squared = (camera[..., :2] / depth.unsqueeze(-1) - image.float()).square().sum(-1)
    return torch.where(depth > 0, squared, torch.inf).clamp(max=bound.float()).mean(-1)
