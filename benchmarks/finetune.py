"""Fine-tuning without labels (section 5 of the paper): packaged weights before and after 120 steps on new data.

    python -m benchmarks finetune --data DATA    # 10 CPU minutes

DATA is a folder with the COLMAP models `colmap/<scene>` and the shapes of `modelnet10` (docs/data.md). The loss is the
reprojection error of the pose that the network finds (configs/paper/finetune_reprojection.yaml). Poses and matches only
measure. Every second photo of a scene is tuned on, the others are tested too. On ModelNet10, shapes of the training
split are tuned on, those of the test split are tested.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lightning import LightningDataModule
from pages import is_default, markdown, publish
from paper_tables import (
    MEASURES,
    PICTURES,
    Row,
    check_beginning,
    digest,
    draw_recall,
    figures,
    finish_recall,
    network,
    provenance,
    sheet,
    solve_problems,
    trained_steps,
)
from record import DATA, ROOT, write_json

from bpnp.datamodules import ColmapDataModule, MeshDataModule
from bpnp.datamodules.colmap.model_files import find_scenes
from bpnp.datamodules.colmap.module import ColmapSource
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.stored import write_problems
from bpnp.models.weights import checkpoint_path
from bpnp.report.figure_files import save_figure
from bpnp.report.figures import line_style
from bpnp.report.results import ProblemRow

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WEIGHTS = "procedural-so3"
SCENES = ("fountain-P11", "statue_of_liberty")
SHAPES = "modelnet10"
POINTS = 128
TEST_SHAPES = 100
STEPS = 120
RECALL = (10.0, 1.0)  # degrees, scene units
FILE = ROOT / "benchmarks" / "finetune.json"
PICTURE = PICTURES / "finetune.png"
TUNED, HELD_OUT = "tuned on", "not tuned on"
Rows = Mapping[str, Sequence[ProblemRow]]  # by "<data>|<part>|<before or after>|<estimate>"


@dataclass(frozen=True)
class Target:
    """Data to tune to: options of `bpnp fit`, and a data module for each part that is tested."""

    name: str
    arguments: tuple[str, ...]
    parts: dict[str, Callable[[], LightningDataModule]]


def scene_target(model: Path, folder: Path) -> Target:
    """Every second photo of a COLMAP model to tune on, and all to test, in two parts of a store in `folder`."""
    store, parts = folder / "photos", (TUNED, HELD_OUT)
    if not store.is_dir():
        (models,) = find_scenes(model).values()
        source = ColmapSource([read_reconstruction(path, name=name) for name, path in models.items()])
        write_problems(store, ((parts[i % 2], source.problem(i)) for i in range(len(source.images))))
    arguments = (f"--data.root={store}", f"--data.train_scenes={json.dumps([TUNED])}")
    root = str(store)
    tests: dict[str, Callable[[], LightningDataModule]] = {
        part: partial(ColmapDataModule, root, test_scenes=[part], val_fraction=0.0, eval_max_points=POINTS)
        for part in parts
    }
    return Target(model.name, arguments, tests)


def shape_target(root: Path) -> Target:
    """Shapes of the training split to tune on, those of the test split to test, in the paper's protocol."""
    options = {"root": str(root), "num_points": POINTS, "pool_size": 1000, "test_problems": TEST_SHAPES}
    arguments = (
        "--data=bpnp.datamodules.MeshDataModule", f"--data.root={root}", f"--data.num_points={POINTS}",
        "--data.pool_size=1000", "--data.fresh_views=true", "--data.train_problems=480", "--data.val_fraction=0.05",
        "--data.batch_size=4",
    )  # fmt: skip
    return Target(root.name, arguments, {HELD_OUT: partial(MeshDataModule, **options)})  # type: ignore[arg-type]


def targets(options: argparse.Namespace) -> Iterator[Target]:
    for name in options.scenes:
        yield scene_target(options.data / "colmap" / name, options.run / name)
    for name in options.shapes:
        yield shape_target(options.data / name)


