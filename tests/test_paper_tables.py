"""The benchmarks of the paper's tables: what was stopped goes on, figures are those of the rows, pages are filled."""

import csv
import io
import shlex
import shutil
from argparse import Namespace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import paper_tables
import paper_weights
import pytest
import table1
import table2
import torch
from paper_tables import (
    Method,
    Table,
    Training,
    effect,
    figures,
    network,
    printed_rows,
    row_cells,
    solve_problems,
)
from paper_weights import EPOCH, STAGES, trainings
from report_data import row
from small_data import SMALL_FEATURES
from torch import Tensor, nn

from bpnp import Batch, Pose, Prediction, SolveStats
from bpnp.cli import main
from bpnp.datamodules import MeshDataModule
from bpnp.models.weights import pack_weights

SHAPES = {"num_points": 20, "pool_size": 20, "train_shapes": 4, "val_shapes": 2, "test_shapes": 6, "train_problems": 4}


@pytest.mark.nightly
def test_a_training_goes_on_from_its_own_checkpoint_and_a_branch_from_anothers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper_tables.subprocess, "run", lambda command, check: main(command[3:]))
    shapes = [f"--data.{name}={value}" for name, value in SHAPES.items()]
    small = ("--config=quickstart", "--pose_loss.start_epoch=1", *shapes, *SMALL_FEATURES, "--data.batch_size=2",
             f"--data.cache_dir={tmp_path}")  # fmt: skip
    first = Training(tmp_path / "first", small, steps=2, epoch=1)
    assert paper_tables.trained_steps(first.checkpoint) == 0
    assert paper_tables.trained_steps(first.run()) == 2
    longer = Training(tmp_path / "first", small, steps=3, epoch=1)
    assert paper_tables.trained_steps(longer.run()) == 3
    branch = Training(tmp_path / "branch", small, steps=4, epoch=1, start=first.checkpoint)
    assert paper_tables.trained_steps(branch.run()) == 4
    monkeypatch.setattr(paper_tables.subprocess, "run", lambda *_, **__: pytest.fail("trained again"))
    assert branch.run() == branch.checkpoint
    net, ours = network(branch.checkpoint), network(branch.checkpoint, inference="ours")
    assert (net.ransac.backend, net.ransac.threshold, net.pnp.solver, net.widths) == ("opencv", 0.01, "lbfgs", [])
    assert (net.estimates, ours.estimates) == (("ransac", "pnp"), ("ransac", "pnp", "refined"))
    assert len(ours.widths) == 8
    wide = network(branch.checkpoint, inference="ransac")
    assert (wide.ransac.backend, wide.ransac.threshold, wide.pnp.solver) == ("auto", 0.004, "newton")
    assert (wide.estimates, wide.widths) == (("ransac", "pnp"), [])
    pack_weights(branch.checkpoint, tmp_path / "packed.ckpt")
    packed = network(tmp_path / "packed.ckpt")
    assert (tmp_path / "packed.ckpt").stat().st_size < branch.checkpoint.stat().st_size / 4
    for name, value in net.state_dict().items():
        torch.testing.assert_close(packed.state_dict()[name], value, rtol=1e-3, atol=1e-4)


def plant_steps(checkpoint: Path, steps: int) -> None:
    """Write a checkpoint with a number of steps."""
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"global_step": steps, "state_dict": {}}, checkpoint)


