"""GOSMA: globally optimal alignment of two mixtures on the sphere, by branch and bound (Campbell et al., CVPR 2019)."""

import math
from typing import NamedTuple

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from bpnp.geometry import bearings
from bpnp.models.baselines.branch_and_bound.boxes import (
    Boxes,
    distance_range,
    join,
    rotation_uncertainty,
    split,
    translation_uncertainty,
)
from bpnp.models.baselines.branch_and_bound.mixture_distance import distance, lower_bound, squared_norm
from bpnp.models.baselines.branch_and_bound.mixtures import RayMixture, SceneMixture, ray_mixture, scene_mixture, spread
from bpnp.models.baselines.single_pairs import Clock, Found, PairSolver, SinglePair
from bpnp.models.baselines.starts import weak_perspective_distance

POLISH_STEPS = 50
DESCENTS = 32  # centres of a round that descend
DESCENT_STEPS = 30


class Aligned(NamedTuple):
    """The best pose, camera = R (p - c), its distance and a number that no pose of the domain falls below, both as
    shares of the image mixture's squared norm. `certified`: they differ by the gap or less."""

    rotation: Float[Tensor, "3 3"]
    place: Float[Tensor, "3"]
    value: float
    bound: float
    boxes: int
    certified: bool


def align_mixtures(
    scene: SceneMixture,
    rays: RayMixture,
    domain: Boxes,
    *,
    gap: float = 0.1,
    closest: float = 0.0,
    batch: int = 512,
    max_boxes: int | None = None,
    clock: Clock | None = None,
) -> Aligned:
    """Smallest d(R, c) over a domain (boxes, usually one) with |c| >= `closest`, to within `gap` of the image mixture's
    squared norm.

    Best first: the `batch` boxes of lowest bound are split together, in rotation or in translation, whichever is the
    less certain; of every round the best centres descend, and a better pose is polished by L-BFGS. Ends with the
    certificate, or with the best pose so far after about `max_boxes` boxes or at the clock's limit.
    """
    norm = float(squared_norm(rays))
    pending, bounds = domain, lower_bound(scene, rays, domain)
    best, rotation, place = _best_centre(scene, rays, domain, math.inf, None)
    assert place is not None
    done = len(bounds)
    while len(bounds) and float(bounds.min()) < best - gap * norm:
        if (clock is not None and clock.over()) or (max_boxes is not None and done >= max_boxes):
            break
        chosen = bounds.topk(min(batch, len(bounds)), largest=False).indices
        rest = torch.ones_like(bounds, dtype=torch.bool)
        rest[chosen] = False
        parents = pending.pick(chosen)
        moving = translation_uncertainty(parents, scene.means).amax(-1)
        children = split(parents, rotation_uncertainty(parents) >= moving)
        _, farthest = distance_range(children, torch.zeros_like(scene.means[:1]))
        children = children.pick(farthest.squeeze(-1) >= closest)
        children_bounds = torch.maximum(lower_bound(scene, rays, children), bounds[chosen].min())
        done += len(children_bounds)
        allowed = children.pick(children.place.norm(dim=-1) >= closest)
        best, rotation, place = _best_centre(scene, rays, allowed, best, (rotation, place))
        pending, bounds = join([pending.pick(rest), children]), torch.cat([bounds[rest], children_bounds])
        promising = bounds < best - gap * norm
        # What is left out cannot beat the best by more than the gap.
        pending, bounds = pending.pick(promising), bounds[promising]
    certified = len(bounds) == 0 or float(bounds.min()) >= best - gap * norm
    bound = best - gap * norm if certified else float(bounds.min())
    return Aligned(rotation, place, best / norm + 1, bound / norm + 1, done, certified)


def _best_centre(
    scene: SceneMixture, rays: RayMixture, boxes: Boxes, best: float, pose: tuple[Tensor, Tensor] | None
) -> tuple[float, Tensor, Tensor]:
    """The pose of lowest distance: the one given, or one that descends from the best of the boxes' centres.

    The few best centres descend together, also where they are worse than the pose: a local optimum hides between them.
    The lowest of their ends, if it beats the pose, is polished.
    """
    if len(boxes.turn) == 0 and pose is not None:
        return best, *pose
    values = distance(scene, rays, boxes.rotation, boxes.place)
    chosen = boxes.pick(values.topk(min(DESCENTS, len(values)), largest=False).indices)
    rotations, places = descend(scene, rays, chosen.rotation, chosen.place)
    values = distance(scene, rays, rotations, places)
    i = int(values.argmin())
    if pose is not None and float(values[i]) >= best:
        return best, *pose
    return polish(scene, rays, rotations[i], places[i])


