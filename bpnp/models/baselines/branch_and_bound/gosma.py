"""GOSMA: globally optimal alignment of two mixtures on the sphere, by branch and bound (Campbell et al., CVPR 2019)."""

import math

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.checks import check_positive
from bpnp.geometry import bearings, retract
from bpnp.loops.parallel import NEVER, Deadline
from bpnp.models.baselines.branch_and_bound.boxes import (
    Boxes,
    Found,
    best_first,
    distance_range,
    root_mean_square,
    rotation_uncertainty,
    split,
    translation_uncertainty,
    unit_scene,
    whole_domain,
)  # fmt: skip
from bpnp.models.baselines.branch_and_bound.mixtures import (
    RayMixture,
    SceneMixture,
    distance,
    lower_bound,
    ray_mixture,
    scene_mixture,
    squared_norm,
)
from bpnp.models.baselines.single_pairs import Answer, PairSolver, SinglePair, weak_perspective_distance

DOMAIN = 1.5
CLOSEST = 0.5
GAP = 0.1  # share of the image mixture's squared norm by which the answer may miss the optimum
POLISH_STEPS = 50
DESCENTS = 32  # best box centres of an iteration, from which Adam descends
DESCENT_STEPS = 30


def align_mixtures(
    scene: SceneMixture,
    rays: RayMixture,
    domain: Boxes,
    *,
    gap: float = GAP,
    closest: float = 0.0,
    batch: int = 512,
    max_boxes: int | float = math.inf,
    deadline: Deadline = NEVER,
) -> Found:
    """Smallest d(R, c) over a domain (boxes, usually one) with |c| >= `closest`, to within `gap` of the image mixture's
    squared norm.

    Best first: the `batch` boxes of lowest bound are split together, in rotation or in translation, whichever is the
    less certain; Adam descends from the best centres, and L-BFGS polishes a better pose. Ends with the certificate, or
    with the best pose so far after about `max_boxes` boxes or at the deadline. Value and bound are shares of the image
    mixture's squared norm.
    """
    norm = float(squared_norm(rays))
    best = _best_centre(scene, rays, domain, (math.inf, domain.rotation[0], domain.place[0]))

    def expand(parents: Boxes) -> tuple[Boxes, Tensor, int | float]:
        nonlocal best
        moving = translation_uncertainty(parents, scene.means).amax(-1)
        children = split(parents, rotation_uncertainty(parents) >= moving)
        _, farthest = distance_range(children, torch.zeros_like(scene.means[:1]))
        children = children.pick(farthest.squeeze(-1) >= closest)
        bounds = -lower_bound(scene, rays, children)
        best = _best_centre(scene, rays, children.pick(children.place.norm(dim=-1) >= closest), best)
        # Boxes whose bound is within the gap of the best cannot change the result by more than the gap.
        return children, bounds, gap * norm - best[0]

    left, boxes = best_first(
        domain, -lower_bound(scene, rays, domain), expand, at_once=batch,
        until=lambda done: deadline.passed() or done + len(domain.turn) >= max_boxes,
    )  # fmt: skip
    value, rotation, place = best
    certified = -left >= value - gap * norm
    bound = value - gap * norm if certified else -left
    return Found(rotation, place, value / norm + 1, bound / norm + 1, boxes + len(domain.turn), certified)


def _best_centre(
    scene: SceneMixture, rays: RayMixture, boxes: Boxes, best: tuple[float, Tensor, Tensor]
) -> tuple[float, Tensor, Tensor]:
    """Distance and pose of the lowest of: the best so far, and the results of descents from the boxes' centres.

    Adam descends from the best centres, also where they are worse than the best so far, since a better local optimum
    may lie close to them. The lowest result is polished if it is lower than the best so far.
    """
    if len(boxes.turn) == 0:
        return best
    values = distance(scene, rays, boxes.rotation, boxes.place)
    chosen = boxes.pick(values.topk(min(DESCENTS, len(values)), largest=False).indices)
    rotations, places = descend(scene, rays, chosen.rotation, chosen.place)
    values = distance(scene, rays, rotations, places)
    i = int(values.argmin())
    return best if float(values[i]) >= best[0] else polish(scene, rays, rotations[i], places[i])


