import json
from pathlib import Path

import pytest
import wandb
from report_data import write_run
from small_data import is_written

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
    assert values["test/rotation_q1_deg"] == summary["estimates"]["ransac"]["rotation_q1_deg"]
    assert values["test/correspondence_loss"] == 0.25


def test_a_run_is_written_to_a_folder_with_its_tables_and_pictures(tmp_path: Path) -> None:
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
