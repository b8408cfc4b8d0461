"""The points of pairs on the page: planted points and poses survive, and the page keeps to its room."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest
from report_data import view
from scipy.spatial.transform import Rotation

from bpnp.report.page.points import VIEW_POINTS, page_points
from bpnp.report.samples import FEW, PairView, thin


def unpacked(packed: dict[str, str]) -> np.ndarray:
    ((kind, text),) = packed.items()
    return np.frombuffer(base64.b64decode(text), f"<{kind}")


def planted(count: int) -> list[PairView]:
    """Pairs of 10 to 59 points, exactly projected by `ransac`; `pnp` has no pose."""
    return [view(i, f"scene/{i:04d}", 10 + i % 50) for i in range(count)]


def test_the_page_has_the_points_and_poses_of_every_pair_while_there_is_room() -> None:
    views = planted(40)
    places = {name: {i: 39 - i for i in range(40)} for name in ("a", "b")}
    (group,) = page_points({"a": [thin(own) for own in views], "b": views}, places, room=10**6)
    assert sorted(group["poses"]) == ["a", "b"]
    assert unpacked(group["rows"]).tolist() == list(range(39, -1, -1))
    counts, boxes = unpacked(group["counts"]).reshape(-1, 3), unpacked(group["boxes"]).reshape(-1, 10)
    quaternions = unpacked(group["poses"]["a"]["ransac"]["rotation"]).reshape(-1, 4)
    steps2d, steps3d = (unpacked(group[f"points{d}d"]).reshape(-1, d) for d in (2, 3))
    numbers = unpacked(group["ids3d"])
    at = 0
    for k, original in enumerate(views):
        size = len(original.points2d)
        assert counts[k].tolist() == [size] * 3
        points2d = boxes[k, :2] + steps2d[at : at + size] / 65535 * boxes[k, 2:4]
        points3d = boxes[k, 4:7] + steps3d[at : at + size] / 65535 * boxes[k, 7:]
        np.testing.assert_allclose(points3d, original.points3d[numbers[at : at + size]], atol=1e-4)
        rotation, translation = original.estimates["ransac"]
        camera = points3d @ rotation.T + translation
        np.testing.assert_allclose(camera[:, :2] / camera[:, 2:], points2d, atol=1e-3)
        turn = Rotation.from_quat(quaternions[k]).inv() * Rotation.from_matrix(rotation)
        assert turn.magnitude() < 1e-4
        at += size
    assert not unpacked(group["poses"]["a"]["pnp"]["rotation"]).any()


def test_points_without_a_match_follow_and_assignments_are_those_of_the_solver() -> None:
    original = view(0, "a", 40)
    match = np.where(np.arange(40) % 4 == 0, original.match3d, -1).astype(np.int32)
    (group,) = page_points({"run": [replace(original, match3d=match)]}, {"run": {0: 5}}, room=10**6)
    assert unpacked(group["counts"]).tolist() == [40, 40, 10]
    ids2d, ids3d = unpacked(group["ids2d"]), unpacked(group["ids3d"])
    assert ids3d[:10].tolist() == ids2d[:10].tolist() == list(range(0, 40, 4))
    assigned = unpacked(group["assigned"]["run"]["5"])
    np.testing.assert_array_equal(ids2d[assigned], original.assigned3d[ids3d])


def test_large_pairs_are_thinned_and_other_points_make_another_group() -> None:
    large, other = view(0, "a", 500), view(3, "b", 500)
    groups = page_points({"x": [large], "y": [replace(other, index=0)]}, {"x": {0: 0}, "y": {0: 0}}, room=10**6)
    assert [unpacked(group["counts"])[0] for group in groups] == [VIEW_POINTS] * 2
    assert [list(group["poses"]) for group in groups] == [["x"], ["y"]]


@pytest.mark.parametrize("room", [0, 8_000, 30_000])
def test_the_page_keeps_to_its_room_and_takes_the_worst_first(room: int) -> None:
    error = np.random.default_rng(0).random(200)
    views = [thin(replace(own, error=float(error[own.index]))) for own in planted(200)]
    groups = page_points({"a": views}, {"a": {i: i for i in range(200)}}, room=room)
    kept = unpacked(groups[0]["rows"])
    assert len(json.dumps(groups)) < room + 1500
    assert len(kept) >= room / (30 * FEW)
    assert len(kept) < 200
    worst = np.argsort(-error)[: len(kept) - len(kept) // 2]
    assert set(worst) <= set(kept.tolist())
