"""GOSMA: globally optimal alignment of two mixtures on the sphere, by branch and bound (Campbell et al., CVPR 2019).

From the camera centre c, a Gaussian (mu, s^2) appears as a von Mises-Fisher density of direction mu - c and
concentration |mu - c|^2/s^2 + 1. The product of two densities has the integral E = Z(|k m + k' m'|) / (Z(k) Z(k')),
Z(k) = 4 pi sinh(k)/k. The L2 distance between the scene's mixture, seen from a camera, and the image's is therefore
d(R, c) = sum_ab w_a w_b E_ab(c) - 2 sum_ac w_a w_c E_ac(R, c) + sum_cc' w_c w_c' E_cc'.
"""

import math
from typing import NamedTuple

import roma
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from bpnp.checks import check_positive
from bpnp.geometry import angle_between, retract
from bpnp.models.baselines.branch_and_bound import (
    BestPose,
    Boxes,
    BranchAndBound,
    best_first,
    distance_range,
    root_mean_square,
    rotation_uncertainty,
    split,
    translation_uncertainty,
)
from bpnp.runtime import NEVER, Deadline

CLOSEST = 0.5  # least distance of a camera centre from the scene's centre, weak-perspective distances
GAP = 0.1  # distance from the optimum that is allowed, as a fraction of the image mixture's squared norm
POLISH_STEPS = 50
DESCENTS = 32  # best box centres of an iteration, from which Adam descends
DESCENT_STEPS = 30
ITERATIONS = 300  # largest number of Lloyd iterations
BISECTIONS = 16
ROUNDING = 1e-9  # relative rounding error of the terms of a bound


class RayMixture(NamedTuple):
    """Mixture of von Mises-Fisher components on the unit sphere."""

    weights: Float[Tensor, " c"]
    directions: Float[Tensor, "c 3"]
    concentrations: Float[Tensor, " c"]


class SceneMixture(NamedTuple):
    """Mixture of isotropic Gaussian components."""

    weights: Float[Tensor, " a"]
    means: Float[Tensor, "a 3"]
    variances: Float[Tensor, " a"]

    def view_from(self, centre: Float[Tensor, "b 3"]) -> tuple[Float[Tensor, "b a 3"], Float[Tensor, "b a"]]:
        """Return directions (b, a, 3) and concentrations (b, a) of the components, seen from camera centres (b, 3)."""
        towards = self.means - centre.unsqueeze(1)
        return normalize(towards, dim=-1), towards.square().sum(-1) / self.variances + 1


