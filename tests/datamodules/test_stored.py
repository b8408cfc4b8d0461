"""Problems in a store: every problem comes back, small ones are left out, and what does not fit is refused."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from jsonargparse import ArgumentParser

from bpnp.datamodules import Problem, ProblemSource, StoredDataModule, write_problems
from bpnp.datamodules.store import Store, StoreError, open_store
from bpnp.datamodules.stored import PROBLEMS, StoredProblems, scene_rows, stored_problem


def sets(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """4 to 60 matches with clutter on both sides, shuffled; the x of both points of a problem are equal."""
    rng = np.random.default_rng(i)
    k, free2d, free3d = rng.integers(4, 60), rng.integers(0, 40), rng.integers(0, 40)
    values = rng.random(k)
    points2d = np.column_stack([np.r_[values, -1 - rng.random(free2d)], rng.random(k + free2d)])
    points3d = np.column_stack([np.r_[values, 2 + rng.random(free3d)], rng.random((k + free3d, 2))])
    order2d, order3d = rng.permutation(len(points2d)), rng.permutation(len(points3d))
    match = np.r_[np.argsort(order2d)[:k], np.full(free3d, -1)]
    return points2d[order2d], points3d[order3d], match[order3d]


def problems(count: int = 12) -> list[tuple[str, Problem]]:
    result = []
    for i in range(count):
        rng = np.random.default_rng(100 + i)
        pose = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
        points2d, points3d, match = sets(i)
        origin = rng.normal(size=3) if i % 2 else None
        problem = Problem.from_matches(f"scène {i % 3}/{i}", points2d, points3d, *pose, match, float(i + 1), origin)
        result.append((f"s{i % 3}", problem))
    return result


def test_a_store_without_problems_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"there are no problems to write into .*empty; give at least one"):
        write_problems(tmp_path / "empty", iter(()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("side", "width"), [("points2d", 3), ("points3d", 4), ("points3d", 2)])
def test_points_with_other_coordinates_are_not_written(tmp_path: Path, side: str, width: int) -> None:
    """Homogeneous coordinates, one after the other, would be read as other points."""
    _, problem = problems(1)[0]
    wrong = replace(problem, **{side: np.ones((len(getattr(problem, side)), width), np.float32)})
    with pytest.raises(StoreError, match=rf"`{side}` of scène 0/0 has the shape \(\d+, {width}\); \(k, {side[-2]}\)"):
        write_problems(tmp_path / "store", [("a", wrong)])
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def store(tmp_path: Path) -> Store:
    write_problems(tmp_path / "store", problems(), parameters={"clutter": 1.0})
    return open_store(tmp_path / "store", PROBLEMS)


def test_stored_problems_are_read_as_they_were_written(store: Store) -> None:
    assert {name: rows.tolist() for name, rows in scene_rows(store).items()} == {
        f"s{s}": list(range(s, 12, 3)) for s in range(3)
    }
    for i, (_, problem) in enumerate(problems()):
        back = stored_problem(store, i)
        assert (back.name, back.focal, back.matched) == (problem.name, problem.focal, problem.matched)
        for name in ("points2d", "points3d", "rotation", "translation"):
            np.testing.assert_array_equal(getattr(back, name), getattr(problem, name))
        np.testing.assert_array_equal(back.origin, np.zeros(3) if problem.origin is None else problem.origin)


WRONG = [
    (
        {"match3d": np.array([0.0, 1.5, -1.0, 2.0])},
        "`match3d` has the type .*float64 in problem 'a/1'; indices of 2D points are integers: use .astype",
    ),
    ({"match3d": np.array([0, 1, -1, 4])}, "`match3d` goes from -1 to 4 in problem 'a/1'; .* from -1 .none. to 3"),
    ({"match3d": np.arange(3)}, r"`match3d` has the shape \(3,\) in problem 'a/1', not \(4,\)"),
    ({"match3d": np.array([0, 1, 1, 2])}, "`match3d` of 'a/1' assigns one 2D point to two 3D points"),
    (
        {"points2d": np.full((4, 2), np.nan)},
        "`points2d` is .nan, nan. at point 0 of problem 'a/1'; all numbers must be finite",
    ),
    ({"translation": np.full(3, np.inf)}, "pose, focal length or origin of problem 'a/1' holds NaN or infinity"),
]


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_arrays_that_do_not_fit_are_named(change: dict[str, np.ndarray], message: str) -> None:
    points = np.ones((4, 3))
    arrays = {"points2d": points[:, :2], "points3d": points, "rotation": np.eye(3), "translation": np.zeros(3)}
    create = Problem.from_matches.__func__
    create = getattr(create, "__wrapped__", create)  # past the type checks of the tests, which users do not have
    with pytest.raises(ValueError, match=message):
        create(Problem, "a/1", **({"match3d": np.arange(4), "focal": 1.0} | arrays | change))


def test_problems_with_too_few_points_are_left_out(store: Store) -> None:
    with pytest.warns(UserWarning, match=r"skipped \d+ of 12 problems"):
        source = StoredProblems(store, np.arange(12), min_points=30)
    assert isinstance(source, ProblemSource)
    names = source.batch(torch.arange(len(source.rows)), 0).ids
    assert names == tuple(problem.name for _, problem in problems() if problem.matched >= 30)
    assert source.counts.matched.tolist() == [problem.matched for _, problem in problems() if problem.matched >= 30]
    with pytest.raises(StoreError, match="min_points"):
        StoredProblems(store, np.arange(12), min_points=100)


@pytest.mark.parametrize("num_workers", [0, 2])
def test_every_pair_is_served_once_and_the_same(store: Store, num_workers: int) -> None:
    options = {"test_fraction": 1.0, "eval_max_points": 20, "clutter": 0.5, "batch_size": 5}
    data = StoredDataModule(str(store.folder), num_workers=num_workers, **options)
    data.setup("test")
    served, state = {}, torch.get_rng_state()
    for batch in data.test_dataloader():
        for row, name in enumerate(batch.ids):
            served[name] = batch.points3d[row, batch.mask3d[row]]
    assert torch.equal(state, torch.get_rng_state())
    assert sorted(served) == sorted(problem.name for _, problem in problems())
    for i, (_, problem) in enumerate(problems()):
        alone = pickle.loads(pickle.dumps(data.datasets["test"])).problem(i)
        assert torch.equal(served[problem.name], alone.points3d[0])


@pytest.mark.parametrize("fresh", [True, False])
def test_options_reach_the_problems_of_their_part(store: Store, fresh: bool) -> None:
    """A training problem is another subset in each epoch if it is asked for, and those of other parts never."""
    scenes = {"train_scenes": ["s0"], "val_scenes": ["s1"], "test_scenes": ["s2"]}
    limits = {"max_points": 8, "eval_max_points": 6, "clutter": 1.0, "clutter_side": "3d"}
    data = StoredDataModule(str(store.folder), fresh_subsets=fresh, **scenes, **limits)
    data.setup()
    for part, most, scene in (("train", 8, 0), ("val", 6, 1), ("test", 6, 2), ("predict", 6, 2)):
        free = [len(problem.points3d) - problem.matched for _, problem in problems()][scene::3]
        for i in range(4):
            first, second = (data.datasets[part].problem(i, epoch) for epoch in (0, 1))
            (matches,) = (first.match3d >= 0).sum(-1).tolist()
            assert matches == min(most, problems()[scene + 3 * i][1].matched)
            assert (int(first.count2d), int(first.count3d)) == (matches, matches + min(free[i], matches))
            assert torch.equal(first.points3d, second.points3d) == (part != "train" or not fresh)


def test_a_number_in_a_list_of_scenes_is_refused(store: Store) -> None:
    """YAML reads [0015] as an octal number, which may be the name of another scene."""
    scenes = yaml.safe_load("[0015]")
    assert scenes == [13]
    with pytest.raises(ValueError, match="^`val_scenes` holds the number 13; give names in quotes, such as"):
        StoredDataModule(str(store.folder), val_scenes=scenes)
    parser = ArgumentParser()
    parser.add_class_arguments(StoredDataModule, "data")
    chosen = parser.parse_args(["--data.root=x", "--data.val_scenes=[0015]", '--data.test_scenes=["0015"]']).data
    assert (chosen.val_scenes, chosen.test_scenes) == ([13], ["0015"])


def test_a_store_of_anyones_pairs_is_split_by_scene(store: Store) -> None:
    data = StoredDataModule(str(store.folder), test_scenes=["s1"], val_scenes=["s2"])
    data.setup()
    assert {name for batch in data.test_dataloader() for name in batch.ids} == {f"scène 1/{i}" for i in range(1, 12, 3)}
