"""Functions and networks as a user's Python calls them: within contexts, from several threads, in workers."""

import copy
import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from planted import degrees_between, plant, seen
from planted_model import PINHOLE, plant_model
from scipy.spatial.transform import Rotation
from torch.utils.data import DataLoader, Dataset

import bpnp
from bpnp.examples import load
from bpnp.geometry import rotation_angle
from bpnp.layers import ransac_pnp
from bpnp.layers.ransac.consensus import BACKENDS
from bpnp.metrics import rotation_error

MESHES = [load("mesh", seed=seed) for seed in (0, 1)]
COUNT = 64  # points of a problem


def normalised(example: Any, count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """Return as many image points K^-1 x, and the scene points that they see."""
    pixels, camera = example.points2d, example.camera
    shown = (example.points3d @ example.rotation.T + example.translation) @ camera.T
    chosen = np.arange(count)
    order = np.linalg.norm((shown[chosen, :2] / shown[chosen, 2:])[:, None] - pixels, axis=-1).argmin(1)
    return (pixels[order] - camera[:2, 2]) / camera[[0, 1], [0, 1]], example.points3d[chosen]


@pytest.fixture(scope="module")
def net() -> bpnp.BPnPNet:
    return bpnp.BPnPNet.from_pretrained("procedural-so3")


@pytest.fixture(scope="module")
def batch() -> bpnp.Batch:
    points2d, points3d = zip(*map(normalised, MESHES), strict=True)
    return bpnp.Batch.from_arrays(points2d, points3d)


def check_poses(prediction: bpnp.Prediction, degrees: float = 2.0) -> None:
    """Every estimate of every problem is near the planted pose."""
    truth = torch.from_numpy(np.stack([example.rotation for example in MESHES]))
    for name in ("ransac", "pnp", "refined"):
        error = rotation_error(prediction.poses[name].rotation.double(), truth)
        assert (error < degrees).all(), (name, error)


@contextmanager
def default_type(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


@contextmanager
def errors_of_numpy() -> Iterator[None]:
    """Raise numpy's floating-point errors, and every warning."""
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


CONTEXTS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "inference_mode": torch.inference_mode,
    "no_grad": torch.no_grad,
    "grad": nullcontext,
    "autocast": partial(torch.autocast, "cpu", torch.bfloat16),
    "float64": partial(default_type, torch.float64),
    "bfloat16": partial(default_type, torch.bfloat16),
    "device": partial(torch.device, "meta"),
    "deterministic": deterministic,
    "errors_of_numpy": errors_of_numpy,
}


OF_A_THREAD = ("inference_mode", "no_grad", "grad", "autocast", "device", "errors_of_numpy")


@pytest.mark.parametrize(("name", "threads"), [(name, 0) for name in CONTEXTS] + [(name, 2) for name in OF_A_THREAD])
def test_a_network_works_within_a_context_from_any_thread(
    name: str, threads: int, net: bpnp.BPnPNet, batch: bpnp.Batch
) -> None:
    """Before, RANSAC wrote into an inference tensor from a worker thread, and the search failed under two others."""

    def run(_number: int) -> bpnp.Prediction:
        with CONTEXTS[name]():
            return net(batch)

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for prediction in pool.map(run, range(threads)) if threads else [run(0)]:
            check_poses(prediction)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("context", ["inference_mode", "no_grad", "grad", "autocast", "device"])
def test_each_ransac_works_within_a_context(backend: str, context: str) -> None:
    """Before, those of PoseLib and OpenCV failed in inference mode with two threads."""
    planted = plant(3, 40, noise=1e-3, seed=0)
    assignment = planted.permutation()
    with CONTEXTS[context]():
        rotation, _, stats = ransac_pnp(assignment, planted.points2d, planted.points3d, backend=backend)  # type: ignore[arg-type]
    assert torch.rad2deg(rotation_angle(rotation, planted.rotation)).max() < 1
    assert stats.converged.all()


def test_threads_change_no_solution() -> None:
    """Would have caught work that is divided by the number of threads and added up in another order."""
    leds, mesh = load("leds"), MESHES[0]
    answers = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        solutions = [
            bpnp.solve(leds.points2d, leds.points3d, leds.camera, normals3d=leds.normals3d, time_limit=None),
            bpnp.solve(mesh.points2d, mesh.points3d, mesh.camera, time_limit=None),
        ]
        answers.append([(s.rotation.tolist(), s.translation.tolist(), s.matches.tolist(), s.reason) for s in solutions])
    assert degrees_between(np.array(answers[0][0][0]), leds.rotation) < 3
    assert answers[0] == answers[1] == answers[2]


def test_threads_change_a_network_by_rounding_alone(net: bpnp.BPnPNet, batch: bpnp.Batch) -> None:
    """Would have caught a reduction whose parts depend on the number of threads; torch's own products round apart."""
    rotations = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        with torch.inference_mode():
            rotations.append(net(batch).poses["refined"].rotation)
    check_poses(net(batch))
    for other in rotations[1:]:
        torch.testing.assert_close(other, rotations[0], rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """Model of a map, the pixels of a new photo near its first view, and the photo's rotation."""
    folder = tmp_path_factory.mktemp("map")
    truth = plant_model(folder, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    rotation = Rotation.from_euler("xyz", [4, -6, 3], degrees=True).as_matrix() @ truth.rotations[0]
    pixels = 520 * seen(truth.points3d[truth.seen[0]], rotation, truth.translations[0]) + [400, 300]
    return folder, np.concatenate([pixels, truth.clutter_px[0]]), rotation


def test_four_threads_solve_verify_and_localize_at_once(photo: tuple[Path, np.ndarray, np.ndarray]) -> None:
    """Would have caught state that two searches share: caches of a scene, the limit on BLAS, loops being compiled."""
    folder, pixels, rotation = photo
    scene, mesh, leds = bpnp.SceneMap.from_colmap(folder), MESHES[0], load("leds")
    options = {"time_limit": None}
    calls: list[Callable[[], bpnp.Solution]] = [
        lambda: bpnp.solve(mesh.points2d, mesh.points3d, mesh.camera, **options),
        lambda: bpnp.solve(leds.points2d, leds.points3d, leds.camera, normals3d=leds.normals3d, **options),
        lambda: bpnp.verify(mesh.points2d, mesh.points3d, mesh.rotation, mesh.translation, mesh.camera),
        lambda: scene.localize(pixels, scene.views[0].camera, **options),
    ]
    alone = [call() for call in calls]
    for solution, true in zip(alone, (mesh.rotation, leds.rotation, mesh.rotation, rotation), strict=True):
        assert degrees_between(solution.rotation, true) < 3
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda call: call(), calls * 2))
    for solution, expected in zip(together, alone * 2, strict=True):
        assert np.array_equal(solution.rotation, expected.rotation)
        assert (solution.verdict, solution.reason) == (expected.verdict, expected.reason)


class Poses(Dataset[tuple[float, float]]):
    """Data set whose items are solved where they are read."""

    def __init__(self, net: bpnp.BPnPNet, batch: bpnp.Batch) -> None:
        self.net, self.batch = net, batch

    def __len__(self) -> int:
        return 2

    def __getitem__(self, number: int) -> tuple[float, float]:
        leds = load("leds", seed=number)
        solution = bpnp.solve(leds.points2d, leds.points3d, leds.camera, normals3d=leds.normals3d)
        with torch.inference_mode():
            check_poses(self.net(self.batch))
        return leds.rotation_error_deg(solution.rotation), float(solution.found)


@pytest.mark.parametrize("start", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
def test_a_worker_of_a_data_loader_solves(start: str, net: bpnp.BPnPNet, batch: bpnp.Batch) -> None:
    """Would have caught threads or locks that a fork inherits dead, and a network that cannot be sent to a process."""
    with torch.inference_mode():
        net(batch)  # the threads of this process exist before the fork
    data = Poses(copy.deepcopy(net), batch)
    loader = DataLoader(
        data, batch_size=None, num_workers=1, timeout=300, multiprocessing_context=multiprocessing.get_context(start)
    )
    for error, found in loader:
        assert found
        assert error < 3


@pytest.mark.parametrize("name", ["float64", "bfloat16", "device", "errors_of_numpy", "inference_mode"])
def test_solve_and_verify_keep_out_what_the_user_set(name: str) -> None:
    """Before, `numpy.seterr(all="raise")` ended a search at the first underflow."""
    mesh = MESHES[0]
    with CONTEXTS[name]():
        solution = bpnp.solve(mesh.points2d, mesh.points3d, mesh.camera)
        verified = bpnp.verify(mesh.points2d, mesh.points3d, solution.rotation, solution.translation, mesh.camera)
    assert mesh.rotation_error_deg(solution.rotation) < 1
    assert solution.verdict == verified.verdict == "confident"
