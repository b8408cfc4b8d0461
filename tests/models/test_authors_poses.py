"""The poses of converted weights are those of the released pipeline, written here from its formulas."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from authors_network import Released, checkpoint, plan
from planted import seen
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import nn

from bpnp import Batch, BPnPNet
from bpnp.arrays import Array
from bpnp.cli import main

DISTANCE = 4.0


@pytest.fixture(scope="module")
def reference() -> Released:
    """Weights that solve a planted task: both nets are one, and the 3D net sees (x, y) / distance, about the image."""
    torch.manual_seed(5)
    net = Released()
    for module in net.modules():
        if isinstance(module, nn.Conv1d):
            nn.init.normal_(module.weight, 0, (1.5 / module.weight.shape[1]) ** 0.5)
            nn.init.normal_(module.bias, 0, 0.1)
    state = net.FeatureExtractor2d.state_dict()
    first = state["conv_in.0.weight"] / DISTANCE
    state["conv_in.0.weight"] = torch.cat([first, torch.zeros_like(first[:, :1])], 1)
    net.FeatureExtractor3d.load_state_dict(state)
    nn.init.normal_(net.stn.fc3.weight, 0, 1e-4)  # the input transform is almost the identity
    nn.init.zeros_(net.stn.fc3.bias)
    return net.eval()


def planted(size: int, seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    points3d = rng.uniform(-1, 1, (size, 3)) * [1, 1, 0.4]
    rotation = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
    image = seen(points3d, rotation, [*rng.normal(0, 0.03, 2), DISTANCE])
    return image + rng.normal(0, 5e-4, (size, 2)), points3d


def released_poses(assignment: Array, points2d: Array, points3d: Array) -> tuple[Array, Array]:
    """Camera matrices [R | t]: P3P-RANSAC of the 1.5 min(m, n) best pairs, and from it the least of the objective
    sum_ij P_ij (1 - f_i . g(R p_j + t)) over all pairs, by quasi-Newton steps."""
    best = np.argsort(-assignment, axis=None)[: int(1.5 * min(assignment.shape))]
    i, j = np.unravel_index(best, assignment.shape)
    found, rotvec, translation, _ = cv2.solvePnPRansac(
        points3d[j], points2d[i], np.eye(3), None, iterationsCount=1000, reprojectionError=0.01, flags=cv2.SOLVEPNP_P3P
    )
    assert found
    start = np.concatenate([rotvec.ravel(), translation.ravel()])
    rays = np.column_stack([points2d, np.ones(len(points2d))])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)

    def objective(pose: Array) -> float:
        camera = Rotation.from_rotvec(pose[:3]).apply(points3d) + pose[3:]
        directions = camera / np.linalg.norm(camera, axis=-1, keepdims=True)
        return float((assignment * (1 - rays @ directions.T)).sum())

    end = minimize(objective, start, method="BFGS", options={"gtol": 1e-10}).x
    ransac, least = (np.column_stack([Rotation.from_rotvec(p[:3]).as_matrix(), p[3:]]) for p in (start, end))
    return ransac, least


@pytest.mark.slow
@pytest.mark.parametrize("ransac", ["opencv", "poselib"])
def test_poses_are_those_of_the_released_pipeline(reference: Released, tmp_path: Path, ransac: str) -> None:
    torch.save(checkpoint(reference), tmp_path / "x.pth.tar")
    out = tmp_path / "out.ckpt"
    main(["convert-weights", str(tmp_path / "x.pth.tar"), str(out), "--ransac", ransac])
    reference = Released()
    reference.load_state_dict(torch.load(tmp_path / "x.pth.tar", weights_only=False)["state_dict"])
    reference.double().eval()
    sets = [planted(size, seed) for seed, size in enumerate((40, 64, 25))]
    batch = Batch.from_arrays([p2 for p2, _ in sets], [p3 for _, p3 in sets])
    with torch.no_grad():
        prediction = BPnPNet.from_checkpoint(out).double()(batch)
    for k, (points2d, points3d) in enumerate(sets):
        size = len(points2d)
        with torch.no_grad():
            cost = reference(torch.tensor(points2d)[None], torch.tensor(points3d)[None])[0]
        assignment = plan(cost)
        np.testing.assert_allclose(prediction.assignment[k, :size, :size], assignment, rtol=1e-4, atol=1e-8)
        found = {
            name: np.column_stack([pose.rotation[k].numpy(), pose.translation[k].numpy()])
            for name, pose in prediction.poses.items()
        }
        expected, least = released_poses(assignment.numpy(), points2d, points3d)
        # PoseLib takes other samples than OpenCV: poses of the same few inliers, not the same pose.
        np.testing.assert_allclose(found["ransac"], expected, atol=1e-6 if ransac == "opencv" else 0.1)
        np.testing.assert_allclose(found["pnp"], least, atol=1e-5)
        assert np.abs(found["pnp"] - found["ransac"]).max() > 1e-3
