import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pandas import DataFrame
from report_data import rows, write_run
from small_data import is_written

from bpnp.report import read_results, write_results
from bpnp.report.charts import recall_chart
from bpnp.report.dashboards import log_results, scalars


@pytest.fixture(autouse=True)
def _offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)


def test_scalars_are_those_of_the_summary(tmp_path: Path) -> None:
    results = write_run(tmp_path, 20, 0)
    summary = json.loads((tmp_path / "test" / "summary.json").read_text())
    values = scalars(results)
    for estimate, numbers in summary["estimates"].items():
        assert {key: float(number) for key, number in numbers.items()} == {
            key: values[f"test/{estimate}/{key}"] for key in numbers
        }
    assert "test/rotation_q1_deg" not in values  # a figure has one name
    assert values["test/correspondence_loss"] == 0.25


@pytest.mark.slow
def test_a_run_is_written_to_a_folder_with_its_tables_and_pictures(tmp_path: Path) -> None:
    import wandb  # takes a second to import

    results, open_run = write_run(tmp_path, 20, 0), wandb.init(mode="offline", dir=str(tmp_path))
    run = log_results(tmp_path / "test", name="planted", directory=tmp_path / "wandb")
    assert wandb.run is open_run  # of the user, who goes on with it
    open_run.finish()
    assert run.name.startswith("offline-run-")
    media = run / "files" / "media"

    def table(name: str) -> dict[str, list[object]]:
        (path,) = (media / "table" / "test").glob(f"{name}*.json")
        return json.loads(path.read_text())

    pairs = table("problems_")
    column = pairs["columns"].index("rotation_error_deg")
    assert [row[column] for row in pairs["data"]] == [row.rotation_error_deg for row in results.rows]  # type: ignore[index]
    (path,) = (media / "plotly" / "test" / "recall_curve").glob("rotation_deg*.json")
    chart = recall_chart({"test": results}, "rotation_deg")
    assert chart is not None
    assert json.loads(path.read_text())["data"] == json.loads(chart.to_json())["data"]
    assert len(list((media / "images" / "test").glob("worst_problems_*.png"))) == 2
    assert len(list((media / "images" / "test").glob("recall_*.png"))) == 1
    assert is_written(next(run.glob("*.wandb")), b"test/pnp/rotation_q2_deg")


def test_the_tables_have_intervals_paired_differences_and_groups(tmp_path: Path) -> None:
    """The second run is 1 degree better in every problem; of its two classes, one has 15 problems, one 5."""
    chairs = [replace(own, id=f"{'chair' if own.index < 15 else 'desk'}/{own.index}") for own in rows(20, 0)]
    better = [replace(own, rotation_error_deg=own.rotation_error_deg - 1) for own in chairs]
    write_results(tmp_path / "Lc", chairs)
    written = write_results(tmp_path / "LcLp", better)
    run = log_results(tmp_path / "LcLp", name="planted", compare_with=tmp_path / "Lc")

    def frame(name: str) -> DataFrame:
        (path,) = (run / "files" / "media" / "table" / "test").glob(f"{name}_*.json")
        return DataFrame(**json.loads(path.read_text()))

    intervals = frame("intervals")
    assert list(zip(intervals.estimate, intervals["minus"], strict=True)) == [
        ("ransac", ""),
        ("ransac", "Lc: ransac"),
        ("pnp", ""),
        ("pnp", "Lc: pnp"),
    ]
    own, paired = intervals[intervals["minus"] == ""], intervals[intervals["minus"] != ""]
    assert own.rotation_q2_deg.tolist() == [written.estimates[name]["rotation_q2_deg"] for name in ("ransac", "pnp")]
    for ends in ("", "_low", "_high"):
        np.testing.assert_allclose(paired[f"rotation_q2_deg{ends}"], -1)
    assert (own["recall_joint_15deg_0.5_low"] < own["recall_joint_15deg_0.5_high"]).all()
    groups = frame("groups")
    assert list(groups.columns) == ["group", *intervals.columns]
    assert groups.group.tolist() == ["chair, 15 problems"] * 4 + ["desk, 5 problems"] * 4


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """Folder of a training that was logged to W&B as "first", and of a test with a W&B run of its own."""
    logger = {"class_path": "lightning.pytorch.loggers.WandbLogger"}
    training = {"model": {"learning_rate": 0.25}, "data": "planted", "trainer": {"logger": [logger]}, "ckpt_path": None}
    for number, config in enumerate((training, training | {"verbose": False, "model": {}})):
        folder = tmp_path / "logs" / f"version_{number}"
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(json.dumps(config))
    (tmp_path / "logs" / "version_0" / "metrics.csv").write_text("step,train/loss\n1,0.5\n")
    (tmp_path / "logs" / "version_0" / "wandb.yaml").write_text("id: first\nproject: trainings\n")
    return tmp_path


@pytest.mark.slow
def test_a_test_joins_the_run_of_its_training(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tests of one training are in its run, under the names of their folders; its name and group stay."""
    import wandb

    write_run(trained, 20, 0)
    (trained / "test").rename(trained / "Lc")
    write_run(trained, 20, 1)
    started: list[dict[str, Any]] = []
    real = wandb.init
    monkeypatch.setattr(wandb, "init", lambda **options: started.append(options) or real(**options))
    for name in ("Lc", "test"):
        run = log_results(trained / name, name="planted")
        assert run.parent == trained / "wandb"
        (file,) = run.glob("*.wandb")
        assert file.name == "run-first.wandb"
        assert is_written(file, f"{name}/pnp/rotation_q2_deg".encode())
        assert is_written(file, b"learning_rate")
    for options in started:
        assert (options["id"], options["project"], options["resume"]) == ("first", "trainings", "allow")
        assert not {"name", "group", "job_type"} & options.keys()


def test_the_charts_have_the_rings_of_the_table_of_their_data(tmp_path: Path) -> None:
    """Table 2 of the paper: L_c L_p has 1.32, 3.31 and 8.84 degrees."""
    settings = {"data": {"class_path": "bpnp.datamodules.ColmapDataModule", "init_args": {}}}
    write_results(tmp_path / "test", rows(9, 0), settings=settings)
    run = log_results(tmp_path / "test", name="planted")
    (path,) = (run / "files" / "media" / "plotly" / "test" / "recall_curve").glob("rotation_deg*.json")
    traces = {trace["name"]: trace for trace in json.loads(path.read_text())["data"]}
    assert "paper: Lc Lp" in traces
    chart = recall_chart({"test": read_results(tmp_path / "test")}, "rotation_deg", paper="megadepth")
    assert chart is not None
    assert json.loads(path.read_text())["data"] == json.loads(chart.to_json())["data"]
