"""`bpnp table`: what it runs, keeps, resumes and prints."""

import csv
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from small_data import small_net
from torch import nn

from bpnp.cli import main
from bpnp.files import lock_folder
from bpnp.models.baselines import RandomRansac
from bpnp.report import read_points, read_results
from bpnp.report.tables import MethodRow, as_latex, paper_rows
from bpnp.training.comparison import parse_methods
from bpnp.training.task import BlindPnPTask
from bpnp.types import Batch, Prediction

pytestmark = pytest.mark.slow

RECIPE = """
data:
  class_path: bpnp.datamodules.MeshDataModule
  init_args:
    num_points: 12
    pool_size: 64
    test_shapes: 5
    cache_dir: {folder}
"""
RANSAC = """
model:
  solver:
    class_path: bpnp.models.baselines.RandomRansac
    init_args:
      max_hypotheses: 64
      time_limit: null
"""
SOFTPOSIT = "model:\n  solver:\n    class_path: bpnp.models.baselines.SoftPOSIT\n    init_args: {max_steps: 3}\n"


@pytest.fixture
def recipes(tmp_path: Path) -> list[str]:
    (tmp_path / "data.yaml").write_text(RECIPE.format(folder=tmp_path))
    (tmp_path / "ransac.yaml").write_text(RANSAC)
    (tmp_path / "softposit.yaml").write_text(SOFTPOSIT)
    methods = [f"blind={tmp_path}/ransac.yaml", f"{tmp_path}/softposit.yaml"]
    return ["table", f"--data={tmp_path}/data.yaml", "--methods", *methods, f"--output={tmp_path}/out"]


def test_a_table_of_two_methods_is_printed_and_written(
    recipes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([*recipes, "--limit=3"])
    printed = capsys.readouterr().out
    assert "blind" in printed
    assert "another data set" in printed
    assert "21.8" in printed  # SoftPOSIT's median in the paper's table 1
    results = read_results(tmp_path / "out" / "blind")
    assert len(results.rows) == 3
    rows = list(csv.DictReader((tmp_path / "out" / "table.csv").open()))
    ours = {row["method"]: row for row in rows if row["source"] == "here"}
    assert set(ours) == {"blind", "softposit"}
    median = results.estimates["random_ransac"]["rotation_q2_deg"]
    assert float(ours["blind"]["rotation_q2_deg"]) == pytest.approx(median)
    paper = {row["method"]: row for row in rows if row["source"] == "paper, ModelNet40"}
    assert float(paper["Lc Lp"]["recall_joint_15deg_0.5"]) == 0.72
    tex = (tmp_path / "out" / "table.tex").read_text()
    assert tex.count(r"\\") == 2 + 2 + len(paper_rows("modelnet40"))
    assert r"\multicolumn{3}{c}{Rotation Error}" in tex
    assert {problem.index for problem in read_points(tmp_path / "out" / "blind")} == {row.index for row in results.rows}
    main(["report", str(tmp_path / "out")])
    assert "softposit" in capsys.readouterr().out


def test_finished_methods_are_skipped_and_longer_tables_run_again(
    recipes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], fails: Callable[..., str]
) -> None:
    main([*recipes, "--limit=2"])
    first = {name: read_results(tmp_path / "out" / name).rows for name in ("blind", "softposit")}
    (tmp_path / "out" / "softposit" / "summary.json").unlink()  # as if killed
    main([*recipes, "--limit=2"])
    assert "1 of 2 tests are finished" in capsys.readouterr().out
    again = {name: read_results(tmp_path / "out" / name).rows for name in first}
    assert again["blind"] == first["blind"]
    assert again["softposit"] != first["softposit"]  # a problem that is solved again takes another time
    main([*recipes, "--limit=4"])
    longer = read_results(tmp_path / "out" / "blind").rows
    assert len(longer) == 4
    assert {row.index for row in first["blind"]} < {row.index for row in longer}
    errors = {row.index: row.rotation_error_deg for row in longer}
    assert all(errors[row.index] == row.rotation_error_deg for row in first["blind"])
    main([*recipes, "--limit=1"])
    assert read_results(tmp_path / "out" / "blind").rows == longer
    with lock_folder(tmp_path / "out" / "blind"):
        assert "another process writes to" in fails(*recipes, "--limit=1")
    rows = list(csv.DictReader((tmp_path / "out" / "table.csv").open()))
    assert {row["problems"] for row in rows if row["source"] == "here"} == {"1"}


