"""A commit beside an older one: both run their own benchmark, in turns, and nothing is left behind."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import bench_search  # noqa: E402
from against import Row, checked_out, in_turns  # noqa: E402

sys.path.pop(0)

SCRIPT = """
import json, pathlib, sys
row = {row}
with open({log!r}, "a") as log: log.write(row["tree"] + " ")
pathlib.Path(sys.argv[sys.argv.index("--output") + 1]).write_text(json.dumps({{sys.argv[1]: row}}))
"""


def commit(root: Path, log: Path, tree: str, seconds: float, confident: float) -> None:
    row = {
        "tree": tree, "cpu_seconds_mean": seconds, "under_2_deg": 1.0, "recall_15_deg_0.5": 1.0,
        "confident": confident, "confident_over_5_deg": 0, "pairs": 10,
    }  # fmt: skip
    (root / "benchmarks").mkdir(exist_ok=True)
    (root / "benchmarks" / "bench_search.py").write_text(SCRIPT.format(row=json.dumps(row), log=str(log)))
    git(root, "add", ".")
    git(root, "-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", tree)


def git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", "-C", root, *arguments], check=True, capture_output=True, text=True).stdout


def test_both_trees_run_their_own_benchmark_in_turns(tmp_path: Path) -> None:
    root, log = tmp_path / "repository", tmp_path / "log"
    root.mkdir()
    git(root, "init", "-q")
    commit(root, log, "old", 2.0, 0.9)
    commit(root, log, "new", 0.5, 0.8)
    with checked_out("HEAD~1", root) as old:
        rows = in_turns(old, root, 2, "bench_search.py", "psb", into="--output")
    assert log.read_text().split() == ["old", "new", "old", "new"]
    by_name = {row.name: row for row in rows}
    assert by_name["psb: CPU s"] == Row("psb: CPU s", 2.0, 0.5, True)
    assert not by_name["psb: CPU s"].is_worse
    assert by_name["psb: confident"].is_worse
    assert not old.exists()
    assert len(git(root, "worktree", "list").splitlines()) == 1


@pytest.mark.parametrize(("new", "worse"), [(1.0, False), (1.09, False), (1.2, True)])
def test_a_tenth_more_time_is_worse(new: float, worse: bool) -> None:
    assert Row("seconds", 1.0, new, True).is_worse == worse


def test_the_table_of_the_search_takes_the_place_of_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    same = {"translation": 0.1, "seconds": 2.0, "cpu_seconds": 1.0, "batches": 4}
    rows = [
        {"rotation_deg": error, "verdict": verdict, **same}
        for error, verdict in ((0.01, "confident"), (0.03, "confident"), (30.0, "failed"))
    ]
    monkeypatch.setattr(bench_search, "run", lambda *_: rows)
    guide = tmp_path / "guide.md"
    guide.write_text(f"before\n{bench_search.START}\nold\n{bench_search.END}\nafter\n")
    monkeypatch.setattr("sys.argv", ["bench_search.py", "psb", "--document", str(guide)])
    bench_search.main()
    before, _, _, head, _, row, _, claims, _, _, after = guide.read_text().splitlines()
    assert (before, after) == ("before", "after")
    values = dict(zip(*([cell.strip() for cell in line.strip("|").split("|")] for line in (head, row)), strict=True))
    assert values["pairs"] == "3"
    assert values["rotation Q1 / Q2 / Q3"] == "0.020 / 0.030 / 15"
    assert values["under 1 / 2 deg"] == "67% / 67%"
    assert values["confident"] == "67%"
    assert values["over 2 / 5 deg"] == "0 / 0"
    assert "2 of 3 poses confident, 0 of them over 2" in claims
    assert (values["failed"], values["CPU s"], values["batches"]) == ("1", "1.00", "4.0")