def test_both_branches_start_at_the_switch_and_have_equal_lengths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, joins, rates = {}, {}, {}

    def train(command: list[str], check: bool) -> None:
        options = dict(word.split("=", 1) for word in command if word.startswith("--") and "=" in word)
        folder, start = Path(options["--trainer.default_root_dir"]), command[-1]
        if not (folder / "checkpoints" / "last.ckpt").is_file() and "from" in folder.name:
            starts[folder.name] = paper_tables.trained_steps(start)
        joins[folder.name] = int(options["--pose_loss.start_epoch"])
        rates[folder.name] = options.get("--model.learning_rate")
        steps = int(options["--trainer.limit_train_batches"]) * int(options["--trainer.max_epochs"])
        plant_steps(folder / "checkpoints" / "last.ckpt", steps)

    monkeypatch.setattr(paper_tables.subprocess, "run", train)

    def run(rate: float | None = None, **schedule: int) -> dict[str, int]:
        given = Namespace(epoch=10, pose_learning_rate=rate, **schedule)
        trained = paper_tables.branches(tmp_path, (), given)
        return {label: paper_tables.trained_steps(one.run()) for label, one in trained.items()}

    assert run(steps=20, pose_steps=10) == {"first": 20, "Lc": 30, "Lc Lp": 30}
    assert run(steps=50, pose_steps=20, rate=1e-5) == {"first": 50, "Lc": 70, "Lc Lp": 70}
    rate = {name: value for name, value in rates.items() if value is not None}
    assert rate == {"lc-from50": "1e-05", "lclp-from50": "1e-05"}
    assert starts == {"lc-from20": 20, "lclp-from20": 20, "lc-from50": 50, "lclp-from50": 50}
    assert (joins.pop("lclp-from20"), joins.pop("lclp-from50")) == (2, 5)
    assert min(joins.values()) > 1e5  # not the 120 of the recipe, which a longer training reaches
    assert run(steps=20, pose_steps=30) == {"first": 50, "Lc": 50, "Lc Lp": 50}  # goes on with its own checkpoints
    shutil.rmtree(tmp_path / "lclp-from20")
    run(steps=20, pose_steps=30)  # from the checkpoint that was kept
    assert starts["lclp-from20"] == 20
    with pytest.raises(SystemExit, match="lc-30.ckpt is missing, from which lc-from30 starts"):
        run(steps=30, pose_steps=10)
    monkeypatch.setattr(paper_tables.subprocess, "run", lambda *_, **__: None)
    with pytest.raises(SystemExit, match="lc-from50 has 70 steps instead of 90; was it begun with another --epoch"):
        run(steps=50, pose_steps=40, rate=1e-5)


def test_a_training_that_was_begun_otherwise_is_not_taken_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights, folder = tmp_path / "weights.ckpt", tmp_path / "run"
    plant_steps(weights, 5)
    given = f"--model.weights={weights}"
    monkeypatch.setattr(
        paper_tables.subprocess, "run", lambda *_, **__: plant_steps(folder / "checkpoints" / "last.ckpt", 20)
    )
    Training(folder, ("--model.learning_rate=1e-4", given), 20, 10).run()
    monkeypatch.setattr(paper_tables.subprocess, "run", lambda *_, **__: pytest.fail("trained again"))
    Training(folder, ("--model.learning_rate=1e-4", given), 10, 10).run()  # a shorter one of the same kind is there
    with pytest.raises(SystemExit, match="was begun with other arguments"):
        Training(folder, ("--model.learning_rate=1e-5", given), 20, 10).run()
    with pytest.raises(SystemExit, match="was begun with other epoch"):
        Training(folder, ("--model.learning_rate=1e-4", given), 20, 20).run()
    plant_steps(weights, 6)
    with pytest.raises(SystemExit, match="was begun with other starts"):
        Training(folder, ("--model.learning_rate=1e-4", given), 20, 10).run()


def test_branches_of_unequal_lengths_are_refused_or_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, steps in {"lc": 700, "lc-from700": 900, "lclp-from700": 800}.items():
        plant_steps(tmp_path / "seed0" / name / "checkpoints" / "last.ckpt", steps)
    command = ["table1", "--run", str(tmp_path), "--output", str(tmp_path / "record.json"), "--steps", "700"]
    monkeypatch.setattr("sys.argv", [*command, "--pose_steps", "100"])
    with pytest.raises(SystemExit, match=r"the branches differ in their steps \(Lc 900, Lc Lp 800\)"):
        table1.main()
    monkeypatch.setattr("sys.argv", [*command, "--pose_steps", "150"])
    parts = "lc-from700 has 850 and 100, lclp-from700 has 850 and 100"
    with pytest.raises(SystemExit, match=f"a multiple of those between checkpoints: {parts}"):
        table1.main()


