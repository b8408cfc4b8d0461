"""Branch and bound: the searches end at planted optima, with bounds that no pose of a grid beats."""

import math

import roma
import torch
from torch import Tensor

from bpnp.models.baselines.branch_and_bound import Boxes
from bpnp.models.baselines.gosma import RayMixture, SceneMixture, align_mixtures, distance, squared_norm


def whole(turn: Tensor, turn_half: float, place: Tensor, place_half: float) -> Boxes:
    return Boxes(
        turn.reshape(1, 3), turn.new_full((1,), turn_half), place.reshape(1, 3), turn.new_full((1, 3), place_half)
    )


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
