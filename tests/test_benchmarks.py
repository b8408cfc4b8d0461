"""The baselines of the benchmarks must be right, or a ratio to them says nothing; and the commands must run."""

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp import SceneMap
from bpnp.cameras import camera_from
from bpnp.geometry import bearings, project, rotation_angle, transform
from bpnp.layers import ransac_pnp, sinkhorn, weighted_pnp
from bpnp.maps.views import View

FOLDER = Path(__file__).parents[1] / "benchmarks"
MODULES = (
    "bench_constellation", "bench_layers", "bench_scaling", "descriptor_poses", "exact", "gpu", "layer_rows",
    "paper_layers", "problems", "rebuilt_maps", "steps", "timing",
)  # fmt: skip


@pytest.fixture(scope="module")
def bench() -> Iterator[SimpleNamespace]:
    """The scripts' modules, which import each other as they do when one of them is run."""
    sys.path.insert(0, str(FOLDER))
    threads = torch.get_num_threads()
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in MODULES})
    torch.set_num_threads(threads)
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def problem(bench: SimpleNamespace) -> SimpleNamespace:
    """40 points in float64: the plan at its optimum and the pose from which RANSAC starts the layer."""
    planted = bench.problems.planted(2, 40, kind="independent", level=0.9, seed=3)
    batch, cost = planted.batch.to(torch.float64), planted.cost.double()
    plan, _ = sinkhorn(cost, tolerance=1e-13)
    rotation, translation, _ = ransac_pnp(plan, batch.points2d, batch.points3d)
    start = torch.cat([roma.rotmat_to_rotvec(rotation), translation], -1)
    return SimpleNamespace(
        batch=batch, cost=cost, plan=plan, rays=bearings(batch.points2d), pose=(rotation, translation), start=start
    )  # fmt: skip


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("kind", ["smooth", "independent"])
def test_planted_points_are_seen_where_the_camera_sees_them(bench: SimpleNamespace, kind: str) -> None:
    batch = bench.problems.planted(3, 500, kind=kind, level=3.0).batch
    seen = project(transform(batch.rotation, batch.translation, batch.points3d))
    pixels = 800 * (seen - batch.points2d)
    assert abs(float(pixels.std()) - 2) < 0.1
    torch.testing.assert_close(batch.rotation.mT @ batch.rotation, torch.eye(3).expand(3, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(batch.rotation), torch.ones(3))


def test_the_level_sets_the_sharpness(bench: SimpleNamespace) -> None:
    def mass(**options: object) -> float:
        return bench.problems.diagonal_mass(sinkhorn(bench.problems.planted(2, 200, **options).cost)[0])

    assert mass(kind="smooth", level=1.0) < mass(kind="smooth", level=3.0) < mass(kind="smooth", level=10.0)
    assert mass(kind="independent", level=0.02) > 0.999
    assert mass(kind="independent", level=0.02, clutter=0.2) == pytest.approx(0.8, abs=0.02)


def test_paper_sinkhorn_has_the_optimum_and_its_gradient(bench: SimpleNamespace, problem: SimpleNamespace) -> None:
    plan = bench.paper_layers.sinkhorn_forward(problem.cost, iterations=10_000, tolerance=1e-15)
    torch.testing.assert_close(plan, problem.plan, atol=1e-13, rtol=0)
    incoming, direction, step = noise(*plan.shape), noise(*plan.shape, seed=1), 1e-6
    moved = [sinkhorn(problem.cost + sign * step * direction, tolerance=1e-13)[0] for sign in (1, -1)]
    slope = float(((moved[0] - moved[1]) * incoming).sum() / (2 * step))
    for gradient in (
        bench.paper_layers.sinkhorn_backward(plan, incoming),
        bench.exact.plan_gradient(plan, incoming, 0.1),
    ):
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-6)


def test_block_inverse_without_a_factor_is_no_number(bench: SimpleNamespace) -> None:
    plan = torch.eye(4).unsqueeze(0) / 4
    assert bench.paper_layers.sinkhorn_backward(plan, torch.ones(1, 4, 4)).isnan().any()


def test_exact_optimum_is_that_of_the_layer(bench: SimpleNamespace, problem: SimpleNamespace) -> None:
    optimum = bench.exact.pnp_optimum(problem.plan, problem.rays, problem.batch.points3d, problem.start)
    rotation, translation, stats = weighted_pnp(
        problem.plan, problem.rays, problem.batch.points3d, *problem.pose, tolerance=1e-11
    )
    assert stats.converged.all()
    assert rotation_angle(rotation, optimum.rotation).max() < 1e-8
    assert (translation - optimum.translation).abs().max() < 1e-7
    pose = bench.paper_layers.pnp_forward(problem.plan, problem.rays, problem.batch.points3d, problem.start)
    assert (pose - optimum.pose).abs().max() < 1e-5


