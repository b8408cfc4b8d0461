from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from report_data import planted
from scipy.spatial.transform import Rotation

from bpnp.report.samples import FEW, PairView, read_views, select_views, thin, views_from, write_views
from bpnp.types import Batch, Pose, Prediction, SolveStats


def answered(batch: Batch, degrees: float = 10.0) -> Prediction:
    """A pose that is `degrees` off about the viewing axis; the assignment says the true match where there is one."""
    assert batch.rotation is not None
    assert batch.translation is not None
    assert batch.match3d is not None
    turn = torch.from_numpy(Rotation.from_euler("z", degrees, degrees=True).as_matrix())
    stats = SolveStats(torch.ones(len(batch)).long(), torch.zeros(len(batch)), torch.ones(len(batch)).bool())
    rotation = turn @ batch.rotation.double()
    assignment = torch.zeros(len(batch), batch.points2d.shape[1], batch.points3d.shape[1])
    assignment.scatter_(1, batch.match3d.clamp(min=0)[:, None], 1.0)
    return Prediction(assignment, None, {"pnp": Pose(rotation, batch.translation.double(), stats)})


@pytest.mark.parametrize("most", [1000, 30, 7])
def test_a_view_keeps_true_matches_and_drops_padding(most: int) -> None:
    batch = planted((40, 25), clutter=5)
    for view, size in zip(views_from(answered(batch), batch, most_points=most), (40, 25), strict=True):
        assert len(view.points2d) == len(view.points3d) == min(size, most)
        assert view.pose is not None
        rotation, translation = view.pose
        camera = view.points3d @ rotation.T + translation
        kept = view.match3d >= 0
        assert kept.sum() == min(size - 5, most)
        np.testing.assert_allclose((camera[:, :2] / camera[:, 2:])[kept], view.points2d[view.match3d[kept]], atol=1e-6)
        np.testing.assert_array_equal(view.assigned3d[kept], view.match3d[kept])
        assert view.error == pytest.approx(10.0, abs=1e-6)


def test_a_pair_without_a_pose_is_the_worst() -> None:
    batch = planted((8, 8, 8), clutter=0)
    prediction = answered(batch)
    prediction.poses["pnp"].rotation[1] = torch.nan
    views = views_from(prediction, batch)
    assert [view.error for view in views] == pytest.approx([10.0, 180.0, 10.0])
    assert [view.index for view in select_views(views, worst=1, others=0)] == [1]


def plain(index: int, error: float) -> PairView:
    none = np.zeros((0,), np.int32)
    return PairView(index, str(index), np.zeros((1, 2)), np.zeros((1, 3)), none, none, error=error)


def test_choosing_in_parts_is_choosing_from_the_whole() -> None:
    rng = np.random.default_rng(0)
    views = [plain(i, error) for i, error in enumerate(rng.gamma(1, 10, 500).round(1).tolist())]
    whole = select_views(views, worst=5, others=9)
    worst = sorted(views, key=lambda view: (-view.error, view.index))[:5]
    assert {view.index for view in worst} <= {view.index for view in whole}
    for _ in range(3):
        kept: tuple[PairView, ...] = ()
        for part in np.array_split(rng.permutation(500), 7):
            kept = select_views([*kept, *(views[i] for i in part)], worst=5, others=9)
        assert [view.index for view in kept] == [view.index for view in whole]
    others = sorted({view.index for view in whole} - {view.index for view in worst})
    assert np.diff([0, *others, 500]).max() < 3 * 500 / 9
    with pytest.raises(ValueError, match="expected `worst` and `others` >= 0, got -1"):
        select_views(views, worst=-1)


def test_views_are_read_as_they_were_written(tmp_path: Path) -> None:
    batch = planted((12, 9), clutter=2)
    views = views_from(answered(batch), batch)
    views = [*views, replace(views[0], index=7, id="<é\udcff. ", pose=None)]
    write_views(tmp_path, reversed(views))
    assert [path.name for path in tmp_path.iterdir()] == ["points.npz"]
    read = read_views(tmp_path)
    assert read[2].pose is None
    assert (read[2].id, read[2].index) == ("<é\udcff. ", 7)
    for before, after in zip(views, read, strict=True):
        for name in ("points2d", "points3d", "match3d", "assigned3d", "error"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        for name, pose in before.estimates.items():
            np.testing.assert_array_equal(np.c_[pose], np.c_[after.estimates[name]])
    assert read_views(tmp_path / "nowhere") == ()
    (tmp_path / "points.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"expected points of a test in .*points.npz"):
        read_views(tmp_path)
    with pytest.raises(ValueError, match=r"expected views with the estimates \['pnp'\], got others"):
        write_views(tmp_path, [views[0], replace(views[1], estimates={})])


def test_without_poses_and_matches_the_points_are_kept(tmp_path: Path) -> None:
    batch = Batch.from_arrays(np.ones((2, 2)), np.ones((3, 3)), ids=["x"], index=[7])
    write_views(tmp_path, views_from(Prediction(), batch))
    (view,) = read_views(tmp_path)
    assert view.assigned3d.tolist() == view.match3d.tolist() == [-1] * 3
    assert (view.estimates, view.pose) == ({}, None)


def test_a_thinned_pair_knows_the_numbers_of_its_points(tmp_path: Path) -> None:
    batch = planted((60, 12), clutter=4)
    whole = views_from(answered(batch), batch)
    write_views(tmp_path, [thin(whole[0]), whole[1]])
    few, all_points = read_views(tmp_path)
    assert len(few.points2d) == len(few.points3d) == FEW
    ids2d, ids3d = few.numbers()
    np.testing.assert_array_equal(few.points2d, whole[0].points2d[ids2d])
    np.testing.assert_array_equal(few.points3d, whole[0].points3d[ids3d])
    np.testing.assert_array_equal(ids2d[few.match3d], whole[0].match3d[ids3d])
    assert all_points.numbers()[0].tolist() == list(range(12))


def test_of_a_pair_that_is_given_twice_the_first_is_kept(tmp_path: Path) -> None:
    batch = planted((60,), clutter=4)
    whole = views_from(answered(batch), batch)
    write_views(tmp_path, [*whole, *map(thin, whole)])
    assert [len(view.points2d) for view in read_views(tmp_path)] == [60]