def descend(
    scene: SceneMixture, rays: RayMixture, rotation: Float[Tensor, "b 3 3"], place: Float[Tensor, "b 3"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Adam's steps from several poses, each for itself, from a tenth of a radian down to a thousandth."""
    reach = torch.linalg.vector_norm(scene.means - place.unsqueeze(1), dim=-1).mean(-1, keepdim=True)
    step = torch.zeros(len(place), 6, dtype=place.dtype, device=place.device, requires_grad=True)
    optimiser = torch.optim.Adam([step], lr=0.1)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.01 ** (1 / DESCENT_STEPS))
    with torch.enable_grad():
        for _ in range(DESCENT_STEPS):
            optimiser.zero_grad()
            turned = roma.rotvec_to_rotmat(step[:, :3]) @ rotation
            distance(scene, rays, turned, place + reach * step[:, 3:]).sum().backward()
            optimiser.step()
            schedule.step()
    found = step.detach()
    return roma.rotvec_to_rotmat(found[:, :3]) @ rotation, place + reach * found[:, 3:]


def polish(
    scene: SceneMixture, rays: RayMixture, rotation: Float[Tensor, "3 3"], place: Float[Tensor, "3"]
) -> tuple[float, Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """L-BFGS from one pose, and the lower of the two ends."""
    reach = torch.linalg.vector_norm(scene.means - place, dim=-1).mean()  # so that a step moves and turns alike
    step = torch.zeros(6, dtype=place.dtype, device=place.device, requires_grad=True)
    optimiser = torch.optim.LBFGS([step], max_iter=POLISH_STEPS, line_search_fn="strong_wolfe")

    def moved() -> tuple[Tensor, Tensor]:
        return roma.rotvec_to_rotmat(step[:3]) @ rotation, place + reach * step[3:]

    def value() -> Tensor:
        turned, shifted = moved()
        return distance(scene, rays, turned.unsqueeze(0), shifted.unsqueeze(0)).squeeze(0)

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = value()
        loss.backward()
        return loss

    with torch.no_grad():
        start = float(value())
    with torch.enable_grad():
        optimiser.step(closure)
    with torch.no_grad():
        end = float(value())
        if not end < start:
            return start, rotation, place
        turned, shifted = moved()
        return end, roma.special_procrustes(turned), shifted


class GOSMA(PairSolver):
    """Branch and bound on the distance between the mixtures of both point sets; no matching, no start.

    The camera centre is searched in a cube around the scene's centre, the rotation everywhere. `residual` of the pose
    is its distance as a share of the image mixture's squared norm (0 for mixtures that coincide); `converged` is the
    certificate that no pose of the domain is better by more than `gap`. It certifies the mixtures' alignment, which
    need not be that of the points.

    Args:
        spread2d: reach of an image cluster, in root mean square angles of the rays to their mean.
        spread3d: reach of a scene cluster, in root mean square distances of the points to their mean.
        domain: half side of the cube of camera centres, in weak-perspective distances.
        closest: least distance of the camera centre from the scene's, in weak-perspective distances; 0 for cameras
            among the points.
        gap: share of the image mixture's squared norm by which the answer may miss the optimum.
        batch: boxes split together.
        max_boxes: most boxes; null for as many as the time allows.
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("gosma",)

    def __init__(
        self,
        *,
        spread2d: float = 0.8,
        spread3d: float = 0.8,
        domain: float = 1.5,
        closest: float = 0.5,
        gap: float = 0.1,
        batch: int = 512,
        max_boxes: int | None = None,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        for name, value in {"spread2d": spread2d, "spread3d": spread3d, "domain": domain, "gap": gap}.items():
            if not value > 0:
                raise ValueError(f"expected `{name}` > 0, got {value}")
        self.spread2d, self.spread3d, self.domain = spread2d, spread3d, domain
        self.closest, self.gap, self.batch, self.max_boxes = closest, gap, batch, max_boxes

    def solve(self, pair: SinglePair, clock: Clock) -> Found:
        rays, centre = bearings(pair.points2d), pair.points3d.mean(0)
        mean_ray = torch.nn.functional.normalize(rays.sum(0), dim=0)
        angle = spread(torch.acos((rays @ mean_ray).clamp(-1, 1)))
        radius = spread((pair.points3d - centre).norm(dim=-1))
        points = (pair.points3d - centre) / radius
        distance_away = weak_perspective_distance(pair.points2d, points)
        aligned = align_mixtures(
            scene_mixture(points, self.spread3d),
            ray_mixture(rays, self.spread2d * angle),
            whole_domain(points, self.domain * distance_away),
            gap=self.gap,
            closest=self.closest * distance_away,
            batch=self.batch,
            max_boxes=self.max_boxes,
            clock=clock,
        )
        translation = -aligned.rotation @ (radius * aligned.place + centre)
        return Found(aligned.rotation, translation, aligned.boxes, aligned.value, aligned.certified)


def whole_domain(like: Tensor, half: float) -> Boxes:
    """All rotations, and the camera centres within `half` of the origin along each axis."""
    zero = like.new_zeros(1, 3)
    return Boxes(zero, like.new_full((1,), math.pi), zero, like.new_full((1, 3), half))