class GOSMA(BranchAndBound):
    """Branch and bound on the distance between the mixtures of both point sets, without matches or an initial pose.

    `residual` of the pose is its distance as a fraction of the image mixture's squared norm (0 for mixtures that
    coincide). `converged` certifies that no pose of the domain is better by more than 0.1 of this norm. This is a
    certificate of the mixtures' alignment, which need not be that of the points.

    Differences from the paper (Campbell et al., CVPR 2019):

    - The search uses the processor, the authors' program a GPU. Fewer boxes are searched in the same time.
    - Clusters are limited in root mean square radii of the points (`cluster2d`, `cluster3d`) instead of an angle and a
      length, and boxes of camera centres lie in a cube of 1.5 weak-perspective distances. Neither depends on the unit
      of the scene.
    - Boxes nearer than half the weak-perspective distance to the centroid of the scene are left out; in the paper,
      camera centres have a least distance from the points.
    - Local optimisation is not confined to the boxes: the pose may lie outside of the cube, or nearer to the centroid.
    - The angle between two clusters, seen from the camera centre, changes by at most |mu - mu'| / (d d') for each unit
      that the centre moves. This bounds the terms of pairs of scene clusters more tightly than two independent
      directions.
    - Local optimisation starts from the best box centres of each iteration, not only from those that are better than
      the best pose.

    Args:
        cluster2d: Largest angle from the mean of an image cluster, in root mean square angles of all rays to their
            mean.
        cluster3d: Largest distance from the mean of a scene cluster, in root mean square distances of all points to
            their mean.
        batch: Number of boxes split together.
        max_boxes: Largest number of boxes; None for as many as the time allows.
        time_limit: Seconds for each problem; then the best pose so far is returned, not converged. None for no limit.
    """

    estimates = ("gosma",)

    def __init__(
        self,
        *,
        cluster2d: float = 0.8,
        cluster3d: float = 0.8,
        batch: int = 512,
        max_boxes: int | None = None,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(max_boxes, time_limit)
        check_positive(cluster2d=cluster2d, cluster3d=cluster3d)
        self.cluster2d, self.cluster3d, self.batch = cluster2d, cluster3d, batch

    def search(
        self, rays: Tensor, points: Tensor, domain: Boxes, camera_distance: float, deadline: Deadline
    ) -> BestPose:
        """Align the mixtures of the scene and of the image; arguments as for `BranchAndBound.search`."""
        angle = root_mean_square(torch.acos((rays @ normalize(rays.sum(0), dim=0)).clamp(-1, 1)))
        scene, image = scene_mixture(points, self.cluster3d), ray_mixture(rays, self.cluster2d * angle)
        return self.align(scene, image, domain, closest=CLOSEST * camera_distance, deadline=deadline)

    def align(
        self,
        scene: SceneMixture,
        rays: RayMixture,
        domain: Boxes,
        *,
        gap: float = GAP,
        closest: float = 0.0,
        deadline: Deadline = NEVER,
    ) -> BestPose:
        """Return a pose with d(R, c) at most `gap` times the image mixture's squared norm above the domain's minimum.

        The domain is restricted to |c| >= `closest`. The `batch` boxes of lowest bound are split together, in rotation
        or in translation, whichever is less certain. Adam descends from their best centres, and L-BFGS refines a better
        pose; both may leave the domain. Value and bound are fractions of the image mixture's squared norm. At the
        deadline or the largest number of boxes, the best pose so far is returned, not certified.

        Args:
            scene: Mixture of the scene points.
            rays: Mixture of the bearings.
            domain: One box that holds all poses to search.
            gap: Distance from the optimum that is allowed, as a fraction of the squared norm. Default 0.1.
            closest: Smallest distance of a camera centre from the origin. Default 0.
            deadline: Time at which to return the best pose so far. Default: none.
        """
        norm = float(squared_norm(rays))
        best = (math.inf, domain.rotation[0], domain.centre[0])

        def descend_from(boxes: Boxes) -> None:
            nonlocal best
            if len(boxes.rotvec) == 0:
                return
            values = distance(scene, rays, boxes.rotation, boxes.centre)
            chosen = boxes.pick(values.topk(min(DESCENTS, len(values)), largest=False).indices)
            poses = descend(scene, rays, chosen.rotation, chosen.centre)
            values = distance(scene, rays, *poses)
            i = int(values.argmin())
            if float(values[i]) < best[0]:
                best = float(values[i]), poses[0][i], poses[1][i]
                turned, moved = descend(scene, rays, *(x[i : i + 1] for x in poses), finely=True)
                if (end := float(distance(scene, rays, turned, moved))) < best[0]:
                    best = end, roma.special_procrustes(turned[0]), moved[0]

        def expand(parents: Boxes) -> tuple[Boxes, Tensor, float]:
            moving = translation_uncertainty(parents, scene.means).amax(-1)
            children = split(parents, rotation_uncertainty(parents) >= moving)
            _, farthest = distance_range(children, torch.zeros_like(scene.means[:1]))
            children = children.pick(farthest.squeeze(-1) >= closest)
            bounds = -lower_bound(scene, rays, children)
            descend_from(children.pick(children.centre.norm(dim=-1) >= closest))
            # Boxes whose bound is within the gap of the best cannot change the result by more than the gap.
            return children, bounds, gap * norm - best[0]

        descend_from(domain)
        left, boxes = best_first(
            domain,
            -lower_bound(scene, rays, domain),
            expand,
            at_once=self.batch,
            until=lambda done: deadline.passed() or done + 1 >= self.max_boxes,
        )
        value, rotation, centre = best
        certified = -left >= value - gap * norm
        bound = value - gap * norm if certified else -left
        return BestPose(rotation, centre, value / norm + 1, bound / norm + 1, boxes + 1, certified)


def descend(
    scene: SceneMixture, rays: RayMixture, rotation: Tensor, centre: Tensor, *, finely: bool = False
) -> tuple[Tensor, Tensor]:
    """Descend from poses (b, 3, 3), (b, 3), by Adam with steps from a tenth of a unit to a thousandth, or by L-BFGS.

    A unit is a radian for rotations, and the mean distance to the scene's clusters for translations.
    """
    mean_distance = torch.linalg.vector_norm(scene.means - centre.unsqueeze(1), dim=-1).mean(-1, keepdim=True)
    unit = torch.cat([torch.ones_like(centre), mean_distance.expand_as(centre)], -1)
    step = torch.zeros_like(unit, requires_grad=True)
    lbfgs = torch.optim.LBFGS([step], max_iter=POLISH_STEPS, line_search_fn="strong_wolfe")
    optimiser = lbfgs if finely else torch.optim.Adam([step], lr=0.1)

    def loss() -> Tensor:
        step.grad = None
        total = distance(scene, rays, *retract(unit * step, rotation, centre)).sum()
        total.backward()
        return total

    with torch.enable_grad():
        for _ in range(1 if finely else DESCENT_STEPS):
            optimiser.step(loss)
            optimiser.param_groups[0]["lr"] *= 0.01 ** (1 / DESCENT_STEPS)
    return retract(unit * step.detach(), rotation, centre)


def ray_mixture(rays: Float[Tensor, "m 3"], angle: float) -> RayMixture:
    """Fit a mixture to rays by DP-vMF-means: clusters within `angle` (radians) of their mean direction.

    A cluster with the mean resultant length r gets the concentration r (3 - r^2)/(1 - r^2), and is no narrower than a
    tenth of the angle.
    """
    weights, sums = _totals(rays, _means(rays, angle, spherical=True))
    length = torch.linalg.vector_norm(sums, dim=-1) / weights
    concentration = length * (3 - length.square()) / (1 - length.square()).clamp_min(1e-12)
    return RayMixture(weights / len(rays), normalize(sums, dim=-1), concentration.clamp_max((10 / angle) ** 2))


def scene_mixture(points: Float[Tensor, "n 3"], radius: float) -> SceneMixture:
    """Fit a mixture to points by DP-means: clusters within `radius` of their mean.

    A cluster is no narrower than a tenth of the radius.
    """
    labels = _means(points, radius, spherical=False)
    weights, sums = _totals(points, labels)
    means = sums / weights.unsqueeze(-1)
    squared = (points - means[labels]).square().sum(-1, keepdim=True)
    variances = _totals(squared, labels)[1].squeeze(-1) / (3 * weights)
    return SceneMixture(weights / len(points), means, variances.clamp_min((radius / 10) ** 2))


def _means(points: Tensor, limit: float, *, spherical: bool) -> Int[Tensor, " k"]:
    """Cluster points by DP-means and return their labels.

    When Lloyd's iterations have converged, a new cluster is added at the point farthest from all centres, if that is
    beyond `limit`. The result does not depend on the order of the points.
    """
    labels = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for _ in range(ITERATIONS):
        weights, sums = _totals(points, labels)
        centres = normalize(sums, dim=-1) if spherical else sums / weights.unsqueeze(-1)
        distances = angle_between(points.unsqueeze(1), centres) if spherical else torch.cdist(points, centres)
        nearest, assigned = distances.min(-1)
        if bool((assigned == labels).all()):
            outermost = int(nearest.argmax())
            if float(nearest[outermost]) <= limit:
                break
            assigned[outermost] = len(centres)
        labels = assigned.unique(return_inverse=True)[1]
    return labels


def _totals(values: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number and the sum of the values of each label."""
    members = one_hot(labels).to(values.dtype)
    return members.sum(0), members.mT @ values


def log_z(k: Tensor) -> Tensor:
    """Return log(4 pi sinh(k)/k), k >= 0."""
    k = k.clamp_min(1e-9)
    return k + torch.log(-torch.expm1(-2 * k)) - torch.log(2 * k) + math.log(4 * math.pi)


def overlap(k: Tensor, other: Tensor, cosine: Tensor) -> Tensor:
    """Return the integral of the product of two von Mises-Fisher densities with this cosine between their axes."""
    together = (k.square() + other.square() + 2 * k * other * cosine).clamp_min(0).sqrt()
    return torch.exp(log_z(together) - log_z(k) - log_z(other))


def squared_norm(rays: RayMixture) -> Float[Tensor, ""]:
    """Return the integral of the squared density of the image's mixture."""
    terms = overlap(rays.concentrations.unsqueeze(-1), rays.concentrations, rays.directions @ rays.directions.mT)
    return rays.weights @ terms @ rays.weights


def distance(scene: SceneMixture, rays: RayMixture, rotation: Tensor, centre: Tensor) -> Float[Tensor, " b"]:
    """Return d(R, c) of rotations (b, 3, 3) and centres (b, 3), without the constant `squared_norm(rays)`."""
    directions, k = scene.view_from(centre)
    self_terms = overlap(k.unsqueeze(-1), k.unsqueeze(-2), directions @ directions.mT)
    cross_terms = overlap(k.unsqueeze(-1), rays.concentrations, directions @ rotation.mT @ rays.directions.mT)
    return _combine(scene, rays, self_terms, cross_terms)


def lower_bound(scene: SceneMixture, rays: RayMixture, boxes: Boxes) -> Float[Tensor, " b"]:
    """Return a lower bound of d(R, c) over all poses of each box: every term takes its best value independently.

    Angles are within the box's uncertainty of those at its centre, concentrations between those at the least and the
    largest distance. The angle between two means, seen from the camera centre, has a gradient of the length
    |mu - mu'| / (d d'), d and d' their distances, which bounds its change too.
    """
    directions, _ = scene.view_from(boxes.centre)
    rotating, moving = rotation_uncertainty(boxes), translation_uncertainty(boxes, scene.means)
    closest, farthest = distance_range(boxes, scene.means)
    least, largest = (values.square() / scene.variances + 1 for values in (closest, farthest))

    half_diagonal = boxes.centre_half.norm(dim=-1)[:, None, None]
    gradient = torch.cdist(scene.means, scene.means) / (closest.unsqueeze(-1) * closest.unsqueeze(-2)).clamp_min(1e-12)
    parting = torch.minimum(moving.unsqueeze(-1) + moving.unsqueeze(-2), half_diagonal * gradient + 1e-7)
    wide = (torch.acos((directions @ directions.mT).clamp(-1, 1)) + parting).clamp_max(math.pi)
    wide = wide * (1 - torch.eye(len(scene.means), dtype=wide.dtype, device=wide.device))
    self_terms = _least_overlap(least, largest, wide.cos())
    angle = torch.acos((directions @ boxes.rotation.mT @ rays.directions.mT).clamp(-1, 1))
    narrow = (angle - rotating[:, None, None] - moving.unsqueeze(-1)).clamp_min(0)
    cross_terms = _largest_overlap(least.unsqueeze(-1), largest.unsqueeze(-1), rays.concentrations, narrow.cos())
    return _combine(scene, rays, self_terms * (1 - ROUNDING), cross_terms * (1 + ROUNDING))


def _combine(scene: SceneMixture, rays: RayMixture, self_terms: Tensor, cross_terms: Tensor) -> Tensor:
    return (self_terms @ scene.weights) @ scene.weights - 2 * (cross_terms @ rays.weights) @ scene.weights


def _least_overlap(least: Tensor, largest: Tensor, cosine: Tensor) -> Tensor:
    """Return the smallest E over both concentrations.

    E has one maximum in each of them, so its minimum is at an end.
    """
    ends = [overlap(a.unsqueeze(-1), b.unsqueeze(-2), cosine) for a in (least, largest) for b in (least, largest)]
    # A component paired with itself has one concentration, not two.
    itself = overlap(least, least, torch.ones_like(least))
    same = torch.eye(least.shape[-1], dtype=torch.bool, device=least.device)
    return torch.where(same, itself.unsqueeze(-1), torch.stack(ends).amin(0))


def _largest_overlap(least: Tensor, largest: Tensor, fixed: Tensor, cosine: Tensor) -> Tensor:
    """Return the largest E over the first concentration; bisection of the sign of the slope finds its only maximum."""
    low, high, fixed, cosine = torch.broadcast_tensors(least, largest, fixed, cosine)
    rises_to_end, falls_from_start = _rises(high, fixed, cosine), ~_rises(low, fixed, cosine)
    inside = ~(rises_to_end | falls_from_start)
    best = torch.where(rises_to_end, high, low).clone()
    a, b, k, c = (values[inside] for values in (low, high, fixed, cosine))
    for _ in range(BISECTIONS):
        midpoint = (a + b) / 2
        up = _rises(midpoint, k, c)
        a, b = torch.where(up, midpoint, a), torch.where(up, b, midpoint)
    best[inside] = (a + b) / 2
    return overlap(best, fixed, cosine)


def _rises(k: Tensor, fixed: Tensor, cosine: Tensor) -> Tensor:
    """Return True where E grows with k: A(|k m + k' m'|) cos(m, k m + k' m') > A(k) with A(k) = coth k - 1/k."""
    together = (k.square() + fixed.square() + 2 * k * fixed * cosine).clamp_min(1e-18).sqrt()
    return _mean_length(together) * (k + fixed * cosine) > _mean_length(k) * together


def _mean_length(k: Tensor) -> Tensor:
    return torch.where(k < 1e-3, k / 3, 1 / torch.tanh(k.clamp_min(1e-3)) - 1 / k.clamp_min(1e-3))