def test_gradients_of_the_pose_agree(bench: SimpleNamespace, problem: SimpleNamespace) -> None:
    points3d, rays = problem.batch.points3d, problem.rays
    optimum = bench.exact.pnp_optimum(problem.plan, rays, points3d, problem.start)
    by_rotation, by_translation = noise(2, 3, 3), noise(2, 3, seed=1)
    exact = bench.exact.pnp_gradient(optimum, problem.plan, rays, points3d, by_rotation, by_translation)

    plan = problem.plan.clone().requires_grad_()
    rotation, translation, _ = weighted_pnp(plan, rays, points3d, *problem.pose)
    ours = torch.autograd.grad((rotation, translation), plan, (by_rotation, by_translation))[0]
    assert bench.exact.relative_error(ours, exact) < 1e-7

    pose = optimum.pose.clone().requires_grad_()
    through = (roma.rotvec_to_rotmat(pose[:, :3]) * by_rotation).sum() + (pose[:, 3:] * by_translation).sum()
    (incoming,) = torch.autograd.grad(through, pose)
    papers = bench.paper_layers.pnp_backward(pose, problem.plan, rays, points3d, incoming)
    assert bench.exact.relative_error(papers, exact) < 1e-9


def test_paper_ransac_finds_the_pose(bench: SimpleNamespace) -> None:
    problem = bench.problems.planted(2, 200, kind="smooth", level=10.0)
    plan = sinkhorn(problem.cost)[0]
    rotation, translation = bench.paper_layers.ransac(plan, problem.batch.points2d, problem.batch.points3d)
    assert torch.rad2deg(rotation_angle(rotation, problem.batch.rotation)).max() < 2
    assert (translation - problem.batch.translation).norm(dim=-1).max() < 0.1


@pytest.mark.parametrize("poses", [False, True])
def test_both_networks_learn_the_same(bench: SimpleNamespace, poses: bool) -> None:
    problem = bench.problems.planted(2, 40, kind="independent", level=0.9, seed=3)
    net, batch = bench.problems.planted_network(problem).double(), problem.batch.to(torch.float64)
    net.transport.tolerance = 1e-12
    gradients = []
    for losses in (bench.steps.training_losses, bench.steps.paper_losses):
        net.zero_grad()
        losses(net, batch, poses).mean().backward()
        gradients.append(torch.cat([p.grad.flatten() for p in net.features2d.parameters()]))
    assert gradients[0].norm() > 0
    # The paper's layers stop at row sums that are right to 1e-9 and at a pose that is right to about 1e-6.
    assert (gradients[0] - gradients[1]).norm() < 1e-4 * gradients[0].norm()


def test_layers_command_writes_what_it_measured(bench: SimpleNamespace, tmp_path: Path) -> None:
    out = tmp_path / "new" / "result.json"
    bench.bench_layers.main(
        ["--points", "40", "--rounds", "1", "--batches", "2", "3", "--threads", "1", "--out", str(out)]
    )
    record = json.loads(out.read_text())
    assert record["machine"]["threads"] == 1
    assert record["size"] == {"points": 40, "rounds": 1, "batches": [2, 3]}
    assert {row["what"].split(" from")[0].split(",")[0] for row in record["rows"]} == {
        "PnP forward", "PnP backward", "Sinkhorn forward", "Sinkhorn backward", "training step"
    }  # fmt: skip
    underflown = [row["paper_figure"] for row in record["rows"] if "clutter" in row["inputs"]]
    assert underflown == ["100% NaN"]
    assert 0 < out.with_suffix(".png").stat().st_size < 100_000