def test_steps_on_drawn_maps_are_whole_epochs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_tables.subprocess, "run", lambda *_, **__: pytest.fail("trained"))
    command = [
        "table2",
        "--run",
        str(tmp_path),
        "--output",
        str(tmp_path / "record.json"),
        "--drawn_steps",
        "50",
        "120",
    ]
    monkeypatch.setattr("sys.argv", [*command, "--steps", "40", "--pose_steps", "20"])
    with pytest.raises(SystemExit, match="a multiple of those between checkpoints: drawn256 has 120 and 50"):
        table2.main()


def test_the_weights_with_the_pose_loss_go_on_from_those_without_and_switch_once(tmp_path: Path) -> None:
    """Each stage starts where the one before ends, with more steps; the pose loss joins after the first weights."""
    chain = list(trainings(tmp_path))
    packaged = [(stage.name, stage.pose_loss, stage.loss) for stage, *_ in chain if stage.packaged]
    assert packaged == [("paper-lc", False, "correspondence"), ("paper-lclp", True, "correspondence")]
    end, checkpoint = 0, None
    for stage, training, _ in chain:
        options = dict(argument.split("=", 1) for argument in training.arguments)
        start, switch = end if stage.muon else 0, EPOCH * int(options["--pose_loss.start_epoch"])
        assert training.start == (checkpoint if stage.muon else None)
        assert options.get("--model.weights") == (None if stage.muon else str(checkpoint))
        assert (training.steps - start, training.steps % EPOCH) == (stage.steps, 0)
        assert stage.pose_loss == (switch == start)
        assert stage.pose_loss or switch == training.steps  # which no step reaches
        assert options["--model.matching_loss"] == stage.loss
        assert options.get("--optimizer") == ("bpnp.training.Muon" if stage.muon else None)
        assert float(options["--optimizer.lr" if stage.muon else "--model.learning_rate"]) == stage.learning_rate
        decay = {"--model.decay_start": str(start), "--model.decay_steps": str(stage.steps)}
        assert {key: value for key, value in options.items() if "decay" in key} == (decay if stage.decay else {})
        end, checkpoint = training.steps, training.checkpoint
    assert chain[-1][0].name == "paper-lclp"
    assert chain[-1][2] == sum(stage.steps for stage in STAGES)


def test_the_stages_between_the_weights_are_not_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained, packed = [], []
    monkeypatch.setattr(Training, "run", lambda training: trained.append(training.folder.name) or training.checkpoint)
    monkeypatch.setattr(paper_weights, "pack_weights", lambda _, target, steps: packed.append((target, steps)))
    monkeypatch.setattr("sys.argv", ["paper_weights", "--run", str(tmp_path), "--output", str(tmp_path / "packed")])
    paper_weights.main()
    assert trained == [stage.name for stage in STAGES]
    before = next(i for i, stage in enumerate(STAGES) if stage.name == "paper-lc")
    assert packed == [
        (tmp_path / "packed" / "paper-lc.ckpt", sum(stage.steps for stage in STAGES[: before + 1])),
        (tmp_path / "packed" / "paper-lclp.ckpt", sum(stage.steps for stage in STAGES)),
    ]


class Known(nn.Module):
    """The true pose; counts its calls, and stops after some."""

    estimates = ("pnp",)

    def __init__(self, calls: int) -> None:
        super().__init__()
        self.left = calls

    def forward(self, batch: Batch) -> Prediction:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        assert isinstance(batch.rotation, Tensor)
        assert isinstance(batch.translation, Tensor)
        pose = Pose(batch.rotation, batch.translation, SolveStats.of(batch.translation[:, 0] < 9))
        return Prediction(poses={"pnp": pose})


def test_a_test_that_was_stopped_measures_what_is_missing_and_another_solver_all(tmp_path: Path) -> None:
    data, file = MeshDataModule(**SHAPES, cache_dir=str(tmp_path)), tmp_path / "rows" / "known.jsonl"
    with pytest.raises(KeyboardInterrupt):
        solve_problems(file, lambda: Known(2), data, 5, {"steps": 1})
    rows = solve_problems(file, lambda: Known(3), data, 5, {"steps": 1})
    assert len({r.index for r in rows}) == 5
    assert max(r.rotation_error_deg for r in rows) < 0.1
    assert solve_problems(file, lambda: pytest.fail("built again"), data, 4, {"steps": 1}) == [
        r for r in rows if r.index in set(paper_tables.problem_order(6)[:4])
    ]
    before = file.read_text()
    assert solve_problems(file, lambda: pytest.fail("built"), data, 0, {"steps": 2}) == []
    assert file.read_text() == before
    others = MeshDataModule(**SHAPES, cache_dir=str(tmp_path), seed=1)
    for other, steps in ((data, 2), (others, 1)):
        with pytest.raises(KeyboardInterrupt):
            solve_problems(file, lambda: Known(4), other, 5, {"steps": steps})
        if steps == 2:
            assert file.with_suffix(".previous.jsonl").read_text() == before


