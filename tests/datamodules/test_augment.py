"""Augmentation: counts, bounds and distributions of the protocol; matches stay true; no leak between problems."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from planted import seen
from scipy import stats
from small_data import check_pairs

from bpnp.datamodules.augment import Augmentation, Outliers, augment
from bpnp.datamodules.keyed_random import row_keys
from bpnp.datamodules.problem import Problem, stack_problems
from bpnp.geometry import transform
from bpnp.types import Batch


def planted(count: int = 60, *, free2d: int = 0, free3d: int = 0, seed: int = 0) -> Problem:
    """A camera's problem without noise; outliers have coordinates above 50."""
    rng = np.random.default_rng(seed)
    points3d = rng.normal(size=(count, 3))
    rotation, translation = cv2.Rodrigues(rng.normal(size=3))[0], np.array([0.1, -0.2, 9.0])
    points2d = np.concatenate([seen(points3d, rotation, translation), 50 + rng.random((free2d, 2))])
    points3d = np.concatenate([points3d, 50 + rng.random((free3d, 3))])
    return Problem(f"p{seed}", np.float32(points2d), np.float32(points3d), count, rotation, translation, 800.0)


def raw(*problems: Problem) -> Batch:
    return stack_problems(problems, torch.arange(len(problems)))


def augmented(batch: Batch, *seeds: int, **options: Any) -> Batch:
    return augment(batch, Augmentation(**options), row_keys(batch.index, *(seeds or (0,))))


def matches_of(batch: Batch) -> torch.Tensor:
    return (batch.match3d >= 0).sum(-1)


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 2.5])
@pytest.mark.parametrize("side", ["both", "2d", "3d"])
def test_outliers_have_the_counts_and_the_box_of_the_protocol(ratio: float, side: str) -> None:
    problem = planted()
    result = augmented(raw(problem), outliers=Outliers(ratio=ratio, side=side))
    added = int(ratio * 60)
    assert int(result.count2d) == 60 + added * (side != "3d")
    assert int(result.count3d) == 60 + added * (side != "2d")
    assert int(matches_of(result)) == 60
    check_pairs(result)
    assert result.points2d[0].amin(0).tolist() == problem.points2d.min(0).tolist()
    assert result.points3d[0].amax(0).tolist() == problem.points3d.max(0).tolist()


def test_outliers_are_uniform_in_the_box_and_in_random_order() -> None:
    problem = planted(400)
    result = augmented(raw(problem), outliers=Outliers(ratio=5.0))
    false = result.match3d[0] < 0
    outliers = result.points3d[0, false].numpy()
    low, high = problem.points3d.min(0), problem.points3d.max(0)
    for axis in range(3):
        assert stats.kstest((outliers[:, axis] - low[axis]) / (high - low)[axis], "uniform").pvalue > 1e-3
    for positions in (false.nonzero()[:, 0], result.match3d[0, ~false]):
        assert stats.kstest(positions.numpy() / 2400, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("side", "left2d", "left3d"), [("2d", 45, 60), ("3d", 60, 45), ("both", 53, 52)])
def test_occlusion_leaves_points_without_a_match(side: str, left2d: int, left3d: int) -> None:
    batch = raw(planted(), planted(6, seed=1))
    result = augmented(batch, outliers=Outliers(occlusion=0.25, occluded_side=side))
    assert (int(result.count2d[0]), int(result.count3d[0])) == (left2d, left3d)
    assert matches_of(result).tolist() == [45, 4]
    check_pairs(result)
    assert matches_of(augmented(batch, outliers=Outliers(occlusion=0.9))).tolist() == [6, 4]


