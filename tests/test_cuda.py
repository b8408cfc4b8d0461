"""The layers, the network and a training on a GPU give what they give on the CPU; skipped where there is no GPU."""

from pathlib import Path

import pytest
import torch
from planted import Planted, degrees_between, plant
from small_data import MESHES, SMALL_NET
from torch import Tensor
from torch.nn.functional import normalize

from bpnp.cli import main
from bpnp.geometry import masked_median
from bpnp.layers import BackwardStats, ransac_pnp, sinkhorn, weighted_pnp
from bpnp.models import TrainedNet
from bpnp.report import read_results
from bpnp.training import BlindPnPTask

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")
GPU = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def relative(found: Tensor, expected: Tensor) -> float:
    """|found - expected| / |expected|."""
    return float((found.cpu().double() - expected.double()).norm() / expected.double().norm())


def costs(points: int, dtype: torch.dtype, *, smooth: bool) -> Tensor:
    """Distances between unit features: of waves over a plane, which neighbours share, or of independent points."""
    generator = torch.Generator().manual_seed(1)
    place = torch.randn(3, points, 2, generator=generator, dtype=dtype)
    turned = 4 * place @ torch.randn(2, 32, generator=generator, dtype=dtype)
    waves = torch.cat([turned.cos(), turned.sin()], -1)
    features = waves if smooth else torch.randn(3, points, 64, generator=generator, dtype=dtype)
    other = features + 0.3 * torch.randn(features.shape, generator=generator, dtype=dtype)
    return torch.cdist(normalize(features, dim=-1), normalize(other, dim=-1))


