from typing import Any

import numpy as np
import pytest
import torch

import bpnp
from bpnp import Batch, Pose, SolveStats
from bpnp.examples import load
from bpnp.types import Prediction


def pair(m: int, n: int, *, seed: int = 0, dtype: Any = np.float32) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "points2d": rng.normal(size=(m, 2)).astype(dtype),
        "points3d": rng.normal(size=(n, 3)).astype(dtype),
        "rotation": np.eye(3),
        "translation": rng.normal(size=3),
        "match3d": rng.integers(-1, m, n),
        "focal": 500.0 + seed,
    }


def lists(*pairs: dict[str, Any]) -> dict[str, Any]:
    return {name: [p[name] for p in pairs] for name in pairs[0]}


def test_lists_of_pairs_are_padded_and_masked() -> None:
    sizes = [(5, 7), (9, 2), (1, 1)]
    samples = [pair(m, n, seed=i) for i, (m, n) in enumerate(sizes)]
    one = Batch.from_arrays(**samples[0])
    assert (len(one), one.ids, one.focal.tolist()) == (1, ("0",), [500])
    np.testing.assert_allclose(one.translation, samples[0]["translation"][None], rtol=1e-6)
    batch = Batch.from_arrays(**lists(*samples), index=[4, 0, 9], ids=["a", "b", "c"])
    assert (batch.count2d.tolist(), batch.count3d.tolist()) == ([5, 9, 1], [7, 2, 1])
    assert (batch.points2d.shape, batch.points3d.shape) == ((3, 9, 2), (3, 7, 3))
    assert (batch.index.tolist(), batch.ids) == ([4, 0, 9], ("a", "b", "c"))
    assert Batch.from_arrays(**lists(*samples), index=[4, 0, 9]).ids == ("4", "0", "9")
    assert batch.match3d is not None
    for i, (m, n) in enumerate(sizes):
        assert batch.mask2d[i].tolist() == [True] * m + [False] * (9 - m)
        assert batch.mask3d[i].tolist() == [True] * n + [False] * (7 - n)
        assert np.array_equal(batch.points2d[i, :m].numpy(), samples[i]["points2d"])
        assert np.array_equal(batch.points3d[i, :n].numpy(), samples[i]["points3d"])
        assert np.array_equal(batch.match3d[i, :n].numpy(), samples[i]["match3d"])
        assert not batch.points2d[i, m:].any()
        assert not batch.points3d[i, n:].any()
        assert (batch.match3d[i, n:] == -1).all()


@pytest.mark.parametrize("points", [[[0.1, 0.2], [0.3, 0.4]], np.array([[0.1, 0.2], [0.3, 0.4]])[::-1],
                                    np.array([[0.1, 0.2], [0.3, 0.4]], ">f8"), [[1, 2], [3, 4]]])  # fmt: skip
def test_arrays_lists_and_tensors_give_the_same_batch(points: Any) -> None:
    batch = Batch.from_arrays(points, np.zeros((3, 3)))
    np.testing.assert_allclose(batch.points2d[0].numpy(), np.array(points, float))


def test_a_batch_copies_a_read_only_array() -> None:
    points2d = np.zeros((4, 2), np.float32)
    points2d.flags.writeable = False
    batch = Batch.from_arrays(points2d, np.zeros((4, 3)))
    batch.points2d.add_(1)
    assert not points2d.any()


def test_one_focal_length_is_used_for_all_problems() -> None:
    arrays = lists(pair(3, 4), pair(5, 5))
    assert Batch.from_arrays(**{**arrays, "focal": 800.0}).focal.tolist() == [800, 800]
    assert Batch.from_arrays(arrays["points2d"], arrays["points3d"]).focal.tolist() == [1, 1]


