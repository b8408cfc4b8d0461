from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from planted import posed, seen
from report_data import planted
from scipy.spatial.transform import Rotation

from bpnp.report.points import MOST, points_from, read_points, thin, write_points
from bpnp.types import Batch, Prediction


def answered(batch: Batch, degrees: float = 10.0) -> Prediction:
    """A pose that is `degrees` off about the viewing axis; the assignment says the true match where there is one."""
    assert batch.rotation is not None
    assert batch.translation is not None
    assert batch.match3d is not None
    turn = torch.from_numpy(Rotation.from_euler("z", degrees, degrees=True).as_matrix())
    rotation = turn @ batch.rotation.double()
    assignment = torch.zeros(len(batch), batch.points2d.shape[1], batch.points3d.shape[1])
    assignment.scatter_(1, batch.match3d.clamp(min=0)[:, None], 1.0)
    return Prediction(assignment, None, {"pnp": posed(rotation, batch.translation.double())})


@pytest.mark.parametrize("most", [MOST, 30, 7])
def test_a_view_keeps_true_matches_and_drops_padding(most: int) -> None:
    batch = planted((40, 25), clutter=5)
    for whole, size in zip(points_from(answered(batch), batch), (40, 25), strict=True):
        problem = thin(whole, most)
        assert len(problem.points2d) == len(problem.points3d) == min(size, most)
        assert problem.pose is not None
        rotation, translation = problem.pose
        kept = problem.match3d >= 0
        assert kept.sum() == min(size - 5, most)
        projected = seen(problem.points3d, rotation, translation)
        np.testing.assert_allclose(projected[kept], problem.points2d[problem.match3d[kept]], atol=1e-6)
        np.testing.assert_array_equal(problem.assigned3d[kept], problem.match3d[kept])
        assert problem.error == pytest.approx(10.0, abs=1e-6)


def test_views_are_read_as_they_were_written(tmp_path: Path) -> None:
    batch = planted((12, 9), clutter=2)
    problems = points_from(answered(batch), batch)
    problems = [*problems, replace(problems[0], index=7, id="<é\udcff. ", pose=None)]
    write_points(tmp_path, reversed(problems))
    assert [path.name for path in tmp_path.iterdir()] == ["points.npz"]
    read = read_points(tmp_path)
    assert read[2].pose is None
    assert (read[2].id, read[2].index) == ("<é\udcff. ", 7)
    for before, after in zip(problems, read, strict=True):
        for name in ("points2d", "points3d", "match3d", "assigned3d", "error"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        for name, pose in before.estimates.items():
            np.testing.assert_array_equal(np.c_[pose], np.c_[after.estimates[name]])
    assert read_points(tmp_path / "nowhere") == ()
    (tmp_path / "points.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"cannot read the points of a test in .*points.npz"):
        read_points(tmp_path)
    with pytest.raises(ValueError, match=r"some problems have other estimates than \['pnp'\]"):
        write_points(tmp_path, [problems[0], replace(problems[1], estimates={})])


def test_a_thinned_problem_keeps_the_numbers_of_its_points(tmp_path: Path) -> None:
    batch = planted((60, 12), clutter=4)
    whole = points_from(answered(batch), batch)
    write_points(tmp_path, [thin(whole[0], 24), whole[1]])
    few, all_points = read_points(tmp_path)
    assert len(few.points2d) == len(few.points3d) == 24
    ids2d, ids3d = few.numbers()
    np.testing.assert_array_equal(few.points2d, whole[0].points2d[ids2d])
    np.testing.assert_array_equal(few.points3d, whole[0].points3d[ids3d])
    np.testing.assert_array_equal(ids2d[few.match3d], whole[0].match3d[ids3d])
    assert all_points.numbers()[0].tolist() == list(range(12))


def test_the_first_of_two_results_of_one_problem_is_kept(tmp_path: Path) -> None:
    batch = planted((60,), clutter=4)
    whole = points_from(answered(batch), batch)
    write_points(tmp_path, [*whole, *(thin(problem, 24) for problem in whole)])
    assert [len(problem.points2d) for problem in read_points(tmp_path)] == [60]
