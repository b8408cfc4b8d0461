"""Branch and bound: no pose turns a direction beyond its box's uncertainty, and the searches end at planted optima."""

import math

import pytest
import roma
import torch
from planted import plant
from torch import Tensor

from bpnp.geometry import angle_between, camera_centre
from bpnp.models.baselines.branch_and_bound import (
    GOPAC,
    Boxes,
    rotation_uncertainty,
    translation_uncertainty,
    within,
)
from bpnp.models.baselines.gosma import GOSMA, RayMixture, SceneMixture, distance, squared_norm
from bpnp.runtime import NEVER


def whole(turn: Tensor, rotvec_half: float, place: Tensor, centre_half: float) -> Boxes:
    return Boxes(
        turn.reshape(1, 3), turn.new_full((1,), rotvec_half), place.reshape(1, 3), turn.new_full((1, 3), centre_half)
    )


def test_no_pose_of_a_box_rotates_a_direction_beyond_its_uncertainty() -> None:
    generator = torch.Generator().manual_seed(0)
    turn, place, points = (torch.randn(k, 3, generator=generator).double() for k in (1000, 1000, 20))
    halves = 10 ** (-2 * torch.rand(1000, 1, generator=generator).double()) * torch.tensor([[0.3, 1.0, 0.6]]).double()
    boxes = Boxes(turn, halves[:, 0], 3 * place, halves)
    turning, moving = rotation_uncertainty(boxes), translation_uncertainty(boxes, points)
    towards = points - boxes.centre.unsqueeze(1)
    largest = torch.zeros(2)
    for trial in range(32):
        turned, moved = (2 * torch.rand(1000, 3, generator=generator).double() - 1 for _ in range(2))
        if trial % 2:  # corners
            turned, moved = turned.sign(), moved.sign()
        rotation = roma.rotvec_to_rotmat(boxes.rotvec + turned * boxes.rotvec_half.unsqueeze(-1))
        angles = angle_between(towards @ rotation.mT, towards @ boxes.rotation.mT) / turning.unsqueeze(-1)
        shifts = angle_between(points - (boxes.centre + moved * halves).unsqueeze(1), towards) / moving
        largest = torch.maximum(largest, torch.stack([angles.max(), shifts.max()]))
    assert (largest <= 1).all()
    assert (largest > 0.9).all()  # bounds far above everything would pass as well


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


@pytest.mark.slow
def test_gosma_finds_the_planted_pose_with_a_certificate_that_a_grid_confirms() -> None:
    scene, rays, rotation, place = planted_mixtures()
    domain = whole(torch.zeros(3).double(), 0.45, torch.tensor([0.3, -0.2, -4.1]).double(), 0.2)
    found = GOSMA(max_boxes=100_000, time_limit=None).align(scene, rays, domain, gap=0.2)
    assert found.certified
    # The outliers' weight is missing elsewhere, which moves the optimum a little.
    assert float(roma.rotmat_geodesic_distance(found.rotation, rotation)) < math.radians(1)
    assert float((found.centre - place).norm()) < 0.1
    steps = torch.linspace(-1, 1, 6).double()
    grid = torch.cartesian_prod(steps, steps, steps)
    norm = float(squared_norm(rays))
    lowest = math.inf
    for shift in grid:
        turned = roma.rotvec_to_rotmat(0.45 * grid)
        values = distance(scene, rays, turned, (domain.centre + 0.2 * shift).expand(len(grid), 3))
        lowest = min(lowest, float(values.min()) / norm + 1)
    assert found.bound <= lowest
    assert found.value <= lowest  # no grid point beats it


def test_gopac_finds_the_planted_inliers_with_a_certificate_that_a_grid_confirms() -> None:
    problem = plant(1, 7, seed=3, outliers2d=2, outliers3d=2)
    rays, points = problem.bearings[0], problem.points3d[0]
    centre = camera_centre(*problem.pose)[0]
    turn = roma.rotmat_to_rotvec(problem.rotation)[0]
    domain = whole(turn + 0.05, 0.15, centre + 0.05, 0.15)
    found = GOPAC(angle=0.01, max_boxes=3_000_000, time_limit=None).search(rays, points, domain, 0.0, NEVER)
    assert found.rotation is not None
    assert found.value == found.bound
    count = round((1 - found.value) * len(rays))
    assert count >= 7
    assert int(within(rays, points, found.rotation, found.centre, 0.01).any(-1).sum()) == count
    steps = torch.linspace(-1, 1, 7).double()
    grid = torch.cartesian_prod(steps, steps, steps)
    most = 0
    for shift in grid:
        directions = torch.nn.functional.normalize(points - domain.centre[0] - 0.15 * shift, dim=-1)
        cosine = (rays @ roma.rotvec_to_rotmat(domain.rotvec + 0.15 * grid)) @ directions.mT
        most = max(most, int((cosine >= math.cos(0.01)).any(-1).sum(-1).max()))
    assert most <= count
