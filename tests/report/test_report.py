import csv
import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from planted import posed
from report_data import planted, row, rows
from scipy.spatial.transform import Rotation

from bpnp.metrics import PoseErrors
from bpnp.report import ProblemRow, read_results, write_results
from bpnp.report.results import cause_fractions, count_inliers, rows_from
from bpnp.types import Batch, Pose, Prediction, SolveStats

HOSTILE = [
    'a,b"c',
    "two\nlines",
    "cr\rhere",
    "crlf\r\n",
    "<script>alert(1)</script>",
    "[bold]x[/",
    "=1+1",
    "",
    " é\udcff ",
]


def pose_of(batch: Batch) -> Pose:
    assert batch.rotation is not None
    assert batch.translation is not None
    stats = SolveStats(torch.tensor([5, 9]), torch.tensor([1e-9, 0.5]), torch.tensor([True, False]))
    return Pose(batch.rotation.clone(), batch.translation.clone(), stats)


def test_rows_of_a_batch_have_its_counts_errors_and_stats() -> None:
    batch = planted((6, 4), clutter=1)
    refined = pose_of(batch)
    refined.rotation[1] = math.nan
    rows = rows_from(Prediction(poses={"pnp": pose_of(batch), "refined": refined}), batch, 3.0)
    assert [(r.index, r.id, r.estimate) for r in rows] == [
        (0, "problem 0", "pnp"),
        (1, "problem 1", "pnp"),
        (0, "problem 0", "refined"),
        (1, "problem 1", "refined"),
    ]
    assert [(r.m, r.n, r.matches, r.inliers, r.seconds) for r in rows[:2]] == [(6, 6, 5, 5, 1.5), (4, 4, 3, 3, 1.5)]
    assert [(r.iterations, r.residual, r.converged) for r in rows[:2]] == [
        (5, pytest.approx(1e-9), True),
        (9, 0.5, False),
    ]
    assert max(max(r.rotation_error_deg, r.translation_error, r.reprojection_error_deg) for r in rows[:3]) < 1e-6
    lost = rows[3]
    assert not lost.found
    assert (lost.rotation_error_deg, lost.reprojection_error_deg, lost.inliers) == (180, 180, 0)
    assert lost.translation_error == lost.centre_error == math.inf
    for r in rows:
        for field in dataclasses.fields(r):
            assert type(getattr(r, field.name)) is field.type


def test_inliers_are_those_of_a_brute_force_count() -> None:
    rng = np.random.default_rng(1)
    points2d, points3d = rng.uniform(-0.5, 0.5, (200, 2)), rng.uniform(-1, 1, (150, 3)) + [0, 0, 0.5]
    batch = Batch.from_arrays(points2d, points3d, np.eye(3), np.zeros(3))
    rotation = torch.from_numpy(Rotation.from_rotvec([[0.1, 0.2, 0.3]]).as_matrix())
    pose = posed(rotation, torch.tensor([[0.1, 0.0, 0.2]], dtype=torch.float64))
    camera = points3d @ rotation[0].numpy().T + [0.1, 0, 0.2]
    front = camera[camera[:, 2] > 0]
    distance = np.linalg.norm(points2d[:, None] - (front[:, :2] / front[:, 2:])[None], axis=-1)
    assert 0 < len(front) < 150
    for threshold in (0.01, 0.1):
        assert count_inliers(pose, batch, threshold=threshold) == [(distance.min(1) < threshold).sum()]
    behind = posed(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, -9.0]]).double())
    assert count_inliers(behind, batch) == [0]


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    rows = [row(i, id=name) for i, name in enumerate(HOSTILE)]
    lost = {"rotation_error_deg": 180.0, "translation_error": math.inf, "centre_error": math.inf}
    rows[1] = dataclasses.replace(rows[1], **lost, found=False, converged=False, residual=math.inf)
    settings = {"command": ["bpnp", "test"], "limit": math.inf, "path": Path("a/b"), "seed": 0, "nested": {"x": None}}
    written = write_results(tmp_path / "new" / "run", rows, correspondence_loss=-0.25, settings=settings)
    again = read_results(tmp_path / "new" / "run")
    assert again == written
    assert again.rows == tuple(rows)
    assert again.correspondence_loss == -0.25
    assert again.settings == settings | {"limit": "inf", "path": "a/b"}
    assert again.estimates["pnp"]["found"] == pytest.approx(8 / 9)
    assert sorted(path.name for path in (tmp_path / "new" / "run").iterdir()) == ["problems.csv", "summary.json"]