def test_scaling_command_writes_what_it_measured(
    bench: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = bench.bench_scaling
    monkeypatch.setattr(here, "in_its_own_process", lambda points, *, poses, threads: here.measure(points, poses=poses))
    here.main(["--sizes", "40", "30", "--threads", "1", "--out", str(tmp_path / "scaling.json")])
    runs = json.loads((tmp_path / "scaling.json").read_text())["runs"]
    assert [(run["points"], run["poses"]) for run in runs] == [(30, False), (40, False), (30, True), (40, True)]
    assert [list(run["seconds"]) for run in runs[::2]] == [
        ["features, cost", "Sinkhorn", "backward"], list(here.STAGES)
    ]  # fmt: skip
    assert (tmp_path / "scaling.png").exists()


def test_scaling_measures_in_another_process_and_says_what_failed(bench: SimpleNamespace) -> None:
    run = bench.bench_scaling.in_its_own_process(20, poses=False, threads=1)
    assert run.points == 20
    assert run.highest_gb > 0
    with pytest.raises(RuntimeError, match="expected a run with 0 points, got"):
        bench.bench_scaling.in_its_own_process(0, poses=False, threads=1)


def test_scaling_leaves_out_what_does_not_fit(bench: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    here, messages = bench.bench_scaling, []
    monkeypatch.setattr(here, "free_gigabytes", lambda: 10.0)
    monkeypatch.setattr(
        here, "in_its_own_process", lambda points, *, poses, threads: here.Run(points, poses, peak_gb={"backward": 3.0})
    )
    runs = here.all_runs([100, 150, 400, 500], 1, SimpleNamespace(print=messages.append))
    assert [run.points for run in runs] == [100, 150, 100, 150]
    assert sum("left out" in message for message in messages) == 4


def test_gpu_command_needs_a_gpu(
    bench: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as stopped:
        bench.gpu.main([])
    assert stopped.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("mode", ["float32", "bf16"])
def test_gpu_step_learns(bench: SimpleNamespace, mode: str) -> None:
    problem = bench.problems.planted(2, 30, kind="smooth", level=10.0)
    net = bench.problems.planted_network(problem, autocast=torch.bfloat16 if mode == "bf16" else None)
    before = net.features3d.inner.blocks[3].linear_a.weight.clone()
    bench.steps.training_step(net, problem.batch, poses=True)()
    change = net.features3d.inner.blocks[3].linear_a.weight - before
    assert change.isfinite().all()
    assert 0 < float(change.detach().abs().max()) < 2e-5


def test_spread_is_median_and_quartiles(bench: SimpleNamespace) -> None:
    assert bench.timing.Spread.of([5.0, 1.0, 3.0, 2.0, 4.0]) == bench.timing.Spread(median=3.0, low=2.0, high=4.0)


def test_constellation_command_writes_what_it_measured(bench: SimpleNamespace, tmp_path: Path) -> None:
    out = tmp_path / "constellation.json"
    only = ["--frames", "2", "--peers", "1", "--only", "headset, 3 lights", "Ransac: marker", "craters", "6 x 6"]
    bench.bench_constellation.main([*only, "--out", str(out)])
    rows = json.loads(out.read_text())["rows"]
    names = {"headset, 3 lights", "craters", "noise 6 x 6", "RandomRansac: marker, all seen"}
    assert names <= {row["name"] for row in rows}
    assert all(row["wrong"] == 0 for row in rows if not row["name"].startswith("RandomRansac"))
    assert 0 < out.with_suffix(".png").stat().st_size < 200_000


def test_models_of_the_same_views_are_aligned(bench: SimpleNamespace) -> None:
    """Another frame and unit, and views that only one of the models has."""
    rng, lens, seen = np.random.default_rng(0), camera_from(np.eye(3)), np.arange(4, dtype=np.int32)
    turn = Rotation.random(random_state=9).as_matrix()
    views = [
        View(str(k), lens, Rotation.random(random_state=k).as_matrix(), rng.normal(size=3), seen) for k in range(6)
    ]
    moved = [
        replace(v, rotation=v.rotation @ turn.T, translation=-v.rotation @ turn.T @ (0.3 * turn @ v.centre + [1, 2, 3]))
        for v in views
    ]
    here, there = (SceneMap(np.zeros((4, 3)), np.arange(4), seen, tuple(v)) for v in (views[:5], moved[1:]))
    found = bench.rebuilt_maps.aligned(here, there)
    rotation, centre = found.pose(views[0].rotation, views[0].translation)
    np.testing.assert_allclose(rotation, moved[0].rotation, atol=1e-12)
    np.testing.assert_allclose(centre, moved[0].centre, atol=1e-12)


def test_descriptors_are_matched_to_points_seen_from_several_views(bench: SimpleNamespace) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 64))
    seen = np.concatenate([points + 0.1 * rng.normal(size=points.shape) for _ in range(3)])
    photo = np.concatenate([points[:100] + 0.1 * rng.normal(size=(100, 64)), rng.normal(size=(500, 64))])
    theirs, own = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (seen, photo))
    keypoints, ids = bench.descriptor_poses.descriptor_matches(own, theirs, np.tile(np.arange(300) + 7, 3))
    true = keypoints < 100
    assert true.sum() == 100
    np.testing.assert_array_equal(ids[true], keypoints[true] + 7)
    assert (~true).sum() < 25