def descend(
    scene: SceneMixture,
    rays: RayMixture,
    rotation: Float[Tensor, "b 3 3"],
    place: Float[Tensor, "b 3"],
    *,
    finely: bool = False,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Adam's steps from several poses, each for itself, from a tenth of a unit down to a thousandth; or L-BFGS.

    Units of a step: radians, and the mean distance to the scene's clusters, so that both move the image alike.
    """
    away = torch.linalg.vector_norm(scene.means - place.unsqueeze(1), dim=-1).mean(-1, keepdim=True)
    unit = torch.cat([torch.ones_like(place), away.expand_as(place)], -1)
    step = torch.zeros_like(unit, requires_grad=True)
    lbfgs = torch.optim.LBFGS([step], max_iter=POLISH_STEPS, line_search_fn="strong_wolfe")
    optimiser = lbfgs if finely else torch.optim.Adam([step], lr=0.1)

    def loss() -> Tensor:
        step.grad = None
        total = distance(scene, rays, *retract(unit * step, rotation, place)).sum()
        total.backward()
        return total

    with torch.enable_grad():
        for _ in range(1 if finely else DESCENT_STEPS):
            optimiser.step(loss)
            optimiser.param_groups[0]["lr"] *= 0.01 ** (1 / DESCENT_STEPS)
    return retract(unit * step.detach(), rotation, place)


def polish(
    scene: SceneMixture, rays: RayMixture, rotation: Float[Tensor, "3 3"], place: Float[Tensor, "3"]
) -> tuple[float, Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """L-BFGS from one pose; the pose given where it ends no lower."""
    start = rotation.unsqueeze(0), place.unsqueeze(0)
    turned, moved = descend(scene, rays, *start, finely=True)
    end, before = float(distance(scene, rays, turned, moved)), float(distance(scene, rays, *start))
    return (end, roma.special_procrustes(turned[0]), moved[0]) if end < before else (before, rotation, place)


class GOSMA(PairSolver):
    """Branch and bound on the distance between the mixtures of both point sets; no matching, no initial pose.

    The camera centre is searched in a cube around the scene's centre of half side DOMAIN, no closer to it than CLOSEST
    (weak-perspective distances), the rotation everywhere. `residual` of the pose is its distance as a share of the
    image mixture's squared norm (0 for mixtures that coincide); `converged` is the certificate that no pose of the
    domain is better by more than GAP. It certifies the mixtures' alignment, which need not be that of the points.

    Args:
        cluster2d: largest angle from an image cluster's mean, in root mean square angles of all rays to theirs.
        cluster3d: largest distance from a scene cluster's mean, in root mean square distances of all points to theirs.
        batch: boxes split together.
        max_boxes: most boxes; null for as many as the time allows.
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
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
        super().__init__(time_limit)
        check_positive(cluster2d=cluster2d, cluster3d=cluster3d)
        self.cluster2d, self.cluster3d, self.batch = cluster2d, cluster3d, batch
        self.max_boxes = math.inf if max_boxes is None else max_boxes

    def solve(self, pair: SinglePair, deadline: Deadline) -> Answer:
        rays = bearings(pair.points2d)
        mean_ray = torch.nn.functional.normalize(rays.sum(0), dim=0)
        angle = root_mean_square(torch.acos((rays @ mean_ray).clamp(-1, 1)))
        points, centre, radius = unit_scene(pair.points3d)
        away = weak_perspective_distance(pair.points2d, points)
        found = align_mixtures(
            scene_mixture(points, self.cluster3d), ray_mixture(rays, self.cluster2d * angle),
            whole_domain(points, DOMAIN * away), closest=CLOSEST * away, batch=self.batch, max_boxes=self.max_boxes,
            deadline=deadline,
        )  # fmt: skip
        return found.answer(centre, radius, residual=found.value)
