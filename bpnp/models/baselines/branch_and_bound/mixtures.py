"""Mixtures of both point sets, the L2 distance of the scene's, seen from a camera, to the image's, and its bounds.

From the camera centre c a Gaussian (mu, s^2) is seen as a von Mises-Fisher density of direction mu - c and of
concentration |mu - c|^2/s^2 + 1 (GOSMA: Campbell et al., CVPR 2019). The product of two densities has the integral
E = Z(|k m + k' m'|) / (Z(k) Z(k')), Z(k) = 4 pi sinh(k)/k, so that the distance is closed:
d(R, c) = sum_ab w_a w_b E_ab(c) - 2 sum_ac w_a w_c E_ac(R, c) + sum_cc' w_c w_c' E_cc'.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import angle_between
from bpnp.models.baselines.branch_and_bound.boxes import (
    Boxes,
    distance_range,
    rotation_uncertainty,
    translation_uncertainty,
)

ITERATIONS = 300  # of Lloyd's
BISECTIONS = 16
ROUNDING = 1e-9  # relative; of a bound's terms


class RayMixture(NamedTuple):
    """von Mises-Fisher components on the unit sphere."""

    weights: Float[Tensor, " c"]
    directions: Float[Tensor, "c 3"]
    concentrations: Float[Tensor, " c"]


class SceneMixture(NamedTuple):
    """Isotropic Gaussian components."""

    weights: Float[Tensor, " a"]
    means: Float[Tensor, "a 3"]
    variances: Float[Tensor, " a"]


def ray_mixture(rays: Float[Tensor, "m 3"], angle: float) -> RayMixture:
    """DP-vMF-means: clusters within `angle` (radians) of their mean direction, and the vMF that fits each.

    The concentration is r (3 - r^2)/(1 - r^2) of the mean resultant length r, and at most that of a cluster with a
    standard deviation of a tenth of the angle, which single points would exceed.
    """
    labels = _means(rays, angle, spherical=True)
    weights, sums = _totals(rays, labels)
    length = torch.linalg.vector_norm(sums, dim=-1) / weights
    concentration = length * (3 - length.square()) / (1 - length.square()).clamp_min(1e-12)
    directions = torch.nn.functional.normalize(sums, dim=-1)
    return RayMixture(weights / len(rays), directions, concentration.clamp_max((10 / angle) ** 2))


def scene_mixture(points: Float[Tensor, "n 3"], radius: float) -> SceneMixture:
    """DP-means: clusters within `radius` of their mean, and the isotropic Gaussian of each, no narrower than a tenth
    of the radius."""
    labels = _means(points, radius, spherical=False)
    weights, sums = _totals(points, labels)
    means = sums / weights.unsqueeze(-1)
    squared = (points - means[labels]).square().sum(-1, keepdim=True)
    variances = _totals(squared, labels)[1].squeeze(-1) / (3 * weights)
    return SceneMixture(weights / len(points), means, variances.clamp_min((radius / 10) ** 2))


def _means(points: Tensor, limit: float, *, spherical: bool) -> Int[Tensor, " k"]:
    """DP-means: Lloyd's iterations; when they have converged, a new cluster at the point farthest from all centres, if
    that is beyond `limit`.

    The result does not depend on the order of the points.
    """
    centres = _centre(points.sum(0, keepdim=True), len(points), spherical)
    labels = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for _ in range(ITERATIONS):
        away = angle_between(points.unsqueeze(1), centres) if spherical else torch.cdist(points, centres)
        nearest, assigned = away.min(-1)
        if bool((assigned == labels).all()):
            outermost = int(nearest.argmax())
            if float(nearest[outermost]) <= limit:
                break
            assigned[outermost] = len(centres)
        labels = assigned.unique(return_inverse=True)[1]
        weights, sums = _totals(points, labels)
        centres = _centre(sums, weights.unsqueeze(-1), spherical)
    return labels


def _centre(sums: Tensor, weights: Tensor | int, spherical: bool) -> Tensor:
    return torch.nn.functional.normalize(sums, dim=-1) if spherical else sums / weights


def _totals(values: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Number and sum of the values of each label."""
    members = torch.nn.functional.one_hot(labels).to(values.dtype)
    return members.sum(0), members.mT @ values


def log_z(k: Tensor) -> Tensor:
    """log of 4 pi sinh(k)/k, k >= 0."""
    k = k.clamp_min(1e-9)
    return k + torch.log(-torch.expm1(-2 * k)) - torch.log(2 * k) + math.log(4 * math.pi)


def overlap(k: Tensor, other: Tensor, cosine: Tensor) -> Tensor:
    """E of two von Mises-Fisher densities whose directions enclose an angle of this cosine."""
    together = (k.square() + other.square() + 2 * k * other * cosine).clamp_min(0).sqrt()
    return torch.exp(log_z(together) - log_z(k) - log_z(other))


def squared_norm(rays: RayMixture) -> Float[Tensor, ""]:
    """Integral of the squared density of the image's mixture."""
    terms = overlap(rays.concentrations.unsqueeze(-1), rays.concentrations, rays.directions @ rays.directions.mT)
    return rays.weights @ terms @ rays.weights


