"""Results by group against numbers by hand, and the settings in which two runs differ."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from report_data import rows

from bpnp.cli import main
from bpnp.report import Results, read_results, write_results
from bpnp.report.groups import differences, group_table, training_configs
from bpnp.report.intervals import interval_table
from bpnp.report.page import page_html
from bpnp.report.results import summarise

NAMES = ["chair/test/a", "desk/test/b", "chair/test/c", "chair/test/d", "desk/test/e"]


def results(settings: dict) -> Results:
    """Errors of 1 to 5 degrees."""
    found = [
        replace(row, id=name, rotation_error_deg=i + 1.0)
        for i, (row, name) in enumerate(zip(rows(5, seed=0, estimates=("pnp",)), NAMES, strict=True))
    ]
    return Results(tuple(found), summarise(found), None, settings, "0", "")


def test_each_group_has_the_statistics_of_its_own_problems_and_the_largest_comes_first() -> None:
    """Of "a" the medians are 3 of (1, 3, 4) and 3.5 of (2, 5), of "b" one less; none of "other" is a desk."""
    better = [replace(row, rotation_error_deg=row.rotation_error_deg - 1) for row in results({}).rows]
    other = [row for row in results({}).rows if row.id.startswith("chair")]
    runs = {"a": results({}), "b": replace(results({}), rows=tuple(better))}
    runs["other"] = replace(results({}), rows=tuple(other))
    table = group_table(runs)
    assert table is not None
    frame = table.frame()
    rows = frame[["group", "run", "minus", "problems", "rotation_q2_deg"]].itertuples(index=False, name=None)
    chair, desk = "chair, 3 problems", "desk, 2 problems"
    assert list(rows) == [
        (chair, "a", "", 3, 3.0),
        (chair, "b", "", 3, 2.0),
        (chair, "b", "a: pnp", 3, -1.0),
        (chair, "other", "", 3, 3.0),
        (chair, "other", "a: pnp", 3, 0.0),
        (desk, "a", "", 2, 3.5),
        (desk, "b", "", 2, 2.5),
        (desk, "b", "a: pnp", 2, -1.0),
    ]
    assert table.columns == interval_table(runs).columns
    alone = [row for row in runs["a"].rows if row.id.startswith("desk")]
    expected = interval_table({"a": replace(runs["a"], rows=tuple(alone)), "b": runs["b"]}).frame()
    assert frame[frame.group == desk].translation_q2_high.iloc[0] == expected.translation_q2_high[0]


def test_problems_without_groups_have_no_table() -> None:
    found = [replace(row, id=f"problem {i}") for i, row in enumerate(rows(5, seed=0))]
    assert group_table({"a": Results(tuple(found), summarise(found), None, {}, "0", "")}) is None


def test_the_terminal_prints_the_groups_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_results(tmp_path / "a", results({}).rows)
    main(["report", str(tmp_path / "a")])
    assert "chair, 3 problems" not in capsys.readouterr().out
    main(["report", str(tmp_path / "a"), "--groups"])
    printed = [line.strip() for line in capsys.readouterr().out.splitlines()]
    heads = [line for line in printed if line.startswith(("chair", "desk"))]
    assert heads == 2 * ["chair, 3 problems", "desk, 2 problems"]  # the table is split in two
    assert printed[printed.index(heads[1]) + 1].split()[:2] == ["pnp", "3.50"]
    write_results(tmp_path / "b", [replace(row, id=str(row.index)) for row in results({}).rows])
    main(["report", str(tmp_path / "b"), "--groups"])
    assert "no group before a slash" in capsys.readouterr().out


def test_the_settings_that_differ_are_named_with_both_values() -> None:
    one = {"solver": {"class_path": "Net", "init_args": {"rounds": 0, "mu": 0.1}}, "checkpoint": "a.ckpt"}
    other = {"solver": {"class_path": "Net", "init_args": {"rounds": 8, "mu": 0.1}}, "checkpoint": "a.ckpt"}
    assert differences({"a": results(one), "b": results(other)}) == ["solver.rounds: 0 (a), 8 (b)"]
    assert differences({"a": results(one)}) == []


def test_a_time_limit_that_differs_is_named_and_what_a_method_repeats_is_not() -> None:
    one, other = ({"method": {"label": label, "time_limit": limit}} for label, limit in (("a", 10.0), ("b", 30.0)))
    assert differences({"a": results(one), "b": results(other)}) == ["time_limit: 10.0 (a), 30.0 (b)"]


def write_training(run: Path, seed: int = 0, epochs: int = 3, start_epoch: int | None = 2, **model: object) -> None:
    """The files of a training with the configuration that `bpnp fit` writes, shortened."""
    folder = run / "logs" / "version_0"
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text("step,train/loss\n1,0.5\n2,0.4\n")
    warmup = {"class_path": "bpnp.training.PoseLossWarmup", "init_args": {"start_epoch": start_epoch, "weight": None}}
    config = {
        "seed_everything": seed,
        "model": {"solver": {"class_path": "Net", "init_args": {"rounds": 0}}, "learning_rate": 1e-4, **model},
        "trainer": {
            "max_epochs": epochs,
            "default_root_dir": str(run),
            "callbacks": [] if start_epoch is None else [warmup],
        },
        "best_checkpoint": {"dirpath": str(run / "checkpoints")},
        "ckpt_path": None,
    }
    (folder / "config.yaml").write_text(json.dumps(config))  # YAML contains JSON


@pytest.mark.slow
def test_what_the_trainings_changed_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Learning rate, loss, epochs and seed, but no folder; on the page and on the terminal."""
    write_training(tmp_path / "quickstart")
    write_training(tmp_path / "faster", seed=1, epochs=5, start_epoch=4, learning_rate=3e-4, loss="my.Loss")
    for name in ("quickstart", "faster"):
        settings = {"checkpoint": f"{name}/best.ckpt", "solver": {"class_path": "Net", "init_args": {"rounds": 0}}}
        write_results(tmp_path / name / "test", results({}).rows, settings=settings)
    expected = [
        "model.learning_rate: 0.0001 (quickstart), 0.0003 (faster)",
        "model.loss: none (quickstart), my.Loss (faster)",
        "trainer.max_epochs: 3 (quickstart), 5 (faster)",
        "trainer.callbacks.PoseLossWarmup.start_epoch: 2 (quickstart), 4 (faster)",
        "seed_everything: 0 (quickstart), 1 (faster)",
        "checkpoint: quickstart/best.ckpt (quickstart), faster/best.ckpt (faster)",
    ]
    folders = {name: tmp_path / name / "test" for name in ("quickstart", "faster")}
    runs = {name: read_results(folder) for name, folder in folders.items()}
    found = differences(runs, training_configs(folders, runs))
    assert sorted(found) == sorted(expected)
    assert found[-1] == expected[-1]
    main(["report", *map(str, folders.values()), "--html", str(tmp_path / "page.html")])
    printed = capsys.readouterr().out
    page = (tmp_path / "page.html").read_text()
    for line in expected:
        assert line in printed
        assert f"<li>{line}</li>" in page