class Failing(RandomRansac):
    """Ctrl-C while the third problem is solved."""

    solved = 0

    def forward(self, batch: Batch) -> Prediction:
        Failing.solved += 1
        if Failing.solved == 3:
            raise KeyboardInterrupt
        return super().forward(batch)


class Poseless(nn.Module):
    """Answers without a pose."""

    def forward(self, batch: Batch) -> Prediction:
        return Prediction()


@pytest.mark.parametrize(
    ("method", "error"),
    [
        ("Poseless", "the predictions of 'it' have no pose"),
        (
            "Nowhere",
            "Problem with given class_path 'test_table_command.Nowhere': module .* has no attribute",
        ),
        (
            "functools.partial",
            'no Module, or does not accept its arguments: Parser key "solver": Import path functools.partial does not',
        ),
    ],
)
def test_a_class_that_is_no_method_is_named(
    recipes: list[str], fails: Callable[..., str], tmp_path: Path, method: str, error: str
) -> None:
    path = method if "." in method else f"test_table_command.{method}"
    assert re.search(error, fails("table", recipes[1], "--methods", f"it={path}", recipes[-1], "--limit=1"))
    assert (tmp_path / "out").exists() == (method == "Poseless")  # the others before any test


def test_a_method_that_was_interrupted_starts_again(recipes: list[str], tmp_path: Path) -> None:
    Failing.solved = 0
    words = ["table", recipes[1], "--methods", "it=test_table_command.Failing", recipes[-1], "--limit=5"]
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 130
    partial = read_results(tmp_path / "out" / "it")
    assert (len(partial.rows), partial.settings["complete"]) == (2, False)
    main(words)
    assert Failing.solved == 3 + 5
    assert len(read_results(tmp_path / "out" / "it").rows) == 5


def test_a_limit_of_time_reaches_the_methods(recipes: list[str], tmp_path: Path) -> None:
    main(["table", recipes[1], "--methods", "search", recipes[-1], "--limit=1", "--time_limit=1e-6"])
    assert not read_results(tmp_path / "out" / "search").rows[0].found
    main(["table", recipes[1], *recipes[2:4], f"--output={tmp_path}/long", "--limit=1", "--time_limit", "inf"])
    assert read_results(tmp_path / "long" / "blind").settings["method"]["time_limit"] == "inf"


def test_an_outlier_sweep_adds_points_and_draws_its_curves(recipes: list[str], tmp_path: Path) -> None:
    main([*recipes, "--limit=2", "--rho", "0", "0.5"])
    clean = read_results(tmp_path / "out" / "rho-0" / "blind").rows[0]
    cluttered = read_results(tmp_path / "out" / "rho-0.5" / "blind").rows[0]
    assert (clean.m, clean.n, clean.matches) == (12, 12, 12)
    assert (cluttered.m, cluttered.n, cluttered.matches) == (18, 18, 12)
    assert (tmp_path / "out" / "outliers.png").stat().st_size > 1000
    rows = list(csv.DictReader((tmp_path / "out" / "table.csv").open()))
    assert [row["rho"] for row in rows if row["source"] == "here"] == ["0.0", "0.0", "0.5", "0.5"]