def test_the_files_are_plain_csv_and_strict_json(tmp_path: Path) -> None:
    rows = [row(0, id=HOSTILE[0]), row(1, translation_error=math.inf, reprojection_error_deg=math.nan)]
    write_results(tmp_path, rows)
    with (tmp_path / "problems.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert table[0]["id"] == HOSTILE[0]
    assert float(table[0]["rotation_error_deg"]) == rows[0].rotation_error_deg
    assert (table[1]["translation_error"], table[1]["reprojection_error_deg"]) == ("inf", "nan")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    summary = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert (summary["format"], summary["problems"], summary["correspondence_loss"]) == (2, 2, None)
    assert summary["estimates"]["pnp"]["translation_q3"] == "inf"
    assert summary["estimates"]["pnp"]["without_matches"] == 1
    assert read_results(tmp_path).estimates["pnp"]["translation_q3"] == math.inf


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows to write"),
        (
            [row(0), row(0, "ransac", id="other")],
            r"`Batch.index` 0 is used for two problems, \('problem 0', .* and \('other'",
        ),
        ([row(0), row(1), row(1, "ransac")], "an estimate is missing for some of the 2 problems: "),
    ],
)
def test_rows_that_are_no_complete_test_are_refused(tmp_path: Path, rows: list[ProblemRow], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_results(tmp_path, rows)
    assert list(tmp_path.iterdir()) == []


def _edit(name: str, old: str, new: str) -> Callable[[Path], object]:
    def edit(folder: Path) -> None:
        text = (folder / name).read_bytes()
        assert old.encode() in text
        (folder / name).write_bytes(text.replace(old.encode(), new.encode(), 1))

    return edit


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "problems.csv").unlink(), r"is no results folder: it has no problems\.csv"),
        (
            _edit("summary.json", '"format": 2', '"format": 1'),
            "summary.json is no summary of `bpnp test`: ValueError: format 1 in place of 2",
        ),
        (
            _edit("summary.json", '"problems": 3', '"problems": 4'),
            "problems.csv has 3 rows, but .*summary.json counts 4 x 1",
        ),
        (
            _edit("summary.json", '"settings"', '"things"'),
            "summary.json is no summary of `bpnp test`: TypeError: .*'(settings|things)'",  # missing or unknown
        ),
        (
            lambda folder: (folder / "summary.json").write_text('{"format": 2, '),
            r"summary\.json is no summary of `bpnp test`: JSONDecodeError",
        ),
        (lambda folder: (folder / "summary.json").write_text("[]"), "format None in place of 2"),
        (_edit("problems.csv", "inliers", "inlyers"), r"problems\.csv: .*'inliers'"),
        (_edit("problems.csv", "True", "maybe"), r"cannot read the rows of a test in .*problems\.csv: 'maybe'"),
        (_edit("problems.csv", ",10,12,", ",10,x,"), r"cannot read the rows of a test in .*problems\.csv: .*'x'"),
        (_edit("problems.csv", ",10,12,", ",10,"), r"problems\.csv: "),
        (lambda folder: (folder / "problems.csv").write_text(""), r"problems\.csv: No columns"),
        (
            lambda folder: (folder / "problems.csv").write_bytes(
                (folder / "problems.csv").read_bytes().split(b"\r\n")[0]
            ),
            r"problems\.csv has no rows",
        ),
    ],
)
def test_damaged_results_raise_one_clear_error(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    write_results(tmp_path, [row(i) for i in range(3)])
    damage(tmp_path)
    with pytest.raises(ValueError, match=message):
        read_results(tmp_path)


def test_results_give_their_errors_and_a_data_frame(tmp_path: Path) -> None:
    results = write_results(tmp_path, [row(i, e, rotation_error_deg=float(i)) for i in (2, 1, 9) for e in ("pnp", "a")])
    errors = results.errors("a")
    assert isinstance(errors, PoseErrors)
    assert errors.rotation_deg.tolist() == [1, 2, 9]
    frame = results.frame()
    assert frame.rotation_error_deg.tolist() == [r.rotation_error_deg for r in results.rows]
    assert frame[frame.cause == "solved"]["index"].tolist() == [1, 1, 2, 2]


def test_each_row_names_the_cause_of_its_failure() -> None:
    good = dataclasses.replace(
        rows(1, 0)[0], rotation_error_deg=1.0, converged=True, found=True, inliers=0, m=10
    )  # fmt: skip
    cases = {
        "solved": {"converged": False},
        "no pose": {"found": False, "rotation_error_deg": 180.0},
        "wrong, not converged": {"rotation_error_deg": 6.0, "converged": False, "inliers": 9},
        "wrong, but fits the image": {"rotation_error_deg": 6.0, "inliers": 5},
        "wrong": {"rotation_error_deg": 6.0, "inliers": 4},
    }
    planted = [dataclasses.replace(good, **changes) for changes in cases.values()]  # type: ignore[arg-type]
    assert [row.cause for row in planted] == list(cases)
    shares = cause_fractions([*planted, planted[0]])
    assert shares == {cause: (2 if cause == "solved" else 1) / 6 for cause in cases}
    with pytest.raises(ValueError, match="no rows to count"):
        cause_fractions([])


def test_rows_that_another_program_has_sorted_are_those_that_were_written(tmp_path: Path) -> None:
    """Estimates and runs are compared problem by problem, in the order of the data set."""
    written = write_results(tmp_path, [row(i, estimate) for i in range(9) for estimate in ("ransac", "pnp")])
    head, *lines = (tmp_path / "problems.csv").read_text().splitlines()
    (tmp_path / "problems.csv").write_text("\n".join([head, *sorted(lines, key=lambda line: line[::-1])]))
    assert read_results(tmp_path).rows == written.rows


def test_inliers_of_a_pose_with_a_gradient_are_those_without() -> None:
    batch = planted((12, 12), clutter=0)
    pose = pose_of(batch)
    with_gradient = dataclasses.replace(pose, rotation=pose.rotation.clone().requires_grad_())
    assert count_inliers(with_gradient, batch) == count_inliers(pose, batch) == [12, 12]
