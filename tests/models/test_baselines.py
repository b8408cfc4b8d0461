"""The baselines as solvers of batches."""

import inspect
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import roma
import torch
from planted import padded, plant
from scipy.optimize import linear_sum_assignment
from small_data import small_net

from bpnp import Batch, BPnPNet
from bpnp.metrics import rotation_error, translation_error
from bpnp.models.baselines import GOPAC, GOSMA, Hungarian, RandomRansac, SoftPOSIT
from bpnp.models.baselines.blind_p3p import probability_of_true_triple
from bpnp.models.baselines.hungarian import hungarian
from bpnp.models.baselines.single_problem import SingleSolver, agreement
from bpnp.models.baselines.softposit import softposit
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.runtime import NEVER

QUICK: dict[str, SingleSolver] = {
    "softposit": SoftPOSIT(max_steps=25, time_limit=None),
    "random_ransac": RandomRansac(max_hypotheses=512, time_limit=None),
    "gosma": GOSMA(max_boxes=400, batch=64, time_limit=None),
    "gopac": GOPAC(max_boxes=400, time_limit=None, angle=0.05),
}
each_solver = pytest.mark.parametrize("name", QUICK)


@pytest.mark.slow
@each_solver
def test_a_pose_depends_neither_on_neighbours_nor_on_padding_nor_on_the_modules_history(name: str) -> None:
    small, large = plant(1, 12, seed=1), plant(1, 20, seed=2)
    together = replace(padded([large, small]), index=torch.tensor([5, 9]))
    alone = Batch.from_arrays(small.points2d, small.points3d, index=[9])
    of_two, of_one = QUICK[name](together).poses[name], QUICK[name](alone).poses[name]
    assert QUICK[name].estimates == (name,)
    torch.testing.assert_close(of_two.rotation[1], of_one.rotation[0], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(of_two.translation[1], of_one.translation[0], rtol=0, atol=0, equal_nan=True)
    assert of_two.stats.iterations[1] == of_one.stats.iterations[0]


@pytest.mark.parametrize("baseline", [GOPAC, GOSMA, Hungarian, RandomRansac, SoftPOSIT])
def test_the_reference_lists_what_differs_from_the_paper(baseline: type) -> None:
    """docs/measured.md and docs/paper.md refer to it."""
    assert re.search(r"^Differences from the paper[^:]*:\n\n- ", inspect.getdoc(baseline) or "", re.MULTILINE)


@each_solver
def test_a_limit_of_time_ends_in_an_unconverged_answer(name: str) -> None:
    solver = type(QUICK[name])
    with torch.inference_mode():
        pose = solver(time_limit=1e-6)(plant(1, 30).batch()).poses[name]
    assert not pose.stats.converged[0]
    with pytest.raises(ValueError, match="`time_limit` is .*; it must be above 0"):
        solver(time_limit=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(QUICK) - {"softposit"}))  # whose initial poses are in scene units