def fine_tune(target: Target, folder: Path) -> Path:
    """Fine-tune the weights to the data, as far as that was not done, and return the checkpoint."""
    checkpoint = folder / "checkpoints" / "last.ckpt"
    check_beginning(folder, target.arguments, [checkpoint_path(WEIGHTS)])
    if (done := trained_steps(checkpoint)) < STEPS:
        resumed = ["--ckpt_path", "last"] if done else []
        command = [
            sys.executable, "-m", "bpnp", "fit", "--config=paper/finetune_reprojection", *target.arguments,
            f"--trainer.max_steps={STEPS}", f"--trainer.default_root_dir={folder}",
            "--trainer.enable_progress_bar=false", *resumed,
        ]  # fmt: skip
        print(" ".join(command[1:]), flush=True)
        subprocess.run(command, check=True)
    return checkpoint


def measure(options: argparse.Namespace, record: dict[str, Any]) -> dict[str, list[ProblemRow]]:
    """Fine-tune to each target, test before and after, and write the record; return the rows of all problems."""
    found: dict[str, list[ProblemRow]] = {}
    for target in targets(options):
        folder = options.run / target.name
        after = fine_tune(target, folder)
        for part, data in target.parts.items():
            for when, checkpoint in {"before": checkpoint_path(WEIGHTS), "after": after}.items():
                file = folder / f"{part}-{when}.jsonl".replace(" ", "_")
                identity = {"weights": digest(checkpoint)}
                rows = solve_problems(file, partial(network, checkpoint), data(), sys.maxsize, identity)
                steps = 0 if when == "before" else trained_steps(after)
                for estimate in ("ransac", "pnp"):
                    key = f"{target.name}|{part}|{when}|{estimate}"
                    found[key] = [row for row in rows if row.estimate == estimate]
                    measured = {"steps": steps, "measured": provenance(file)}
                    record["rows"][key] = figures(found[key], RECALL) | measured
                    print(f"{key}: {record['rows'][key]}", flush=True)
        write_json(options.output, record)
    return found


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the table of the medians of all data, before and after."""
    lines = []
    for key in record["rows"]:
        name, part, when, estimate = key.split("|")
        if when == "before":
            keys = (f"{name}|{part}|{when}|{estimate}" for when in ("before", "after"))
            rows = [Row(0, 0, key, record["rows"][key]) for key in keys]
            cells = [row.cell(error) for error in ("rotation", "recall") for row in rows]
            lines.append([f"{name}, {part}, `{estimate}`", str(rows[0].figures["problems"]), *cells])
    measures = (MEASURES[0], f"% within {RECALL[0]:g} deg, {RECALL[1]:g}")
    heads = [head for measure in measures for head in (f"{measure}, before", "after")]
    return {"data": markdown(("", "problems", *heads), lines)}


def sheets(record: dict[str, Any]) -> dict[str, str]:
    return {"": sheet(("data", "part", "when", "estimate"), record["rows"])}


def recall_picture(rows: Rows) -> "Figure":
    """Fraction of the problems that were not tuned on within a rotation error, a plot for each data set."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(key.split("|")[0] for key in rows))
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names), sharey=True)), names, strict=True):
        for i, estimate in enumerate(("pnp", "ransac")):
            for k, when in enumerate(("after", "before")):
                errors = [row.rotation_error_deg for row in rows[f"{name}|{HELD_OUT}|{when}|{estimate}"]]
                draw_recall(axes, errors, label=f"{estimate}, {when}", **line_style(i, k))
        axes.set(xlabel="rotation error, degrees", xscale="log", xlim=(0.01, 180), title=name)
    return finish_recall(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with colmap and modelnet10")
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "finetune", help="(default: %(default)s)")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), help="COLMAP models (default: %(default)s)")
    parser.add_argument("--shapes", nargs="*", default=[SHAPES], help="folders of shapes (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    parser.add_argument("--picture", type=Path, default=PICTURE, help="(default: %(default)s)")
    chosen = parser.parse_args()
    record: dict[str, Any] = json.loads(chosen.output.read_text()) if chosen.output.is_file() else {}
    record = {"rows": record.get("rows", {})}
    torch.set_num_threads(1)
    rows = measure(chosen, record)
    is_whole = is_default(parser, chosen) and rows.keys() == record["rows"].keys()
    if is_whole or not is_default(parser, chosen, "picture"):  # the picture of the page has all data
        save_figure(recall_picture(rows), chosen.picture)
    publish("finetune", chosen.output)
