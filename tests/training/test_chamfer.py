"""The Chamfer loss: nearest points by scipy, its gradient by finite differences, and what it does not need."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import directions, padded, plant, posed
from scipy.spatial import KDTree
from torch import Tensor

from bpnp import Prediction
from bpnp.layers import weighted_pnp
from bpnp.training import ChamferLoss


def test_the_loss_is_the_mean_squared_distance_to_the_nearest_point_of_the_other_side() -> None:
    planted = plant(2, 15, outliers2d=4, outliers3d=6, seed=1)
    rotation, translation = planted.near(0.1)
    found = ChamferLoss(width=0.02)(Prediction(poses={"pnp": posed(rotation, translation)}), planted.batch())["chamfer"]
    for k in range(2):
        camera = planted.points3d[k].numpy() @ rotation[k].numpy().T + translation[k].numpy()
        rays, ways = planted.bearings[k].numpy(), directions(camera)
        there, back = KDTree(ways).query(rays)[0], KDTree(rays).query(ways)[0]
        assert found[k].item() == pytest.approx(((there**2).mean() + (back**2).mean()) / 0.02**2, rel=1e-4)


def test_the_true_pose_has_none_whatever_the_matches() -> None:
    planted = plant(3, 10)
    unlabelled = replace(planted.batch(), rotation=None, translation=None, match3d=None)
    assert ChamferLoss()(Prediction(poses={"pnp": posed(*planted.pose)}), unlabelled)["chamfer"].max() < 1e-6


def test_the_gradient_through_the_pnp_layer_is_finite_differences() -> None:
    planted = plant(1, 6, outliers2d=2, seed=3)
    start, batch = planted.near(0.02), planted.batch().to(torch.float64)

    def loss(assignment: Tensor) -> Tensor:
        rotation, translation, _ = weighted_pnp(
            assignment, planted.bearings, planted.points3d, *start, tolerance=1e-13, max_iterations=100
        )
        return ChamferLoss(width=0.1)(Prediction(poses={"pnp": posed(rotation, translation)}), batch)["chamfer"][0]

    at = planted.diffuse(0.2).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(at), at)
    for i, j in ((0, 0), (3, 2), (7, 5)):
        step = torch.zeros_like(at)
        step[0, i, j] = 1e-6
        numeric = (loss(at + step) - loss(at - step)).item() / 2e-6
        assert gradient[0, i, j].item() == pytest.approx(numeric, rel=1e-3, abs=1e-6)


def test_padding_is_no_point_and_a_sample_without_a_pose_has_no_loss() -> None:
    scenes = [plant(1, 9, seed=6), plant(1, 5, outliers3d=2, seed=7)]
    near = [scene.near(0.1) for scene in scenes]
    pose = posed(*(torch.cat(parts) for parts in zip(*near, strict=True)), converged=[False, True])
    found = ChamferLoss()(Prediction(poses={"pnp": pose}), padded(scenes))["chamfer"]
    alone = ChamferLoss()(Prediction(poses={"pnp": posed(*near[1])}), scenes[1].batch())["chamfer"]
    assert found.isnan().tolist() == [True, False]
    np.testing.assert_allclose(found[1:], alone, rtol=1e-4)