def test_a_file_that_was_cut_off_is_continued_and_names_every_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, file = MeshDataModule(**SHAPES, cache_dir=str(tmp_path)), tmp_path / "known.jsonl"
    monkeypatch.setattr("record.commit", lambda: "early")
    with pytest.raises(KeyboardInterrupt):
        solve_problems(file, lambda: Known(2), data, 5, {"steps": 1})
    assert paper_tables.provenance(file)["commit"] == "early"
    with file.open("a") as out:
        out.write('[{"index": 3, "id": "sh')
    monkeypatch.setattr("record.commit", lambda: "late")
    rows = solve_problems(file, lambda: Known(3), data, 5, {"steps": 1})
    assert len({r.index for r in rows}) == 5
    measured = paper_tables.provenance(file)
    assert measured["commit"] == "early, late"
    assert "," not in measured["cpu"]


def test_the_pictures_of_the_pages_are_drawn_from_their_record_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[bool] = []
    monkeypatch.setattr(paper_tables, "publish", lambda *_: None)
    for name in ("other.json", "record.json"):
        parser = paper_tables.options(
            None, file=tmp_path / "record.json", run=tmp_path, sets=[], steps=1, pose_steps=1, epoch=1
        )
        monkeypatch.setattr("sys.argv", ["table1", "--output", str(tmp_path / name)])
        paper_tables.run(table1.TABLE, parser, lambda options: drawn.append(options.published))
    assert drawn == [False, True]


def test_the_figures_are_those_of_the_rows() -> None:
    angles = [1.0, 2.0, 3.0, 40.0]
    rows = [
        row(i, rotation_error_deg=angle, translation_error=0.1 * angle, seconds=2.0) for i, angle in enumerate(angles)
    ]
    found = figures(rows, (15.0, 0.25))
    assert [quartile[0] for quartile in found["rotation"]] == [1.75, 2.5, 12.25]
    assert found["recall"][0] == 0.5  # the third is turned little and shifted too far
    assert (found["problems"], found["seconds"]) == (4, 2.0)
    value, low, high = found["rotation"][1]
    assert angles[0] <= low < value < high <= angles[-1]
    better = [row(i, rotation_error_deg=angle - 0.5, translation_error=0.05 * angle) for i, angle in enumerate(angles)]
    paired = effect(rows, better, (15.0, 0.25))
    assert paired["rotation"] == [-0.5, -0.5, -0.5]
    assert paired["rotation better"] == 1.0
    assert paired["recall"][0] == 0.25
    label, steps, problems, rotation, *_ = row_cells("Lc", found | {"steps": 1200})
    assert (label, steps, problems) == ("Lc", "1,200", "4")
    assert rotation.startswith("1.8 / 2.5 [")
    assert row_cells("GOSMA", found)[:3] == ["GOSMA", "", "4"]


def test_the_papers_rows_are_printed_as_in_the_paper() -> None:
    rows = printed_rows("modelnet40")
    errors = ["4.88 / 9.66 / 16.0", "0.04 / 0.08 / 0.15", "0.36 / 0.61 / 1.03"]
    assert rows[4] == ["*paper: Lc Lp*", "350,000 to 500,000", "", *errors, "72", "0.1"]
    assert len(rows) == 7


def settings(**other: float) -> dict[str, float]:
    return {"seed": 0, "steps": 400, "pose_steps": 100, "epoch": 100, "learning_rate": 1e-4, "test_seed": 0} | other