def test_a_table_of_several_seeds_has_their_mean_and_spread(recipes: list[str], tmp_path: Path) -> None:
    main([*recipes, "--limit=2", "--seeds", "1", "2", "5"])
    medians = [
        read_results(tmp_path / "out" / f"seed-{seed}" / "blind").estimates["random_ransac"]["translation_q2"]
        for seed in (1, 2, 5)
    ]
    assert len(set(medians)) == 3
    ours = [row for row in csv.DictReader((tmp_path / "out" / "table.csv").open()) if row["source"] == "here"]
    blind, spread, *_ = ours
    assert (blind["method"], blind["problems"], len(ours)) == ("blind", "6", 4)
    assert float(blind["translation_q2"]) == pytest.approx(np.mean(medians))
    assert float(spread["translation_q2"]) == pytest.approx(np.std(medians, ddof=1))


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--methods", "nonsense"], "'nonsense' is no method; give one of softposit, ransac"),
        (["--methods", "ransac", "ransac"], "two methods have the label 'ransac'"),
        (["--methods", "a-b=ransac", "a/b=search"], "two methods have the label 'a/b'"),
        (["--methods", "..=ransac"], "the label '..' of '..=ransac' cannot name a folder of results"),
        (["--methods", "=ransac"], "the label '' of '=ransac' cannot name a folder of results"),
        (["--methods", "bpnpnet@nothing.ckpt"], "there is no checkpoint nothing.ckpt"),
        (["--methods", "bpnp.models.baselines.Nothing"], "bpnp.models.baselines.Nothing"),
        (["--data.nonsense=3"], "nonsense"),
        (["--seed=3"], "nrecognized arguments: --seed=3"),
        (["--limit=x"], "--limit is 'x'; a whole number is needed"),
        (["--limit=0"], "--limit is 0; it must be 1 or more"),
        (["--rho", "0", "-1"], "--rho is -1"),
        (["--data=nowhere.yaml"], "there is no file nowhere.yaml"),
    ],
)
def test_a_users_mistake_is_one_clear_error(
    recipes: list[str], extra: list[str], message: str, fails: Callable[..., str]
) -> None:
    assert message in fails(*recipes, "--limit=1", *extra)


def test_other_settings_in_the_same_folder_are_refused(
    recipes: list[str], tmp_path: Path, fails: Callable[..., str]
) -> None:
    main([*recipes, "--limit=1"])
    assert "has results of another data" in fails(*recipes, "--limit=1", "--data.noise_px=0")
    (tmp_path / "ransac.yaml").write_text(RANSAC.replace("64", "65"))
    assert "has results of another method" in fails(*recipes, "--limit=1")


def test_a_checkpoint_becomes_rows_per_estimate(tmp_path: Path) -> None:
    task = BlindPnPTask(small_net(16, 1))
    content: dict[str, object] = {"state_dict": task.state_dict()}
    task.on_save_checkpoint(content)
    weights = tmp_path / "last.ckpt"
    torch.save(content, weights)
    (tmp_path / "data.yaml").write_text(RECIPE.format(folder=tmp_path))
    main(["table", f"--data={tmp_path}/data.yaml", "--methods", f"Lc=bpnpnet@{weights}", f"hungarian@{weights}",
          "--limit=2", f"--output={tmp_path}/out", "--paper=none"])  # fmt: skip
    rows = [row["method"] for row in csv.DictReader((tmp_path / "out" / "table.csv").open())]
    assert rows == ["Lc ransac", "Lc pnp", "Lc refined", "hungarian ransac", "hungarian pnp"]


def test_names_in_latex_are_text() -> None:
    assert r"L\_c \& 50\% | R" in as_latex([MethodRow("L_c & 50% | R", {"problems": 3})])


@pytest.mark.parametrize(
    ("name", "limited"),
    [
        *((name, True) for name in ("softposit", "ransac", "gosma", "gopac", "search")),
        *((name, False) for name in ("hungarian", "bpnpnet", "matcher")),
    ],
)
def test_every_short_name_builds_a_solver(name: str, limited: bool) -> None:
    (method,) = parse_methods([name], time_limit=2.5)
    solver = method.build()
    assert not solver.training
    assert len(solver.estimates) >= 1
    assert getattr(solver, "time_limit", None) == (2.5 if limited else None)
