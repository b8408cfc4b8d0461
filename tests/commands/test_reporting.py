"""`bpnp report`, `view` and `wandb` on planted results."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from report_data import drawn_problem, rows, write_run

from bpnp.cli import main
from bpnp.commands.reporting import MOST_FOLDERS
from bpnp.report import intervals
from bpnp.report.intervals import _draw
from bpnp.report.points import thin, write_points


def test_report_and_view_write_the_files_that_they_print(
    tmp_path: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "run", 12, 0)
    page, recall = tmp_path / "report.html", tmp_path / "recall.png"
    main(["report", str(tmp_path / "run"), "--html", str(page), "--recall", str(recall)])
    shown = capsys.readouterr().out
    assert [line for line in shown.splitlines() if "wrote" in line] == [f"wrote {page}", f"wrote {recall}"]
    assert "Pose errors, 12 problems" in shown
    assert imread(recall).std() > 0.05
    main(["view", str(tmp_path / "run"), "script", "--lines", "assigned"])
    written = Path(capsys.readouterr().out.removeprefix("wrote ").rstrip("\n"))
    assert written.parent == tmp_path / "run" / "test" / "views"
    assert imread(written).std() > 0.05
    pictures = set()
    for more in ([], ["--lines", "assigned"], ["--estimate", "pnp"]):
        main(["view", str(tmp_path / "run"), "script", "--output", str(tmp_path / "view.png"), *more])
        pictures.add((tmp_path / "view.png").read_bytes())
    assert len(pictures) == 3
    capsys.readouterr()
    main(["report", str(tmp_path / "run"), "--paper", "megadepth"])
    assert "Lc Lp" in capsys.readouterr().out
    assert "'nothing' is in the names of no problem in" in fails("view", str(tmp_path / "run"), "nothing")
    (tmp_path / "run" / "test" / "points.npz").unlink()
    assert "has no points.npz; run `bpnp test` again" in fails("view", str(tmp_path / "run"))


def test_a_wrong_suffix_is_refused_before_anything_is_written(tmp_path: Path, fails: Callable[..., str]) -> None:
    write_run(tmp_path / "run", 9, 0)
    page = tmp_path / "report.html"
    said = fails("report", str(tmp_path / "run"), "--html", str(page), "--recall", str(tmp_path / "recall.bmp"))
    assert "the file name 'recall.bmp' has to end in .png, .jpg, .jpeg, .svg, .pdf" in said
    assert not page.exists()


def test_a_run_that_is_given_twice_is_shown_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "run", 9, 0)
    main(["report", str(tmp_path / "run")])
    once = capsys.readouterr().out
    main(["report", str(tmp_path / "run"), str(tmp_path / "run" / "test")])
    assert capsys.readouterr().out == once


def test_only_the_page_and_dashboards_need_plotly(
    tmp_path: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "run", 9, 0)
    monkeypatch.setitem(sys.modules, "plotly", None)  # as if it were not installed
    needed = "need plotly; install it with `pip install plotly`\n"
    outputs = [tmp_path / "report.html", tmp_path / "recall.png"]
    said = fails("report", str(tmp_path / "run"), "--html", str(outputs[0]), "--recall", str(outputs[1]))
    assert said.endswith(needed)
    assert fails("wandb", str(tmp_path / "run"), "--directory", str(tmp_path / "offline")).endswith(needed)
    assert not any(path.exists() for path in (*outputs, tmp_path / "offline"))
    main(["report", str(tmp_path / "run"), "--recall", str(outputs[1])])
    assert "Pose errors, 9 problems" in capsys.readouterr().out
    assert imread(outputs[1]).std() > 0.05


def test_a_large_tree_is_searched_only_if_the_user_wants_it(
    tmp_path: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "runs" / "z", 9, 0)
    main(["report", str(tmp_path / "runs")])
    assert "Pose errors, 9 problems" in capsys.readouterr().out
    for k in range(MOST_FOLDERS):
        (tmp_path / "runs" / f"{k}").mkdir()
    sentence = f"{tmp_path / 'runs'} is no run, and has more than {MOST_FOLDERS} folders; name the folders of the tests"
    assert fails("report", str(tmp_path / "runs")) == f"bpnp: error: {sentence}\n"
    main(["report", str(tmp_path / "runs" / "z")])  # a run is named
    capsys.readouterr()
    for stream in (sys.stdin, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr(sys.stdin, "readline", lambda: "\n")
    with pytest.raises(SystemExit) as stop:
        main(["report", str(tmp_path / "runs")])
    assert stop.value.code == 2
    question = f"{sentence.partition(';')[0]}.\nSearch all of them for results? [y/N] "
    assert capsys.readouterr().err == f"{question}bpnp: error: nothing was searched; name the folders of the tests\n"
    monkeypatch.setattr(sys.stdin, "readline", lambda: "y\n")
    main(["report", str(tmp_path / "runs")])
    assert "Pose errors, 9 problems" in capsys.readouterr().out


def test_a_printed_path_keeps_its_colons(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """rich replaces names such as :car: by pictures."""
    write_run(tmp_path / "run", 9, 0)
    main(["report", str(tmp_path / "run"), "--recall", str(tmp_path / "12:100:30.png")])
    assert f"wrote {tmp_path / '12:100:30.png'}\n" in capsys.readouterr().out


@pytest.mark.nightly
def test_a_reader_that_closes_the_pipe_is_no_error(tmp_path: Path) -> None:
    """The pipe is closed before the table is printed, as in `bpnp report RUN | true`."""
    write_run(tmp_path, 9, 0)
    process = subprocess.Popen(
        [sys.executable, "-m", "bpnp", "report", str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    process.stdout.close()
    _, error = process.communicate(timeout=120)
    assert error == ""
    assert process.returncode == 0


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="the system has no /dev/full")
def test_a_table_that_a_full_disk_does_not_take_is_one_clear_error(tmp_path: Path) -> None:
    write_run(tmp_path, 9, 0)
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "bpnp", "report", str(tmp_path)]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.stderr.splitlines()[0] == "bpnp: error: [Errno 28] No space left on device"
    assert "Traceback" not in ended.stderr
    assert ended.returncode == 2


def test_a_page_and_the_tables_of_the_terminal_share_their_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "run", 12, 0)
    drawn: list[int] = []

    def count(values: NDArray[np.float64], *rest: Any) -> tuple[float, NDArray[np.float64]]:
        drawn.append(len(values))
        return _draw(values, *rest)

    monkeypatch.setattr(intervals, "_draw", count)
    main(["report", str(tmp_path / "run"), "--groups"])
    alone = list(drawn)
    drawn.clear()
    main(["report", str(tmp_path / "run"), "--groups", "--html", str(tmp_path / "report.html")])
    assert drawn == alone


@pytest.mark.slow
def test_every_problem_of_a_test_can_be_viewed_by_name(tmp_path: Path, fails: Callable[..., str]) -> None:
    write_run(tmp_path, 9, 0)
    names = {row.index: row.id for row in rows(9, 0)}
    write_points(tmp_path / "test", [thin(drawn_problem(i, names[i])) for i in range(9)])
    main(["view", str(tmp_path), "scene/0004", "0007"])
    assert {path.name for path in (tmp_path / "test" / "views").iterdir()} == {"scene_0004.png", "scene_0007.png"}
    assert "give one of scene/000" in fails("view", str(tmp_path), "scene")
    (tmp_path / "test" / "points.npz").unlink()
    write_points(tmp_path / "test", [thin(drawn_problem(i, name)) for i, name in enumerate(("a/b", "a b", "größe"))])
    for name in ("a/b", "a b", "größe"):
        main(["view", str(tmp_path), name])
    written = {path.name for path in (tmp_path / "test" / "views").iterdir()}
    assert written >= {"a_b-0.png", "a_b-1.png", "größe.png"}
    several = ["view", str(tmp_path), "a/b", "a b", "--output", "x.png"]
    assert "--output takes one problem, and 2 are given" in fails(*several)