def test_a_record_becomes_the_tables_of_the_page() -> None:
    rng = np.random.default_rng(0)
    rows = [row(i, rotation_error_deg=float(rng.gamma(2, 5))) for i in range(10)]
    one = figures(rows, table1.TABLE.recall) | {"steps": 500}
    other = figures(rows, table1.TABLE.recall) | {"settings": {"our_problems": 40, "test_seed": 0}}
    record = {
        "rows": {
            "modelnet10|0|paper|Lc|ransac": one | {"settings": settings(problems=500)},
            "modelnet10|0|paper|Lc|pnp": one | {"settings": settings(problems=500)},
            "modelnet10|0|paper, our RANSAC|Lc|ransac": one | {"settings": settings(our_problems=40)},
            "modelnet10|0|paper, our inference|Lc|refined": one | {"settings": settings(our_problems=40)},
            "modelnet10|0|baselines|search|search": other,
        },
        "effects": {
            f"modelnet10|0|{key}|pnp": effect(rows, rows, table1.TABLE.recall) | {"steps": steps}
            for key, steps in {
                "paper|Lc|Lc Lp": [500, 400],
                "training|paper-lc|paper-lclp": [500, 400],
                f"training|{paper_tables.LONGER}|paper-lclp": [500, 500],
            }.items()
        },
    }
    tables = paper_tables.tables(table1.TABLE, record)
    lines = tables["modelnet10-paper"].splitlines()
    measures = ["rotation, deg", "translation", "reprojection, deg", "% within 15 deg, 0.5", "seconds"]
    expected = [name for measure in measures for name in (f"| **{measure}**", "| Lc", "| Lc R")]
    assert [line.split(" | ")[0] for line in lines[2:]] == expected
    assert lines[3].endswith("| 6.08 / 11.3 / 18.3 |")
    assert lines[4].endswith("| 5.49 / 11.7 / 20.0 |")
    (short,) = (line for line in tables["modelnet10-summary"].splitlines() if line.startswith("| Lc |"))
    assert short.startswith(f"| Lc | {one['rotation'][1][0]:.2g} [")
    assert " | 11.3 | " in short
    parts = [line.split(" | ")[0] for line in tables["medians"].splitlines()[2:]]
    assert parts == [
        "| **the paper's training, our RANSAC**", "| Lc R",
        "| **the paper's training, our inference**", "| Lc, refined",
    ]  # fmt: skip
    assert "| search |" in tables["modelnet10-baselines"]
    assert "| seed 0 | 400 | 500 |  | 0.0001 |" in tables["training"]
    row_of_effect = "| Lc Lp (400 steps) minus Lc (500 steps), unequal training | 10 | +0 [+0, +0]"
    assert row_of_effect in tables["modelnet10-effect"]
    row_of_effect = "| paper-lclp (400 steps) minus paper-lc (500 steps), unequal training |"
    assert row_of_effect in tables["modelnet10-training-effect"]
    row_of_effect = f"| paper-lclp minus {paper_tables.LONGER}, 500 steps |"
    assert row_of_effect in tables["modelnet10-training-effect"]
    assert tables["modelnet10-spread"] == "Measured with one seed.\n"


def test_a_sheet_has_a_column_for_each_figure_and_a_line_for_each_row() -> None:
    rows = [row(i, rotation_error_deg=float(i)) for i in range(9)]
    one, other = figures(rows, (3.5, 1.0)) | {"steps": 5}, effect(rows, rows, (3.5, 1.0)) | {"steps": [4, 5]}
    measured = {"settings": {"seed": 3}, "measured": {"commit": "abc", "date": "2026-01-01"}}
    record = {"rows": {"psb|3|paper|Lc|pnp": one | measured}, "effects": {"psb|3|paper|Lc|Lc Lp|pnp": other}}
    sheets = paper_tables.sheets(record)
    ((found,), (difference,)) = (list(csv.DictReader(io.StringIO(sheets[part]))) for part in ("", "-effects"))
    assert (found["set"], found["row"], found["steps"], found["settings"]) == ("psb", "Lc", "5", '{"seed": 3}')
    assert [float(found[f"rotation_q{i}"]) for i in (1, 2, 3)] == [2.0, 4.0, 6.0]
    assert [float(found[f"recall{end}"]) for end in ("", "_low", "_high")] == one["recall"]
    assert (found["commit"], found["date"]) == ("abc", "2026-01-01")
    assert (difference["before"], difference["after"]) == ("Lc", "Lc Lp")
    assert (difference["steps_before"], difference["steps_after"], difference["rotation"]) == ("4", "5", "0.0")


