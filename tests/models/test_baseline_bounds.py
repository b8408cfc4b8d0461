"""Branch and bound: no pose of a box beats the box's bound, and the searches end at planted optima."""

import math

import roma
import torch
from torch import Tensor

from bpnp.models.baselines.branch_and_bound import Boxes
from bpnp.models.baselines.gosma import RayMixture, SceneMixture, align_mixtures, distance, lower_bound, squared_norm


def normal(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def uniform(*shape: int) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64)


def random_boxes(count: int) -> Boxes:
    """From large to small, elongated, around and away from the origin."""
    halves = 10 ** (-2 * uniform(count, 1)) * (0.3 + uniform(count, 3))
    return Boxes(1.5 * normal(count, 3), 10 ** (-2 * uniform(count)), 3 * normal(count, 3), halves)


def some_pose(boxes: Boxes, *, corner: bool) -> tuple[Tensor, Tensor]:
    turn, shift = (2 * uniform(len(boxes.turn), 3) - 1 for _ in range(2))
    turn, shift = (turn.sign(), shift.sign()) if corner else (turn, shift)
    rotation = roma.rotvec_to_rotmat(boxes.turn + turn * boxes.turn_half.unsqueeze(-1))
    return rotation, boxes.place + shift * boxes.place_half


def random_mixtures() -> tuple[SceneMixture, RayMixture]:
    weights3d, weights2d = (torch.nn.functional.normalize(0.2 + uniform(k), p=1, dim=0) for k in (5, 6))
    directions = torch.nn.functional.normalize(normal(6, 3), dim=-1)
    scene = SceneMixture(weights3d, normal(5, 3), 0.02 + 0.3 * uniform(5))
    return scene, RayMixture(weights2d, directions, 1 + 300 * uniform(6))


def whole(turn: Tensor, turn_half: float, place: Tensor, place_half: float) -> Boxes:
    return Boxes(
        turn.reshape(1, 3), turn.new_full((1,), turn_half), place.reshape(1, 3), turn.new_full((1, 3), place_half)
    )


def test_no_pose_of_ten_thousand_boxes_is_below_the_mixtures_bound() -> None:
    tightest = math.inf
    for _ in range(10):
        scene, rays = random_mixtures()
        boxes = random_boxes(1000)
        bound = lower_bound(scene, rays, boxes)
        for trial in range(20):
            value = distance(scene, rays, *some_pose(boxes, corner=trial % 2 == 1))
            assert (bound <= value).all()
            tightest = min(tightest, float((value - bound).min()))
    assert tightest < 0.1  # a bound far below everything would pass as well


def planted_mixtures() -> tuple[SceneMixture, RayMixture, Tensor, Tensor]:
    """Four clusters, seen exactly, and a cluster of the image that no part of the scene explains."""
    means = torch.tensor([[1.0, 0, 0.3], [-0.8, 0.5, -0.4], [0.1, -1.0, 0.5], [0.2, 0.9, 0.8]]).double()
    scene = SceneMixture(
        torch.tensor([0.4, 0.3, 0.2, 0.1]).double(), means, 0.05 * torch.tensor([1, 1.3, 0.8, 1.2]).double()
    )
    rotation = roma.rotvec_to_rotmat(torch.tensor([0.2, -0.3, 0.25]).double())
    place = torch.tensor([0.4, -0.3, -4.0]).double()
    towards = means - place
    outlier = torch.tensor([[0.0, 0.0, -1.0]]).double()
    rays = RayMixture(
        torch.cat([0.97 * scene.weights, torch.tensor([0.03]).double()]),
        torch.cat([torch.nn.functional.normalize(towards, dim=-1) @ rotation.mT, outlier]),
        torch.cat([towards.square().sum(-1) / scene.variances + 1, torch.tensor([20.0]).double()]),
    )
    return scene, rays, rotation, place


def test_gosma_finds_the_planted_pose_with_a_certificate_that_a_grid_confirms() -> None:
    scene, rays, rotation, place = planted_mixtures()
    domain = whole(torch.zeros(3).double(), 0.45, torch.tensor([0.3, -0.2, -4.1]).double(), 0.2)
    found = align_mixtures(scene, rays, domain, gap=0.2, max_boxes=100_000)
    assert found.certified
    # The outliers' weight is missing elsewhere, which moves the optimum a little.
    assert float(roma.rotmat_geodesic_distance(found.rotation, rotation)) < math.radians(1)
    assert float((found.place - place).norm()) < 0.1
    steps = torch.linspace(-1, 1, 6).double()
    grid = torch.cartesian_prod(steps, steps, steps)
    norm = float(squared_norm(rays))
    lowest = math.inf
    for shift in grid:
        turned = roma.rotvec_to_rotmat(0.45 * grid)
        values = distance(scene, rays, turned, (domain.place + 0.2 * shift).expand(len(grid), 3))
        lowest = min(lowest, float(values.min()) / norm + 1)
    assert found.bound <= lowest
    assert found.value <= lowest  # no grid point beats it
