"""Mixture models of the two point sets: von Mises-Fisher on the sphere of rays, Gaussians in the scene."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import angle_between

ITERATIONS = 300


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
        nearest, assigned = _distances(points, centres, spherical).min(-1)
        if bool((assigned == labels).all()):
            outermost = int(nearest.argmax())
            if float(nearest[outermost]) <= limit:
                break
            assigned[outermost] = len(centres)
        labels = assigned.unique(return_inverse=True)[1]
        weights, sums = _totals(points, labels)
        centres = _centre(sums, weights.unsqueeze(-1), spherical)
    return labels


def _distances(points: Tensor, centres: Tensor, spherical: bool) -> Tensor:
    if spherical:
        return angle_between(points.unsqueeze(1), centres.unsqueeze(0))
    return torch.cdist(points, centres)


def _centre(sums: Tensor, weights: Tensor | int, spherical: bool) -> Tensor:
    return torch.nn.functional.normalize(sums, dim=-1) if spherical else sums / weights


def _totals(values: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Number and sum of the values of each label."""
    members = torch.nn.functional.one_hot(labels).to(values.dtype)
    return members.sum(0), members.mT @ values