def test_a_test_of_another_checkpoint_has_not_the_training_of_its_folder(tmp_path: Path) -> None:
    """Results in the folder of a training: of its checkpoint, of another run's, and of a solver without any."""
    write_training(tmp_path / "here")
    write_training(tmp_path / "there", learning_rate=0.5)
    for name in ("here", "there", "packaged"):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
        (tmp_path / name / "checkpoints" / "best.ckpt").touch()
    rates = {}
    for name in ("here", "there", "packaged", None):
        settings = {"checkpoint": name and str(tmp_path / name / "checkpoints" / "best.ckpt")}
        folders, runs = {"a": tmp_path / "here" / "test"}, {"a": results(settings)}
        rates[name] = training_configs(folders, runs)["a"].get("model", {}).get("learning_rate")
    assert rates == {"here": 1e-4, "there": 0.5, "packaged": None, None: None}


def test_many_differences_are_counted() -> None:
    one, other = ({"data": {f"option{i}": i + add for i in range(20)}} for add in (0, 1))
    found = differences({"a": results(one), "b": results(other)})
    assert len(found) == 17
    assert found[-1] == "and 4 more settings"


def test_the_page_shows_both(tmp_path: Path) -> None:
    for name, rounds in (("a", 0), ("b", 8)):
        write_results(tmp_path / name, results({}).rows, settings={"solver": {"init_args": {"rounds": rounds}}})
    page = page_html([tmp_path / "a", tmp_path / "b"])
    assert "<li>solver.rounds: 0 (a), 8 (b)</li>" in page
    assert "<h2>By class or scene</h2>" in page
    assert '<a href="#groups">By class or scene</a>' in page
    group = page[page.index("chair, 3 problems") : page.index("desk, 2 problems")]
    assert re.findall('data-head="rotation median">(.*?)\n', group) == ["3.00", "3.00", "0"]