def test_unit_and_origin_of_the_scene_change_only_the_translation(name: str) -> None:
    problem = plant(1, 14, seed=4, dtype=torch.float64)
    scaled = 7 * problem.points3d + torch.tensor([30.0, -20.0, 50.0])
    first = QUICK[name](Batch.from_arrays(problem.points2d, problem.points3d)).poses[name]
    second = QUICK[name](Batch.from_arrays(problem.points2d, scaled)).poses[name]
    assert first.found.all()
    torch.testing.assert_close(first.rotation, second.rotation, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_softposit_scales_with_the_unit_of_the_scene_and_of_its_initial_poses() -> None:
    problem = plant(1, 25, seed=4, dtype=torch.float64)
    shift = torch.tensor([[0.1, -0.1, 0.2]], dtype=torch.float64)
    first = softposit(
        problem.points2d[0], problem.points3d[0], problem.rotation, problem.translation + shift, None, NEVER
    )
    second = softposit(
        problem.points2d[0], 7 * problem.points3d[0], problem.rotation, 7 * (problem.translation + shift), None, NEVER
    )
    assert first.accepted.all()
    assert second.accepted.all()
    torch.testing.assert_close(first.rotation, second.rotation, rtol=0, atol=1e-6)
    torch.testing.assert_close(7 * first.translation, second.translation, rtol=1e-6, atol=0)


def test_softposit_converges_from_ten_degrees_on_clean_data() -> None:
    turned, moved = [], []
    for seed in range(2):
        problem = plant(1, 25, seed=seed)
        angle = torch.nn.functional.normalize(torch.randn(20, 3).double(), dim=-1)
        amount = (2 * torch.rand(20, 1).double() - 1) * math.radians(10)
        shift = torch.nn.functional.normalize(torch.randn(20, 3).double(), dim=-1) * 0.5 * torch.rand(20, 1).double()
        starts = roma.rotvec_to_rotmat(amount * angle) @ problem.rotation, problem.translation + shift
        found = softposit(problem.points2d[0], problem.points3d[0], *starts, None, NEVER)
        turned.append(roma.rotmat_geodesic_distance(found.rotation, problem.rotation.expand(20, 3, 3)))
        moved.append((found.translation - problem.translation).norm(dim=-1))
        assert found.accepted.double().mean() >= 0.95
    solved = (torch.cat(turned) < math.radians(0.1)) & (torch.cat(moved) < 0.01)
    assert solved.double().mean() >= 0.95


def test_softposit_starts_within_the_stated_angle_of_the_truth() -> None:
    problem = plant(30, 5)
    batch = problem.batch()
    pose = SoftPOSIT(start="near_truth", max_steps=0)(batch).poses["softposit"]
    degrees = rotation_error(pose.rotation, batch.rotation)
    away = translation_error(pose.translation, batch.translation)
    assert 8 < degrees.max() <= 10.001
    assert 0.4 < away.max() <= 0.501
    with pytest.raises(ValueError, match="`start` near_truth needs the true poses"):
        SoftPOSIT(start="near_truth")(Batch.from_arrays(problem.points2d, problem.points3d))


def test_random_poses_of_softposit_put_the_middle_of_the_scene_at_that_of_the_image() -> None:
    """Before any step, the best of many poses has more points in place than a single one."""
    problem = plant(1, 40, seed=3)
    image, scene = problem.points2d[0], problem.points3d[0]
    found = []
    for starts, seed in ((1, 0), (1, 1), (256, 0)):
        solver = SoftPOSIT(start="random", starts=starts, seed=seed, max_steps=0, time_limit=None)
        pose = solver(problem.batch()).poses["softposit"]
        camera = scene.mean(0) @ pose.rotation[0].double().mT + pose.translation[0].double()
        torch.testing.assert_close(camera[:2] / camera[2], image.mean(0), atol=1e-5, rtol=0)
        found.append(pose)
    assert not torch.equal(found[0].rotation, found[1].rotation)
    placed = [int(agreement(image, scene, one.rotation, one.translation, threshold=0.01).sum()) for one in found]
    assert placed[2] > max(placed[:2])


@pytest.mark.parametrize(
    ("solver", "options", "message"),
    [
        (RandomRansac, {"time_limit": None}, "`time_limit` and `max_hypotheses` are both None"),
        (RandomRansac, {"confidence": 0.0}, r"`threshold` is 0.01 and `confidence` 0.0; both must be above 0"),
        (Hungarian, {"checkpoint": "x.ckpt", "net": BPnPNet()}, "`checkpoint` and `net` are both given"),
    ],
)
def test_meaningless_options_of_a_baseline_are_named(solver: type, options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solver(**options)


def test_blind_ransac_reaches_its_predicted_success_rate() -> None:
    points, hypotheses, problems = 6, 120, 150
    batch = plant(problems, points, seed=5).batch()
    solver = RandomRansac(threshold=1e-4, confidence=1.0, max_hypotheses=hypotheses, time_limit=None)
    pose = solver(batch).poses["random_ransac"]
    solved = (rotation_error(pose.rotation, batch.rotation) < 0.1).double().mean()
    triple = probability_of_true_triple(points, points, points)
    assert triple == pytest.approx(1 / (6 * 5 * 4))
    predicted = 1 - (1 - triple) ** hypotheses
    assert float(solved) == pytest.approx(predicted, abs=3 * math.sqrt(predicted * (1 - predicted) / problems))


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
def test_blind_ransac_stops_when_a_true_triple_has_been_drawn_with_its_confidence(confidence: float) -> None:
    """Of 12 true matches; the triples are drawn 256 at a time."""
    problem = plant(1, 12, seed=1).batch()
    pose = RandomRansac(threshold=1e-4, confidence=confidence, time_limit=None, max_hypotheses=50_000)(problem)
    needed = math.log(1 - confidence) / math.log(1 - 1 / (12 * 11 * 10))
    stats = pose.poses["random_ransac"].stats
    assert int(stats.iterations) == 256 * math.ceil(needed / 256)
    assert stats.converged.all()
    assert float(stats.residual) == 0


def test_blind_ransac_counts_points_within_its_threshold_and_has_other_triples_with_another_seed() -> None:
    problem = plant(1, 12, seed=1, noise=0.003).batch()
    options = {"confidence": 1.0, "max_hypotheses": 2048, "time_limit": None}
    narrow, wide, other = (
        RandomRansac(**options, **more)(problem).poses["random_ransac"]
        for more in ({"threshold": 0.005}, {"threshold": 0.05}, {"threshold": 0.05, "seed": 1})
    )
    assert float(wide.stats.residual) < float(narrow.stats.residual)
    assert not torch.equal(wide.rotation, other.rotation)


def test_hungarian_is_the_assignment_of_least_cost_among_real_points() -> None:
    first, second = plant(1, 9, seed=1), plant(1, 6, seed=2, outliers3d=5)
    cost = torch.rand(2, 9, 11)
    assignment = hungarian(cost, padded([first, second]))
    for i, (m, n) in enumerate(((9, 9), (6, 11))):
        rows, columns = linear_sum_assignment(cost[i, :m, :n].numpy())
        chosen = cost[i, :m, :n].numpy()[rows, columns].sum()
        found = assignment[i] > 0
        assert int(found.sum()) == min(m, n)
        assert not found[m:].any()
        assert not found[:, n:].any()
        assert float(cost[i][found].sum()) == pytest.approx(chosen, rel=1e-6)
    torch.testing.assert_close(assignment.sum((1, 2)), torch.ones(2))


def test_hungarian_pairs_lead_to_the_planted_pose() -> None:
    class TrueCosts(BPnPNet):
        def cost(self, batch: Batch) -> torch.Tensor:
            assert batch.match3d is not None
            return 1 - (torch.arange(batch.points2d.shape[1])[:, None] == batch.match3d.unsqueeze(1)).to(batch.points2d)

    batch = plant(2, 40, seed=8).batch()
    net = TrueCosts(ImageFeatures(channels=16, depth=1), SceneFeatures(channels=16, depth=1))
    prediction = Hungarian(net=net)(batch)
    for name in Hungarian.estimates:
        assert prediction.poses[name].stats.converged.all()
        assert (rotation_error(prediction.poses[name].rotation, batch.rotation) < 1e-3).all()
    ransac = Hungarian(net=small_net(threshold=0.03), ransac_backend="opencv").ransac
    assert (ransac.backend, ransac.threshold, ransac.matches_factor) == ("opencv", 0.03, 1.0)
    with pytest.raises(FileNotFoundError):
        Hungarian(checkpoint="nothing.ckpt")


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "bpnp" / "configs" / "baselines").glob("*.yaml")), ids=lambda p: p.stem
)
def test_every_recipe_names_a_solver_and_its_settings(path: Path) -> None:
    from bpnp.training.comparison import parse_methods

    (method,) = parse_methods([str(path)])
    if "checkpoint" in method.init_args:
        with pytest.raises((ValueError, OSError), match="checkpoint"):
            method.build()
    else:
        assert isinstance(method.build(), SingleSolver)
