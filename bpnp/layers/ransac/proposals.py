"""Poses proposed by a soft assignment: P3P on triples of matches drawn in proportion to their probability.

Some of these poses are near the true one even if few of the most probable matches are true.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import bearings
from bpnp.layers.ransac.matches import Matches, in_scene, normalise_matches, truncated_scores, weighted_draws
from bpnp.layers.ransac.minimal_solvers import poses_of_triples, take
from bpnp.poses import distinct
from bpnp.precision import full_precision

SOLVED_TRIPLES = 1024  # number of triples of an assignment that are solved, for each sample of a batch [triples; cost]
DRAWN_EACH = 4  # number of triples drawn for each that is solved; the widest triangles are solved [triples; not tuned]
SCORED_MATCHES = 512  # number of matches drawn to score the proposals [matches; cost]
APART_DEG = 15.0  # smallest angle between two proposals [degrees; not tuned]
# Residual that counts half, in root mean square distances of the image points from their mean.
HALF_RESIDUAL = 0.2  # [fraction; not tuned]


@full_precision
@torch.no_grad()
def pose_hypotheses(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    mask2d: Bool[Tensor, "b m"],
    mask3d: Bool[Tensor, "b n"],
    *,
    count: int,
) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
    """Propose the best poses of triples of matches drawn in proportion to P, any two of them 15 degrees apart.

    P is non-negative, of any sum; image points are normalised. Poses come best first, NaN in empty slots. A sample has
    no pose if P has no mass or is not finite, or with fewer than 3 points on a side.

    Triples with the largest products of their triangles' areas on both sides are solved (`p3p`): a small triangle
    magnifies the errors of its matches. A pose scores sum_k min(r_k^2, t^2) over other matches k drawn from P. r_k is
    the reprojection error, infinite behind the camera, and t = `HALF_RESIDUAL`. This estimates the expectation under P.

    The draws are the same for each sample: a result depends neither on the other samples nor on padding.
    """
    n = assignment.shape[2]
    probability = assignment.masked_fill(~(mask2d.unsqueeze(-1) & mask3d.unsqueeze(-2)), 0).flatten(1)
    mass = probability.sum(-1, dtype=torch.float64)
    usable = mass.isfinite() & (mass > 0) & (torch.minimum(mask2d.sum(-1), mask3d.sum(-1)) >= 3)

    draws = SCORED_MATCHES + 3 * DRAWN_EACH * SOLVED_TRIPLES
    drawn = weighted_draws(torch.where(usable.unsqueeze(-1), probability, 1), draws, 0)
    chosen = Matches(take(points2d, drawn // n), take(points3d, drawn % n), usable.unsqueeze(-1).expand_as(drawn))
    matches, centre, scale = normalise_matches(chosen)
    poses = _poses_of_widest(*(points[:, SCORED_MATCHES:].unflatten(1, (-1, 3)) for points in matches[:2]))
    sample = Matches(*(values[:, :SCORED_MATCHES] for values in matches))
    size = mask2d.sum(-1, keepdim=True).clamp(min=1)
    mean = torch.where(mask2d.unsqueeze(-1), points2d, 0).sum(1) / size
    spread = torch.where(mask2d, (points2d - mean.unsqueeze(1)).square().sum(-1), 0).sum(-1) / size.squeeze(-1)
    threshold2 = HALF_RESIDUAL**2 * spread
    score = truncated_scores(poses, sample, threshold2.float()[:, None, None])

    best = poses.new_full((len(poses), count, 3, 4), torch.nan)
    for i in usable.nonzero().flatten().tolist():
        r, t, value = (
            x.float().cpu().numpy() for x in (poses[i, ..., :3], poses[i, ..., 3], -score[i] / SCORED_MATCHES)
        )
        index = torch.as_tensor(distinct(r, t, value, count, APART_DEG, math.inf), device=poses.device)
        best[i, : len(index)] = poses[i, index]
    rotation, translation = in_scene(best, centre, scale)
    return rotation.to(points3d), translation.to(points3d)


@full_precision
@torch.no_grad()
def drawn_poses(
    assignment: Float[Tensor, "b m n"],
    points2d: Float[Tensor, "b m 2"],
    points3d: Float[Tensor, "b n 3"],
    *,
    triples: int,
    seed: int,
    aligned: bool = False,
) -> Float[Tensor, "b s 3 4"]:
    """Return all poses [R | t] of the widest quarter of match triples drawn in proportion to P, NaN in empty slots.

    P is non-negative, with mass; image points are normalised, and there is no padding. With `aligned`, for axes of the
    scene that are about those of the camera, an eighth of the triples is solved, from the wider half. They have the
    largest cosine between the edges of the image triangle and those of the scene triangle seen along the third axis.
    """
    drawn = weighted_draws(assignment.flatten(1), 3 * triples, seed)
    n = assignment.shape[2]
    chosen = Matches(take(points2d, drawn // n), take(points3d, drawn % n), torch.ones_like(drawn, dtype=torch.bool))
    matches, centre, scale = normalise_matches(chosen)
    poses = _poses_of_widest(*(points.unflatten(1, (-1, 3)) for points in matches[:2]), aligned=aligned)
    rotation, translation = in_scene(poses, centre, scale)
    return torch.cat([rotation, translation.unsqueeze(-1)], -1)


def _poses_of_widest(
    image: Float[Tensor, "b k 3 2"], scene: Float[Tensor, "b k 3 3"], *, aligned: bool = False
) -> Float[Tensor, "b s 3 4"]:
    """Return the poses of the quarter of the triples with the largest area products; `aligned` as in `drawn_poses`."""
    (x, y), (along, across) = ((points[:, :, 1:] - points[:, :, :1]).unbind(2) for points in (image, scene))
    area2d = (x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]).abs()
    area3d = torch.linalg.cross(along, across).norm(dim=-1)
    wide = area2d * area3d
    if aligned:
        seen = torch.cat([along, across], -1)[..., [0, 1, 3, 4]]
        alike = torch.cosine_similarity(torch.cat([x, y], -1), seen, dim=-1)
        alike = alike.masked_fill(wide < wide.median(-1, keepdim=True).values, -1)
        chosen = alike.topk(image.shape[1] // (2 * DRAWN_EACH)).indices
    else:
        chosen = wide.topk(image.shape[1] // DRAWN_EACH).indices
    return poses_of_triples(bearings(take(image, chosen)), take(scene, chosen))