def test_the_page_has_the_commands_of_its_rows_and_a_line_for_each_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The printed command, given to the benchmark, has the options that the rows were measured with."""
    one = figures([row(i) for i in range(3)], table1.TABLE.recall)
    record: dict[str, dict[str, object]] = {"rows": {}, "effects": {}}
    for seed, steps in ((0, 700), (1, 300)):
        for label in ("Lc", "Lc Lp"):
            found = one | {
                "steps": steps + 200,
                "settings": settings(seed=seed, steps=steps, pose_steps=200, problems=500),
            }
            record["rows"][f"psb|{seed}|paper|{label}|pnp"] = found
    record["rows"]["psb|0|baselines|GOSMA|pose"] = one | {"settings": {"baseline_problems": 20, "test_seed": 0}}
    longer = one | {"steps": 9, "settings": {"weights": paper_tables.LONGER, "problems": 500, "test_seed": 0}}
    record["rows"][f"psb|0|training|{paper_tables.LONGER}|pnp"] = longer
    tables = paper_tables.tables(table1.TABLE, record)
    title, _, *lines = tables["psb-spread"].splitlines()
    assert title.startswith("| seeds 0, 1 | rotation, deg |")
    value = f"{one['rotation'][1][0]:.2g}"
    assert [line.split(" | ")[:2] for line in lines] == [
        [f"| {label}", f"{value}, {value}"] for label in ("Lc", "Lc Lp")
    ]
    assert "| GOSMA |" in tables["psb-baselines"]
    assert len(tables["psb-summary"].splitlines()) == 2 + 2  # the lowest seed
    parsed = []
    monkeypatch.setattr(table1, "measure", lambda options: parsed.append(options) or record)
    monkeypatch.setattr(paper_tables, "publish", lambda *_: None)
    for line in tables["commands"].splitlines()[1:-1]:
        words = shlex.split(line)
        assert words[:4] == ["python", "-m", "benchmarks", "table1"]
        monkeypatch.setattr("sys.argv", words[3:])
        table1.main()
    names = ("seed", "steps", "pose_steps", "problems", "our_problems", "baseline_problems")
    found = [[getattr(options, name) for name in names] for options in parsed]
    assert found == [[0, 700, 200, 500, 0, 20], [1, 300, 200, 500, 0, 20]]
    assert parsed[0].weights == [f"{paper_tables.LONGER}=CHECKPOINT"]


def test_a_row_keeps_its_provenance_and_is_compared_with_rows_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = partial(MeshDataModule, **SHAPES, cache_dir=str(tmp_path))
    for label, steps in {"Lc": 900, "Lc Lp": 900, "first": 700}.items():
        plant_steps(tmp_path / label / "checkpoints" / "last.ckpt", steps)
    trained = {label: Training(tmp_path / label, (), 1, 1) for label in ("first", "Lc", "Lc Lp")}
    file, calls = tmp_path / "record.json", []

    def known(name: str) -> Known:
        calls.append(name)
        return Known(10)

    def measure(*only: str, **other: int) -> dict[str, Any]:
        options = {"seed": 0, "test_seed": 0, "only": only, "sets": ("toy",), "published": False, "only_test": True}
        chosen = Namespace(**(options | other), run=tmp_path, output=file)
        methods = [
            Method("paper", label, partial(known, label), 4, {"steps": 900}, {"seed": chosen.seed})
            for label in ("Lc", "Lc Lp")
        ]
        return paper_tables.measure(
            table1.TABLE, trained, lambda _: methods, lambda _: data(seed=chosen.test_seed), chosen
        )

    monkeypatch.setattr("record.commit", lambda: "early")
    early = measure("paper Lc")["rows"]
    assert calls == ["Lc", "Lc Lp"]
    (tmp_path / "seed0" / "tests" / "toy" / "paper-Lc_Lp.jsonl").unlink()
    monkeypatch.setattr("record.commit", lambda: "late")
    record = measure("Lc Lp")
    assert calls == ["Lc", "Lc Lp", "Lc Lp"]
    assert record["rows"]["toy|0|paper|Lc|pnp"] == early["toy|0|paper|Lc|pnp"]
    assert [one["measured"]["commit"] for one in record["rows"].values()] == ["early", "late"]
    assert record["effects"]["toy|0|paper|Lc|Lc Lp|pnp"]["steps"] == [900, 900]
    text = file.read_text()
    measure("zzz")
    measure("paper Lc")
    assert (file.read_text(), len(calls)) == (text, 3)
    other = measure("paper", seed=1)["rows"]
    assert other["toy|1|paper|Lc|pnp"]["rotation"] == early["toy|0|paper|Lc|pnp"]["rotation"]  # the same problems
    shutil.rmtree(tmp_path / "seed0")
    assert list(measure("paper Lc Lp")["effects"]) == ["toy|1|paper|Lc|Lc Lp|pnp"]  # its other row is gone
    with pytest.raises(SystemExit, match="record.json has rows of the test seed 0; give another --output"):
        measure("paper", test_seed=1)


@pytest.mark.parametrize("benchmark", [table1, table2], ids=lambda module: module.__name__)
def test_the_seed_of_the_training_does_not_choose_the_test_problems(
    benchmark: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds, trainings = [], []
    monkeypatch.setattr(benchmark, "data_module", lambda root, seed, name: seeds.append(seed))
    monkeypatch.setattr(paper_tables, "publish", lambda *_: None)

    def measure(table: Table, trained: dict[str, Training], methods: object, data: Any, options: object) -> Any:
        data(table.sets[0])
        trainings.append(trained["Lc"])
        return {"rows": {}, "effects": {}}

    monkeypatch.setattr(paper_tables, "measure", measure)
    for seed, test_seed in (("5", "0"), ("0", "3")):
        words = ["--run", str(tmp_path), "--seed", seed, "--test_seed", test_seed]
        monkeypatch.setattr("sys.argv", ["benchmark", *words])
        benchmark.main()
    assert seeds == [0, 3]
    assert [one.folder.parent.name for one in trainings] == ["seed5", "seed0"]
    assert ["--data.seed=5" in one.arguments for one in trainings] == [True, False]


@pytest.mark.parametrize("benchmark", [table1, table2], ids=lambda module: module.__name__)
def test_a_quick_run_is_short_in_every_part_and_leaves_the_record_alone(
    benchmark: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = []
    monkeypatch.setattr(benchmark, "measure", lambda options: chosen.append(options) or {"rows": {}, "effects": {}})
    monkeypatch.setattr(paper_tables, "publish", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["benchmark", "--quick"])
    benchmark.main()
    (options,) = chosen
    trained = benchmark.trainings(options)
    folders = {one.folder: one.steps for one in trained.values()}
    assert sum(folders.values()) <= 700  # at 1 to 4 seconds a step; the branches have those of the common part too
    assert all(one.steps % one.epoch == 0 for one in trained.values())
    assert all(f"{options.run.name}/" in str(folder) and "quick" in options.run.name for folder in folders)
    assert options.output.parent == options.run
    assert options.problems * 3 + options.our_problems * 3 + options.baseline_problems * 3 * 30 <= 300  # seconds


def test_weights_from_a_file_stand_beside_the_packaged_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = shutil.copy(str(table1.checkpoint_path("procedural-euler")), tmp_path / "longer.ckpt")
    found = []
    monkeypatch.setattr(paper_tables, "publish", lambda *_: None)

    def measure(table: Table, trained: dict[str, Training], methods: Any, data: object, options: object) -> Any:
        found.extend(methods(table.sets[0]))
        return {"rows": {}, "effects": {}}

    monkeypatch.setattr(paper_tables, "measure", measure)
    command = ["table1", "--run", str(tmp_path), "--only_test", "--weights"]
    monkeypatch.setattr("sys.argv", [*command, f"{paper_tables.LONGER}={file}", f"paper-lc={file}"])
    table1.main()
    rows = {method.label: method for method in found if method.group == "training"}
    assert {paper_tables.LONGER, "paper-lc", "paper-lclp", "procedural-euler"} == set(rows)
    assert rows[paper_tables.LONGER].identity == rows["procedural-euler"].identity == rows["paper-lc"].identity
    assert rows["paper-lclp"].identity["weights"] != rows["paper-lc"].identity["weights"]
    assert (paper_tables.LONGER, "paper-lclp") in paper_tables.PAIRS["training"]
    monkeypatch.setattr("sys.argv", [*command, "longer"])
    with pytest.raises(SystemExit, match="--weights longer: longer is no file; write NAME=CHECKPOINT"):
        table1.main()


def test_headings_share_the_hypotheses_of_the_row_without() -> None:
    file = table1.checkpoint_path("procedural-euler")
    one, several = network(file), network(file, inference="headings")
    assert (one.headings, one.ransac.max_iterations) == (1, 1000)
    assert several.headings == 6
    assert several.headings * several.ransac.max_iterations in range(990, 1001)
    assert several.ransac.backend == one.ransac.backend == "opencv"


def test_the_row_of_all_scenes_counts_each_photo_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scene k has k + 1 photos at a depth of 10; the first one of each is right, all are off by 0.2 or 0.8."""
    monkeypatch.setattr(table2, "scene_depths", lambda _, indices: dict.fromkeys(indices, 10.0))

    def rows_of(file: Path, *_: object, solve: bool) -> list[Any]:
        assert not solve
        k = table2.SCENES.index(file.parent.name)
        return [row(i, rotation_error_deg=20.0 * (i > 0), translation_error=0.2 + 0.6 * (k % 2)) for i in range(k + 1)]

    monkeypatch.setattr(paper_tables, "solve_problems", rows_of)
    method = Method("paper", "Lc", nn.Identity, 20, {}, {"seed": 1})
    shared = {"steps": 5, "settings": {"steps": 5, "learning_rate": 1e-3}, "measured": {"commit": "c"}}
    estimate = row(0).estimate
    record: dict[str, Any] = {"effects": {}, "rows": {}}
    for k, scene in enumerate(table2.SCENES):
        own = figures(rows_of(tmp_path / scene / "x", solve=False), (10.0, 1.0))
        record["rows"][f"{scene}|1|paper|Lc|{estimate}"] = own | shared
        assert own["problems"] == k + 1
    options = Namespace(test_seed=0, run=tmp_path, seed=1, output=tmp_path / "record.json", published=False)
    table2.pool_scenes(record, lambda _: iter([method]), lambda _: None, options)  # type: ignore[arg-type,return-value]
    pooled = record["rows"][f"{table2.ALL}|1|paper|Lc|{estimate}"]
    assert pooled["problems"] == 55
    assert pooled["recall"][0] == pytest.approx(10 / 55, abs=1e-3)
    assert pooled["near"] == pytest.approx(5 / 55, abs=1e-3)  # 5 % of the depth are 0.5
    assert [record["rows"][f"{scene}|1|paper|Lc|{estimate}"]["near"] for scene in table2.SCENES[:3]] == [
        1.0, 0.0, round(1 / 3, 4)
    ]  # fmt: skip
    lines = table2.tables(record)["scenes"].splitlines()
    assert lines[2].startswith("| castle-P30 | 1 | 10 |")
    assert lines[-1].startswith("| all | 55 |")
    assert len(lines) == 2 + 11


def test_the_picture_has_a_curve_a_row_and_the_papers_quartiles() -> None:
    rows = [row(i, rotation_error_deg=float(i + 1), translation_error=0.1 * (i + 1)) for i in range(4)]
    rotation, translation = paper_tables.recall_picture({"Lc R": rows}, table1.TABLE).axes
    assert rotation.lines[0].get_xdata().tolist() == [1, 2, 3, 4]
    assert rotation.lines[0].get_ydata().tolist() == [25, 50, 75, 100]
    assert rotation.lines[1].get_xdata().tolist() == [5.49, 11.7, 20.0]
    assert translation.lines[1].get_xdata().tolist() == [0.04, 0.09, 0.20]