@pytest.mark.parametrize(("smooth", "mu"), [(True, 0.1), (True, 0.02), (False, 0.1)])
@pytest.mark.parametrize(("dtype", "plan_error", "gradient_error"), [
    (torch.float64, 1e-8, 1e-8), (torch.float32, 1e-4, 1e-4),
])  # fmt: skip
def test_sinkhorn(dtype: torch.dtype, plan_error: float, gradient_error: float, smooth: bool, mu: float) -> None:
    cost = costs(300, dtype, smooth=smooth)
    weights = torch.randn(cost.shape, generator=torch.Generator().manual_seed(2), dtype=dtype)
    stats = BackwardStats()

    def solve(device: str, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        leaf = cost.to(device, precision).requires_grad_()
        plan = sinkhorn(leaf, mu=mu, tolerance=1e-10 if dtype == torch.float64 else 1e-7, backward_stats=stats)[0]
        (gradient,) = torch.autograd.grad(plan, leaf, weights.to(leaf))
        return plan.detach(), gradient

    (plan, gradient), (expected, exact) = solve("cuda", dtype), solve("cpu", torch.float64)
    assert plan.is_cuda
    assert plan.dtype == gradient.dtype == dtype
    assert relative(plan, expected) < plan_error
    assert relative(gradient, exact) < gradient_error
    assert stats == BackwardStats(samples=6, unconverged=0)


@pytest.mark.parametrize("solver", ["newton", "lbfgs"])
def test_weighted_pnp(solver: str) -> None:
    planted = plant(3, 60, noise=1e-3, outliers2d=6, outliers3d=9)
    start = planted.near(0.05)

    def solve(device: str) -> tuple[Tensor, ...]:
        leaf = planted.diffuse(0.05).to(device).requires_grad_()
        inputs = (x.to(device) for x in (planted.bearings, planted.points3d, *start))
        rotation, translation, stats = weighted_pnp(leaf, *inputs, solver=solver, tolerance=1e-9)
        assert stats.converged.all()
        (gradient,) = torch.autograd.grad(rotation[:, 0].sum() + translation.square().sum(), leaf)
        return rotation.detach(), translation.detach(), gradient

    found, expected = solve("cuda"), solve("cpu")
    assert all(value.is_cuda for value in found)
    assert all(relative(*pair) < 1e-6 for pair in zip(found, expected, strict=True))


@pytest.mark.parametrize("backend", ["auto", "torch", "opencv", "poselib"])
def test_ransac_finds_the_planted_pose_twice(backend: str) -> None:
    planted = plant(4, 80, noise=1e-4, outliers2d=20, outliers3d=20)
    assignment = planted.diffuse(0.1)
    inputs = [x.to(GPU) for x in (assignment, planted.points2d, planted.points3d)]
    first, again = (ransac_pnp(*inputs, backend=backend, matches_factor=2.0) for _ in range(2))
    rotation, translation, stats = first
    assert rotation.is_cuda
    assert stats.converged.all()
    assert torch.equal(rotation, again[0])
    assert torch.equal(translation, again[1])
    for found, truth in zip(rotation.cpu(), planted.rotation, strict=True):
        assert degrees_between(found.numpy(), truth.numpy()) < 0.5
    assert relative(translation, planted.translation) < 0.01


def test_the_median_of_masked_values() -> None:
    values = torch.randn(7, 1001, generator=torch.Generator().manual_seed(3))
    mask = torch.rand(7, 1001, generator=torch.Generator().manual_seed(4)) < 0.3
    expected = values.masked_fill(~mask, torch.nan).nanmedian(-1).values
    assert torch.equal(masked_median(values.to(GPU), mask.to(GPU)).cpu(), expected)


@pytest.fixture(scope="module")
def views() -> Planted:
    """Views of 200 points with noise and outliers, as the packaged weights know them."""
    return plant(4, 200, noise=2 / 800, outliers2d=10, outliers3d=10, dtype=torch.float32)


def test_a_network_assigns_the_same_points(views: Planted) -> None:
    net = TrainedNet.from_checkpoint("paper-lclp").eval()
    with torch.no_grad():
        expected = net.match(views.batch()).assignment
        found = net.to(GPU).match(views.batch().to(GPU)).assignment
    assert found.is_cuda
    assert relative(found, expected) < 1e-3


def test_a_sample_does_not_depend_on_its_neighbours(views: Planted) -> None:
    net = TrainedNet.from_checkpoint("paper-lclp").eval().to(GPU)
    batch = views.batch().to(GPU)
    with torch.no_grad():
        together = net.match(batch).assignment
        singles = [Planted(*(value[i : i + 1] for value in vars(views).values())) for i in range(4)]
        alone = torch.cat([net.match(single.batch().to(GPU)).assignment for single in singles])
    assert relative(alone, together.cpu()) < 1e-4


@pytest.mark.parametrize("weight", [0.0, 1.0], ids=["L_c", "L_c + L_p"])
def test_a_step_has_the_gradient_of_the_cpu(views: Planted, weight: float) -> None:
    def gradient(device: str) -> dict[str, Tensor]:
        task = BlindPnPTask(weights="paper-lclp", pose_weight=weight).to(device)
        task.solver.ransac.backend = "poselib"  # the same initial pose
        batch = views.batch().to(device)
        losses = task.losses(task.solver(batch), batch)
        losses.total.backward()
        return {name: p.grad.detach() for name, p in task.named_parameters() if p.grad is not None}

    found, expected = gradient("cuda"), gradient("cpu")
    assert found.keys() == expected.keys()
    flat = [torch.cat([each[name].cpu().flatten() for name in expected]) for each in (found, expected)]
    assert relative(*flat) < 0.02


@pytest.mark.slow
def test_a_training_with_the_switch_is_tested_alike_on_both(tmp_path: Path) -> None:
    folder = [f"--trainer.default_root_dir={tmp_path}", f"--data.cache_dir={tmp_path}/cache"]
    options = [*MESHES, *SMALL_NET, *folder, "--data.num_workers=2"]
    main(["fit", *options, "--trainer.accelerator=gpu", "--trainer.max_epochs=3", "--pose_loss.start_epoch=1"])
    found = []
    for accelerator in ("cpu", "gpu"):
        results = tmp_path / accelerator
        where = [f"--trainer.accelerator={accelerator}", f"--results.folder={results}"]
        main(["test", *options, "--ckpt_path=last", *where])
        found.append(read_results(results))
    assert all({row.index for row in each.rows} == set(range(7)) for each in found)
    assert found[0].correspondence_loss == pytest.approx(found[1].correspondence_loss, rel=1e-4)