def distance(
    scene: SceneMixture, rays: RayMixture, rotation: Float[Tensor, "b 3 3"], place: Float[Tensor, "b 3"]
) -> Float[Tensor, " b"]:
    """d(R, c) without the constant `squared_norm(rays)`."""
    directions, k = _seen(scene, place)
    self_terms = overlap(k.unsqueeze(-1), k.unsqueeze(-2), directions @ directions.mT)
    cross_terms = overlap(k.unsqueeze(-1), rays.concentrations, directions @ rotation.mT @ rays.directions.mT)
    return _combine(scene, rays, self_terms, cross_terms)


def lower_bound(scene: SceneMixture, rays: RayMixture, boxes: Boxes) -> Float[Tensor, " b"]:
    """A number that d(R, c) does not fall below for any pose of a box.

    Every term takes its best value on its own: angles within the box's uncertainty of those at its centre, and
    concentrations between those at the least and the largest distance.
    """
    directions, _ = _seen(scene, boxes.place)
    turning, moving = rotation_uncertainty(boxes), translation_uncertainty(boxes, scene.means)
    closest, farthest = distance_range(boxes, scene.means)
    least, largest = (values.square() / scene.variances + 1 for values in (closest, farthest))

    apart = _angle(directions @ directions.mT)
    wide = (apart + _parting(scene, boxes, closest, moving)).clamp_max(math.pi)
    wide = wide * (1 - torch.eye(len(scene.means), dtype=wide.dtype, device=wide.device))
    self_terms = _least_overlap(least, largest, wide.cos())
    angle = _angle(directions @ boxes.rotation.mT @ rays.directions.mT)
    narrow = (angle - turning[:, None, None] - moving.unsqueeze(-1)).clamp_min(0)
    cross_terms = _largest_overlap(least.unsqueeze(-1), largest.unsqueeze(-1), rays.concentrations, narrow.cos())
    return _combine(scene, rays, self_terms * (1 - ROUNDING), cross_terms * (1 + ROUNDING))


def _seen(scene: SceneMixture, place: Tensor) -> tuple[Tensor, Tensor]:
    towards = scene.means - place.unsqueeze(1)
    return torch.nn.functional.normalize(towards, dim=-1), towards.square().sum(-1) / scene.variances + 1


def _parting(scene: SceneMixture, boxes: Boxes, closest: Tensor, moving: Tensor) -> Tensor:
    """How much the angle that two means subtend at the camera centre can grow within a box (b, a, a).

    Each direction turns by its own uncertainty at most. The angle's gradient has the length |mu - mu'| / (d d') with
    the distances d, d' of the means: moving the centre by half a diagonal adds at most that times the largest length.
    """
    half_diagonal = boxes.place_half.norm(dim=-1)[:, None, None]
    gradient = torch.cdist(scene.means, scene.means) / (closest.unsqueeze(-1) * closest.unsqueeze(-2)).clamp_min(1e-12)
    return torch.minimum(moving.unsqueeze(-1) + moving.unsqueeze(-2), half_diagonal * gradient + 1e-7)


def _combine(scene: SceneMixture, rays: RayMixture, self_terms: Tensor, cross_terms: Tensor) -> Tensor:
    return (self_terms @ scene.weights) @ scene.weights - 2 * (cross_terms @ rays.weights) @ scene.weights


def _angle(cosine: Tensor) -> Tensor:
    return torch.acos(cosine.clamp(-1, 1))


def _least_overlap(least: Tensor, largest: Tensor, cosine: Tensor) -> Tensor:
    """Smallest E over both concentrations: E has one maximum in each of them, so its minimum is at an end."""
    ends = [
        overlap(a.unsqueeze(-1), b.unsqueeze(-2), cosine) for a, b in
        ((least, least), (least, largest), (largest, least), (largest, largest))
    ]  # fmt: skip
    smallest = torch.stack(ends).amin(0)
    # A component with itself: one concentration, not two.
    own = overlap(least, least, torch.ones_like(least))
    same = torch.eye(least.shape[-1], dtype=torch.bool, device=least.device)
    return torch.where(same, own.unsqueeze(-1), smallest)


def _largest_overlap(least: Tensor, largest: Tensor, fixed: Tensor, cosine: Tensor) -> Tensor:
    """Largest E over the first concentration, where its only maximum is found by bisection of the slope's sign."""
    low, high, fixed, cosine = torch.broadcast_tensors(least, largest, fixed, cosine)
    rises_to_end, falls_from_start = _rises(high, fixed, cosine), ~_rises(low, fixed, cosine)
    inside = ~(rises_to_end | falls_from_start)
    best = torch.where(rises_to_end, high, low).clone()
    if bool(inside.any()):
        a, b, k, c = (values[inside] for values in (low, high, fixed, cosine))
        for _ in range(BISECTIONS):
            middle = (a + b) / 2
            up = _rises(middle, k, c)
            a, b = torch.where(up, middle, a), torch.where(up, b, middle)
        best[inside] = (a + b) / 2
    return overlap(best, fixed, cosine)


def _rises(k: Tensor, fixed: Tensor, cosine: Tensor) -> Tensor:
    """Whether E grows with k: A(|k m + k' m'|) cos(m, k m + k' m') > A(k) with A(k) = coth k - 1/k."""
    together = (k.square() + fixed.square() + 2 * k * fixed * cosine).clamp_min(1e-18).sqrt()
    return _mean_length(together) * (k + fixed * cosine) > _mean_length(k) * together


def _mean_length(k: Tensor) -> Tensor:
    return torch.where(k < 1e-3, k / 3, 1 / torch.tanh(k.clamp_min(1e-3)) - 1 / k.clamp_min(1e-3))
