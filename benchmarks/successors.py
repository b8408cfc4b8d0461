"""Losses and a network of later and concurrent work as parts of a BPnPNet: same start, same steps, same shapes.

    python -m benchmarks successors    # half an hour of one CPU core; a run that was stopped goes on

The data are those of configs/quickstart.yaml: drawn shapes with 64 points, 200 of them for the test, which has the
paper's inference. The losses go on from the packaged weights procedural-euler, which saw no pose loss, at the learning
rate of the quickstart. The networks start from random weights, with L_c alone, at a learning rate of 1e-3.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import torch
from pages import markdown, publish
from paper_tables import (
    ESTIMATES,
    MEASURES,
    NEVER,
    Row,
    Table,
    Training,
    digest,
    effect,
    figures,
    network,
    provenance,
    read_record,
    recall_name,
    sheet,
    solve_problems,
    trained_steps,
)
from record import ROOT, write_json

from bpnp.datamodules import MeshDataModule
from bpnp.models.weights import checkpoint_path
from bpnp.report.results import ProblemRow

EPOCH = 50  # steps between checkpoints
START = "procedural-euler"
PROBLEMS = 200  # test shapes
TABLE = Table("successors", "modelnet40", (15.0, 0.5), ("shapes",))
TESTED = ("pnp", "ransac")
FILE = ROOT / "benchmarks" / "successors.json"
POSED = "--pose_loss.start_epoch=0"
ALONE = f"--pose_loss.start_epoch={NEVER}"
LIMITS = "--model.pose_loss=bpnp.training.PoseLoss"


@dataclass(frozen=True)
class Successor:
    """A training."""

    arguments: tuple[str, ...] = ()
    compared: str = ""  # name of the training that it is compared with


LC, NETWORK = "Lc", "BPnPNet"
LOSSES = {
    LC: Successor((ALONE,)),
    "Lc, the pose alone": Successor((ALONE, "--model.correspondence_angle=0.01"), LC),
    "Lc + Lp": Successor((POSED,), LC),
    "Lc + Lp, limited": Successor(
        (POSED, LIMITS, "--model.pose_loss.max_rotation=1.5707963", "--model.pose_loss.max_translation=1"), LC
    ),
    "Lc + EPro-PnP": Successor((POSED, "--config=successors/monte_carlo"), LC),
    "Lc + MinCD-PnP": Successor((POSED, "--config=successors/chamfer"), LC),
}
NETWORKS = {
    NETWORK: Successor((ALONE,)),
    "Liu et al.": Successor((ALONE, "--config=successors/knn"), NETWORK),
}


def train(name: str, options: argparse.Namespace) -> Path:
    """Train a row, as far as that was not done, and return the checkpoint."""
    losses = name in LOSSES
    chosen, steps = (LOSSES | NETWORKS)[name], options.steps if losses else options.network_steps
    rate = "1e-4" if losses else "1e-3"
    configs = [word for word in chosen.arguments if word.startswith("--config")]
    others = [word for word in chosen.arguments if word not in configs]
    arguments = (
        "--config=quickstart", *configs, f"--model.learning_rate={rate}", "--model.decay_start=null",
        "--trainer.limit_val_batches=0", f"--seed_everything={options.seed}", f"--data.seed={options.seed}",
        *([f"--model.weights={START}"] if losses else []), *others,
    )  # fmt: skip
    folder = options.run / f"seed{options.seed}" / file_name(name)
    return Training(folder, arguments, steps, EPOCH).run()


def file_name(name: str) -> str:
    """Return the name of a row as that of a file."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def measure(options: argparse.Namespace, record: dict[str, Any]) -> None:
    """Train and test each row, and write the record after each."""
    data = MeshDataModule(None, num_points=64, val_shapes=64, test_shapes=PROBLEMS)
    found: dict[str, dict[str, Sequence[ProblemRow]]] = {}
    for name, chosen in ({"start": Successor()} | LOSSES | NETWORKS).items():
        checkpoint = checkpoint_path(START) if name == "start" else train(name, options)
        file = options.run / f"seed{options.seed}" / f"{file_name(name)}.jsonl"
        rows = solve_problems(
            file, partial(network, checkpoint), data, options.problems, {"weights": digest(checkpoint)}
        )
        steps = 0 if name == "start" else trained_steps(checkpoint)
        found[name] = {key: [row for row in rows if row.estimate == key] for key in TESTED}
        for estimate, own in found[name].items():
            key = f"{options.seed}|{name}|{estimate}"
            measured = {"steps": steps, "settings": {"seed": options.seed}, "measured": provenance(file)}
            record["rows"][key] = figures(own, TABLE.recall) | measured
            if chosen.compared:
                record["effects"][key] = effect(found[chosen.compared][estimate], own, TABLE.recall)
            print(f"{key}: {record['rows'][key]}", flush=True)
        write_json(options.output, record)


def tables(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of the losses and of the networks: medians and recalls of both estimates."""
    seeds = sorted({int(key.split("|")[0]) for key in record["rows"]})
    heads = [
        f"{measure}{ESTIMATES[one]}" for measure in (*MEASURES[:2], recall_name(TABLE)) for one in TESTED
    ]  # fmt: skip
    result = {}
    for part, names in {"losses": ["start", *LOSSES], "networks": list(NETWORKS)}.items():
        lines = []
        for name, seed in product(names, seeds):
            found = [record["rows"].get(f"{seed}|{name}|{estimate}") for estimate in TESTED]
            if None not in found:
                rows = [Row(place, seed, name, figures) for place, figures in enumerate(found)]
                cells = [row.cell(error) for error in ("rotation", "translation", "recall") for row in rows]
                label = name + (f", seed {seed}" if len(seeds) > 1 else "")
                lines.append([label, f"{rows[0].figures['steps']:,}", *cells])
        result[part] = markdown(("", "steps", *heads), lines)
    return result


def sheets(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows, and their differences from those that they are compared with, in CSV."""
    keys = ("seed", "row", "estimate")
    return {"": sheet(keys, record["rows"]), "-effects": sheet(keys, record["effects"])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "successors", help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the training (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=100, help="with each loss (default: %(default)s)")
    parser.add_argument("--network_steps", type=int, default=300, help="of each network (default: %(default)s)")
    parser.add_argument("--problems", type=int, default=PROBLEMS, help="of the test, at most (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    chosen = parser.parse_args()
    record = read_record(chosen.output)
    torch.set_num_threads(1)
    measure(chosen, record)
    publish("successors", chosen.output)