NAN = np.array([[0.0, 0.0], [np.nan, 1.0]])
WRONG = {
    r"`points2d` has the shape \(7, 3\) in problem 0, not \(k, 2\) \(are points2d and points3d swapped\?\)": {
        "points2d": np.zeros((7, 3)),
        "points3d": np.zeros((7, 2)),
    },
    r"`points3d` has the shape \(5, 4\) in problem 0, not \(k, 3\)": {"points3d": np.zeros((5, 4))},
    r"`points2d` is \[nan, 1.0\] at point 1 of problem 0; all numbers must be finite": {
        "points2d": NAN,
        "match3d": None,
    },
    r"`points3d` is \[inf.* all numbers must be finite": {"points3d": np.full((7, 3), np.inf)},
    r"`rotation` is .* all numbers must be finite": {"rotation": np.full((3, 3), np.nan)},
    r"`translation` is .* all numbers must be finite": {"translation": np.full(3, np.inf)},
    r"`points2d` has no points in problem 0; at least one is needed": {"points2d": np.zeros((0, 2))},
    r"`points3d` has no points in problem 0": {"points3d": np.zeros((0, 3))},
    r"`points2d` is empty; at least one problem is needed": {"points2d": np.zeros((0, 5, 2))},
    r"`points3d` has 2 problems, but `points2d` has 1": {"points3d": [np.zeros((7, 3))] * 2},
    r"`rotation` has 2 problems, but `points2d` has 1": {"rotation": np.zeros((2, 3, 3))},
    r"`focal` has 2 problems, but `points2d` has 1": {"focal": [1.0, 2.0]},
    r"`ids` has 2 problems, but `points2d` has 1": {"ids": ["a", "b"]},
    r"`index` has 2 problems, but `points2d` has 1": {"index": [1, 2]},
    r"`rotation` has the shape \(3, 4\) in problem 0, not \(3, 3\)": {"rotation": np.zeros((3, 4))},
    r"`translation` has the shape \(4,\) in problem 0, not \(3,\)": {"translation": np.zeros(4)},
    r"`match3d` has the shape \(5,\) in problem 0, not \(7,\), one index per 3D point": {"match3d": np.zeros(5, int)},
    r"`match3d` goes from 0 to 5 in problem 0; .* from -1 .none. to 4": {"match3d": np.array([0, 1, 2, 3, 4, 5, 0])},
    r"`match3d` goes from -2 to .* from -1 .none. to 4": {"match3d": np.array([0, 1, 2, 3, 4, -2, 0])},
    r"`points2d` .* problem 1": {
        "points2d": [np.zeros((5, 2)), np.zeros((5, 1))],
        "points3d": [np.zeros((7, 3))] * 2,
    },
    r"`points2d` is None; give an array of numbers, or a list of them": {"points2d": None},
    r"`points3d` is 'scene.ply'; give an array of numbers, or a list of them": {"points3d": "scene.ply"},
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_arrays_of_a_batch_are_named(message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Batch.from_arrays(**{**pair(5, 7), **WRONG[message]})


@pytest.mark.parametrize("match", [np.array([0.0, 1.7]), torch.tensor([0.0, 1.0]), [True, False]])
def test_match3d_is_never_rounded(match: Any) -> None:
    with pytest.raises(
        ValueError, match="`match3d` has the type .*in problem 0; indices of 2D points are integers: use .astype"
    ):
        Batch.from_arrays(np.zeros((2, 2)), np.zeros((2, 3)), match3d=match)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_a_dtype_leaves_masks_and_indices_alone(dtype: torch.dtype) -> None:
    batch = Batch.from_arrays(np.zeros((3000, 2)), np.zeros((3000, 3)), match3d=np.arange(3000), index=[70_001])
    moved = batch.to(dtype)
    assert moved.points2d.dtype == moved.points3d.dtype == moved.focal.dtype == dtype
    assert moved.mask2d.dtype == torch.bool
    assert moved.match3d is not None
    assert batch.match3d is not None
    assert torch.equal(moved.match3d, batch.match3d)
    assert moved.index.tolist() == [70_001]
    assert moved.ids == batch.ids
    assert moved.rotation is None


def test_a_batch_moves_and_pins_as_a_tensor_does() -> None:
    batch = Batch.from_arrays(**pair(3, 4))
    moved = batch.to("meta", non_blocking=True)
    tensors = [x for x in vars(moved).values() if isinstance(x, torch.Tensor)]
    assert {x.device.type for x in tensors} == {"meta"}
    assert len(tensors) == len([x for x in vars(batch).values() if isinstance(x, torch.Tensor)]) == 9
    if torch.cuda.is_available():
        assert batch.pin_memory().points2d.is_pinned()
    else:
        assert callable(batch.pin_memory)


def test_a_prediction_moves_with_its_poses() -> None:
    stats = SolveStats.of(torch.ones(2, dtype=torch.bool))
    rotation = torch.eye(3).repeat(2, 1, 1)
    rotation[1] = torch.nan
    pose = Pose(rotation, torch.zeros(2, 3), stats)
    assert pose.found.tolist() == [True, False]
    moved = Prediction(poses={"pnp": pose}).to(torch.float64)
    assert moved.poses["pnp"].rotation.dtype == moved.poses["pnp"].stats.residual.dtype == torch.float64
    assert moved.poses["pnp"].stats.iterations.dtype == torch.long
    assert moved.assignment is None


def test_pixels_are_refused_as_bpnp_solve_refuses_them() -> None:
    example = load("mesh")
    with pytest.raises(ValueError, match="look like pixels; try camera=K") as solving:
        bpnp.solve(example.points2d, example.points3d)
    with pytest.raises(ValueError, match="look like pixels; try .points2d - principal point") as batching:
        Batch.from_arrays(example.points2d, example.points3d)
    assert str(solving.value).partition(";")[0] == str(batching.value).partition(";")[0]
    focal, centre = example.camera[0, 0], example.camera[:2, 2]
    assert len(Batch.from_arrays((example.points2d - centre) / focal, example.points3d)) == 1


def test_a_batch_of_arrays_is_on_the_cpu_whatever_the_default_device() -> None:
    arrays = lists(pair(3, 4), pair(5, 5))
    with torch.device("meta"):
        batch = Batch.from_arrays(**arrays)
        unlabelled = Batch.from_arrays(arrays["points2d"], arrays["points3d"])
    for one in (batch, unlabelled):
        assert (one.count2d.tolist(), one.count3d.tolist(), one.index.tolist()) == ([3, 5], [4, 5], [0, 1])
    assert unlabelled.focal.tolist() == [1, 1]
