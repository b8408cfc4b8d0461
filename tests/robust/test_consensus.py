from dataclasses import dataclass

import numpy as np
import poselib
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.robust import scoring
from bpnp.types import SolveStats

THRESHOLD = 0.01


@dataclass(frozen=True)
class Planted:
    points2d: NDArray[np.float64]
    points3d: NDArray[np.float64]
    weights: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    true: NDArray[np.bool_]

    def tensors(self, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
        arrays = (self.points2d, self.points3d, self.weights)
        x, p, w = (torch.as_tensor(a, dtype=dtype).unsqueeze(0) for a in arrays)
        return x, p, w

    def residuals(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of each pair in the image plane, infinite behind the camera."""
        camera = self.points3d @ rotation.T + translation
        distance = np.linalg.norm(camera[:, :2] / camera[:, 2:] - self.points2d, axis=-1)
        return np.where(camera[:, 2] > 0, distance, np.inf)


def planted(seed: int, *, pairs: int = 600, inliers: float = 0.3, noise: float = 0.0025, lead: float = 2.0) -> Planted:
    """Candidate pairs of 400 points: a share of true ones, the rest random, so that points repeat; weights favour the
    true pairs by `lead`."""
    rng = np.random.default_rng(seed)
    points3d = rng.uniform(-1, 1, (400, 3))
    rotation = Rotation.random(random_state=rng).as_matrix()
    translation = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(4, 6)])
    camera = points3d @ rotation.T + translation
    points2d = camera[:, :2] / camera[:, 2:] + rng.normal(0, noise, (400, 2))
    true = np.arange(pairs) < round(inliers * pairs)
    first = np.where(true, np.arange(pairs) % 400, rng.integers(0, 400, pairs))
    second = np.where(true, first, (first + rng.integers(1, 400, pairs)) % 400)
    order = rng.permutation(pairs)
    weights = np.exp(rng.standard_normal(pairs) + lead * true)
    return Planted(points2d[first[order]], points3d[second[order]], weights[order], rotation, translation, true[order])


def consensus(
    points2d: Tensor, points3d: Tensor, weights: Tensor, *, mask: Tensor | None = None, threshold: float = THRESHOLD,
    hypotheses: int = 2048, seed: int = 0,
) -> tuple[Tensor, Tensor, SolveStats]:  # fmt: skip
    """The consensus of pairs (b, k): an assignment of each 2D point to the 3D point of the same index."""
    return ransac_pnp(
        torch.diag_embed(weights), points2d, points3d, mask2d=mask, mask3d=mask, pairs_factor=1.0, backend="torch",
        threshold=threshold, max_iterations=hypotheses, seed=seed,
    )  # fmt: skip


def degrees(rotation: Tensor, problem: Planted) -> float:
    return float(torch.rad2deg(rotation_angle(rotation[0].double(), torch.as_tensor(problem.rotation))))


def from_poselib(problem: Planted) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    camera = {"model": "SIMPLE_PINHOLE", "width": 1000, "height": 1000, "params": [1000.0, 0.0, 0.0]}
    options = {"max_reproj_error": THRESHOLD * 1000}
    pose, _ = poselib.estimate_absolute_pose(problem.points2d * 1000, problem.points3d, camera, options, {})
    return pose.R, pose.t


@pytest.mark.parametrize(("inliers", "lead"), [(0.1, 2.0), (0.3, 2.0), (0.6, 2.0), (0.3, 0.0), (0.6, 0.0)])
def test_pose_and_score_are_poselibs(inliers: float, lead: float) -> None:
    for seed in range(3):
        problem = planted(seed, inliers=inliers, lead=lead)
        found, shift, _ = consensus(*problem.tensors())
        poses = (found[0].numpy(), shift[0].numpy()), from_poselib(problem)
        ours, theirs = (np.minimum(problem.residuals(*pose) ** 2, THRESHOLD**2).sum() for pose in poses)
        assert ours < theirs * 1.005
        assert rotation_angle(found[0], torch.as_tensor(poses[1][0])) < np.deg2rad(0.2)
        assert degrees(found, problem) < 1


def test_pose_is_the_cauchy_fit_to_its_inliers() -> None:
    problem = planted(3)
    found, translation, _ = consensus(*problem.tensors())
    start = found[0].numpy()
    residuals = problem.residuals(start, translation[0].numpy())
    inliers = residuals < THRESHOLD
    scale = 4 * np.median(residuals[inliers] ** 2)

    def error(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        rotation = Rotation.from_rotvec(parameters[:3]).as_matrix() @ start
        camera = problem.points3d[inliers] @ rotation.T + parameters[3:]
        distance2 = ((camera[:, :2] / camera[:, 2:] - problem.points2d[inliers]) ** 2).sum(-1)
        return np.sqrt(scale * np.log1p(distance2 / scale))

    optimum = least_squares(error, np.r_[0, 0, 0, translation[0].numpy()], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    # The scale comes from the pose before the fit, hence not to the last digit; the noise moves the pose by 1e-3.
    np.testing.assert_allclose(optimum[:3], 0, atol=2e-5)
    np.testing.assert_allclose(optimum[3:], translation[0].numpy(), atol=2e-4)


def test_a_few_heavy_true_pairs_are_found_with_few_hypotheses() -> None:
    for seed in range(5):
        problem = planted(seed, pairs=1000, inliers=0.05, lead=4.0)
        assert degrees(consensus(*problem.tensors(), hypotheses=128)[0], problem) < 1


def test_points_behind_the_camera_are_no_inliers() -> None:
    problem = planted(4, inliers=0.6)
    camera = problem.points3d @ problem.rotation.T + problem.translation
    behind = problem.true & (np.arange(600) % 2 == 0)
    camera[behind] *= -1
    points3d = (camera - problem.translation) @ problem.rotation
    x, _, w = problem.tensors()
    rotation, translation, stats = consensus(x, torch.as_tensor(points3d).unsqueeze(0), w)
    assert degrees(rotation, problem) < 1
    camera = points3d @ rotation[0].numpy().T + translation[0].numpy()
    distance = np.linalg.norm(camera[:, :2] / camera[:, 2:] - problem.points2d, axis=-1)
    assert (distance[behind] < THRESHOLD).any()
    np.testing.assert_allclose(stats.residual[0], distance[(distance < THRESHOLD) & ~behind].mean(), rtol=1e-9)


def test_neither_the_global_generator_nor_the_parts_nor_autocast_change_the_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = planted(8)
    x, p, w = problem.tensors(torch.float32)
    state = torch.random.get_rng_state()
    expected = consensus(x, p, w)[0]
    assert torch.equal(torch.random.get_rng_state(), state)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(consensus(x, p, w)[0], expected, atol=1e-6, rtol=0)
    monkeypatch.setattr(scoring, "CHUNK", 5000)
    torch.testing.assert_close(consensus(x, p, w)[0], expected, atol=1e-6, rtol=0)


def test_no_gradient_and_no_step_that_reads_the_data() -> None:
    x, p, w = planted(9).tensors()
    assert not consensus(x.requires_grad_(), p, w.requires_grad_())[0].requires_grad
    with FakeTensorMode():  # tensors without values: a read raises
        assert consensus(torch.zeros(2, 50, 2), torch.zeros(2, 50, 3), torch.ones(2, 50))[0].shape == (2, 3, 3)
