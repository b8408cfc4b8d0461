"""A few points of every pair: planted points survive the file and the page, and the page keeps to its room."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_data import rows, view, write_run
from rich.console import Console
from scipy.spatial.transform import Rotation

from bpnp.report import view_command, write_results
from bpnp.report.page_views import page_sketches
from bpnp.report.sketches import POINTS, Sketches, joined, read_sketches, sketches_of, write_sketches
from bpnp.report.views import PairView


def sketched(count: int, first: int = 0) -> tuple[list[PairView], Sketches]:
    """Views of 10 to 59 points, exactly projected by `ransac`; `pnp` has no pose."""
    views = [view(i, f"scene/{i:04d}", 10 + i % 50) for i in range(first, first + count)]
    return views, sketches_of(views)


def projected(points3d: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    camera = points3d @ rotation.T + translation
    return camera[:, :2] / camera[:, 2:]


def test_matches_survive_the_file(tmp_path: Path) -> None:
    views, sketches = sketched(60)
    write_sketches(tmp_path, sketches)
    found = read_sketches(tmp_path)
    assert found is not None
    for i, original in enumerate(views):
        drawn = found.view(i, original.id)
        size = min(len(original.points2d), POINTS)
        assert len(drawn.points2d) == len(drawn.points3d) == (drawn.match3d >= 0).sum() == size
        known = projected(drawn.points3d, *drawn.estimates["ransac"])
        np.testing.assert_allclose(known, drawn.points2d[drawn.match3d], atol=1e-5)
        assert np.isnan(drawn.estimates["pnp"][0]).all()
        assert drawn.error == original.error
    assert read_sketches(tmp_path / "elsewhere") is None
    (tmp_path / "sketches.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"expected sketches of a test in .*sketches.npz"):
        read_sketches(tmp_path)


def test_points_without_a_match_stay_without_one() -> None:
    planted = view(0, "a", 12)
    match = np.where(np.arange(12) % 3 == 0, planted.match3d, -1).astype(np.int32)
    sketch = sketches_of([PairView(**(vars(planted) | {"match3d": match}))])
    drawn = sketch.view(0, "a")
    assert (drawn.match3d >= 0).sum() == 4
    assert len(drawn.points2d) == len(drawn.points3d) == 12
    assert {tuple(p) for p in drawn.points2d} == {tuple(p) for p in planted.points2d}
    np.testing.assert_array_equal(drawn.points2d[:4], planted.points2d[::3])


def test_parts_join_in_the_order_of_the_data_set() -> None:
    (_, late), (_, early) = sketched(4, first=3), sketched(5)
    whole = joined([late, early])
    assert whole.index.tolist() == list(range(7))
    np.testing.assert_array_equal(whole.points2d, sketched(7)[1].points2d)


def unpacked(packed: dict[str, str]) -> np.ndarray:
    ((kind, text),) = packed.items()
    return np.frombuffer(base64.b64decode(text), f"<{kind}")


def test_the_page_has_the_points_and_poses_of_every_pair_while_there_is_room() -> None:
    views, sketches = sketched(40)
    places = {name: {i: 39 - i for i in range(40)} for name in ("a", "b")}
    runs, (group,) = page_sketches({"a": sketches, "b": sketches}, places, room=10**6)
    assert runs["a"]["all"]
    assert runs["b"]["group"] == 0
    assert unpacked(group["rows"]).tolist() == list(range(39, -1, -1))
    counts, boxes = unpacked(group["counts"]).reshape(-1, 3), unpacked(group["boxes"]).reshape(-1, 10)
    poses = runs["a"]["poses"]["ransac"]
    quaternions = unpacked(poses["rotation"]).reshape(-1, 4)
    steps = unpacked(group["points3d"]).reshape(-1, POINTS, 3)
    for k, original in enumerate(views):
        assert (counts[k] == min(len(original.points2d), POINTS)).all()
        points = boxes[k, 4:7] + steps[k, : counts[k, 1]] / 255 * boxes[k, 7:]
        nearest = np.linalg.norm(points[:, None] - original.points3d, axis=-1).min(1)
        assert nearest.max() <= np.linalg.norm(boxes[k, 7:]) / 255
        turn = Rotation.from_quat(quaternions[k]).inv() * Rotation.from_matrix(original.estimates["ransac"][0])
        assert turn.magnitude() < 1e-4
    assert not unpacked(runs["a"]["poses"]["pnp"]["rotation"]).any()


@pytest.mark.parametrize("room", [0, 5_000, 20_000])
def test_the_page_keeps_to_its_room_and_takes_the_worst_first(room: int) -> None:
    _, sketches = sketched(200)
    error = np.random.default_rng(0).random(200)
    planted: dict[str, Any] = vars(sketches) | {"error": error}
    runs, groups = page_sketches({"a": Sketches(**planted)}, {"a": {i: i for i in range(200)}}, room=room)
    kept = unpacked(groups[0]["rows"])
    assert len(json.dumps([runs, groups])) < room + 1500
    assert len(kept) >= room / 500
    assert not runs["a"]["all"]
    worst = np.argsort(-error)[: len(kept) - len(kept) // 2]
    assert set(worst) <= set(kept.tolist())


def test_every_pair_of_a_test_can_be_viewed_by_name(tmp_path: Path) -> None:
    write_run(tmp_path, 9, 0)
    names = {row.index: row.id for row in rows(9, 0)}
    write_sketches(tmp_path / "test", sketches_of([view(i, names[i]) for i in range(9)]))
    console = Console(quiet=True)
    view_command([str(tmp_path), "scene/0004", "0007"], console)
    assert {path.name for path in (tmp_path / "test" / "views").iterdir()} == {"scene_0004.png", "scene_0007.png"}
    with pytest.raises(ValueError, match="one pair kept in .*, got 'scene'; try one of scene/000"):
        view_command([str(tmp_path), "scene"], console)
    with pytest.raises(ValueError, match="expected one pair with --output, got 2"):
        view_command([str(tmp_path), "scene/0004", "0007", "--output", "x.png"], console)


def test_a_test_without_a_worst_view_shows_its_worst_sketch(tmp_path: Path) -> None:
    planted = rows(9, 0)
    write_results(tmp_path, planted)
    _, sketches = sketched(9)
    write_sketches(tmp_path, Sketches(**(vars(sketches) | {"error": np.eye(9)[4]})))
    view_command([str(tmp_path)], Console(quiet=True))
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["scene_0004.png"]