@pytest.mark.parametrize(
    ("clutter", "side", "extra2d", "extra3d"),
    [(0.25, "both", 5, 5), (0.25, "2d", 5, 0), (0.25, "3d", 0, 5), (2.0, "both", 12, 30), (0.0, "both", 0, 0)],
)
def test_subsets_and_clutter_have_the_requested_counts(clutter: float, side: str, extra2d: int, extra3d: int) -> None:
    batch = raw(planted(40, free2d=12, free3d=30))
    result = augmented(batch, max_points=20, clutter=clutter, clutter_side=side)
    assert (int(matches_of(result)), int(result.count2d), int(result.count3d)) == (20, 20 + extra2d, 20 + extra3d)
    check_pairs(result)
    assert int((result.points2d > 50).all(-1).sum()) == extra2d
    assert int((result.points3d > 50).all(-1).sum()) == extra3d
    assert len(result.points3d[0].unique(dim=0)) == 20 + extra3d
    whole = augmented(batch)
    assert (int(matches_of(whole)), int(whole.count2d), int(whole.count3d)) == (40, 52, 70)


def test_a_rotation_keeps_camera_coordinates_and_the_pose_in_the_scene() -> None:
    """camera = R (p + origin) + t - R origin is the same however the problem is turned."""
    batch = raw(planted(), planted(seed=1))
    batch.origin = torch.tensor([[5e5, -3e6, 40.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    straight, turned = augmented(batch), augmented(batch, rotate=True)
    check_pairs(turned)
    for before, after in ((straight, turned),):
        camera = (transform(b.rotation, b.translation, b.points3d.double()) for b in (before, after))
        torch.testing.assert_close(*camera, rtol=0, atol=1e-5)
        seen = ((b.rotation @ b.origin[..., None]) for b in (before, after))
        torch.testing.assert_close(*seen, rtol=1e-12, atol=0)
    assert (straight.rotation - turned.rotation).abs().amax((-2, -1)).min() > 0.1
    assert not torch.allclose(*(turned.rotation.mT @ straight.rotation))


def test_random_rotations_of_the_scene_are_uniform() -> None:
    """The entries of a uniform rotation have mean 0 and variance 1/3."""
    batch = raw(*(planted(6, seed=seed) for seed in range(200)))
    turns = augmented(batch, rotate=True).rotation.mT @ augmented(batch).rotation
    assert turns.mean(0).abs().max() < 4 * (1 / 3 / 200) ** 0.5


HARD: dict[str, Any] = {
    "max_points": 30, "clutter": 0.3, "rotate": True,
    "outliers": Outliers(ratio=(0.0, 1.0), side="random", occlusion=(0.0, 0.4), occluded_side="random"),
}  # fmt: skip


WRONG: list[tuple[type, dict[str, Any]]] = [
    (Outliers, {"ratio": -1.0}), (Outliers, {"ratio": np.nan}), (Outliers, {"ratio": (0.5, 0.2)}),
    (Outliers, {"ratio": (0.0, np.inf)}), (Outliers, {"occlusion": 1.0}), (Outliers, {"occlusion": (0.0, 1.0)}),
    (Augmentation, {"clutter": -0.1}), (Augmentation, {"clutter": np.nan}), (Augmentation, {"max_points": 3}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "bad"), WRONG)
def test_wrong_options_are_named(kind: type, bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        kind(**bad)


def test_a_problem_depends_on_its_key_and_not_on_its_batch() -> None:
    problems = [planted(20 + 30 * i, free2d=7 * i, free3d=40 - 9 * i, seed=i) for i in range(4)]
    together = augmented(raw(*problems), 5, **HARD)
    for i, problem in enumerate(problems):
        batch = raw(problem)
        alone = augmented(Batch(**(vars(batch) | {"index": torch.tensor([i])})), 5, **HARD)
        m, n = int(alone.count2d), int(alone.count3d)
        assert (int(together.count2d[i]), int(together.count3d[i])) == (m, n)
        assert torch.equal(together.points2d[i, :m], alone.points2d[0])
        assert torch.equal(together.points3d[i, :n], alone.points3d[0])
        assert torch.equal(together.match3d[i, :n], alone.match3d[0])
        assert torch.equal(together.rotation[i], alone.rotation[0])


@pytest.mark.parametrize(("valid", "name"), [(Outliers(), "side"), (Augmentation(), "clutter_side")])
def test_an_unknown_side_is_refused(valid: Any, name: str) -> None:
    object.__setattr__(valid, name, "2D")  # past the type checks of the tests, which users do not have
    with pytest.raises(ValueError, match=f'`{name}` is \'2D\'; it is one of "both", "2d"'):
        valid.__post_init__()
