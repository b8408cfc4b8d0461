"""Short trainings with one of our additions to the paper's training each.

    python -m benchmarks additions --data DATA    # 2 CPU hours; a run that was stopped goes on

DATA is a folder with the shapes of `modelnet10` (docs/data.md). The training is configs/paper/modelnet40.yaml from the
start, with L_c alone, but for the data, `POINTS` points a shape, and a learning rate of 1e-4. Each row has one of
`ADDITIONS`, the last all that we use. All have the same number of points in total: more points a step mean fewer steps.
They are tested as Table 1: 1,000 points, and the paper's inference.
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
from paper_weights import ADAM, SETTINGS, SOLVER
from record import DATA, ROOT, write_json
from table1 import SETS, TABLE, data_module

from bpnp.report.results import ProblemRow

EPOCH = 50  # steps between checkpoints
POINTS, BATCH = 256, 16
FILE = ROOT / "benchmarks" / "additions.json"
TESTED = ("pnp", "ransac")  # of the paper's inference

FEATURES = tuple(word for word in SETTINGS if word.startswith(f"{SOLVER}.features"))
LIKELIHOOD = ("--model.matching_loss=likelihood",)
DRAWN = ("--data.root=null", "--data.train_shapes=4000", "--data.procedural_kind=aligned", "--data.fresh_views=true")
MUON = ("--optimizer=bpnp.training.Muon", "--optimizer.lr=1e-2", f"--optimizer.adam_lr={ADAM * 1e-2}")
FEW_FIRST = ((64, 0.5), (POINTS, 0.5))


@dataclass(frozen=True)
class Addition:
    """A training."""

    arguments: tuple[str, ...] = ()
    # Points of each problem and fraction of all points of the training, one after the other.
    parts: tuple[tuple[int, float], ...] = ((POINTS, 1.0),)
    batch: int = BATCH
    schedule: bool = False  # the rate rises over 50 steps, and falls by a half cosine in the second half


NONE = "none"
ADDITIONS = {
    NONE: Addition(),
    "1,000 points, as in the paper": Addition(parts=((1000, 1.0),)),
    "64 points first": Addition(parts=FEW_FIRST),
    "batches of 8": Addition(batch=8),
    "learning rate 1e-3, with a schedule": Addition(("--model.learning_rate=1e-3",), schedule=True),
    "Muon, with a schedule": Addition(MUON, schedule=True),
    "likelihood": Addition(LIKELIHOOD),
    "centred features, scaled points": Addition(FEATURES),
    "drawn shapes, new views": Addition(DRAWN),
    "all of ours": Addition((*MUON, *LIKELIHOOD, *FEATURES, *DRAWN), parts=FEW_FIRST, batch=8, schedule=True),
}


def train(name: str, options: argparse.Namespace) -> Path:
    """Train with an addition, as far as that was not done, and return the checkpoint."""
    chosen = ADDITIONS[name]
    budget = options.steps * POINTS * BATCH  # points of each side
    lengths = [EPOCH * max(1, round(part * budget / (points * chosen.batch * EPOCH))) for points, part in chosen.parts]
    total, end = sum(lengths), 0
    arguments = (
        "--config=paper/modelnet40", f"--data.root={options.data / 'modelnet10'}", f"--data.batch_size={chosen.batch}",
        "--model.learning_rate=1e-4", f"--seed_everything={options.seed}", f"--data.seed={options.seed}",
        "--trainer.limit_val_batches=0", f"--pose_loss.start_epoch={NEVER}", *chosen.arguments,
    )  # fmt: skip
    if chosen.schedule:
        decay = (f"--model.decay_start={total - total // 2}", f"--model.decay_steps={total // 2}")
        arguments += ("--model.warmup_steps=50", *decay)
    checkpoint: Path | None = None
    for (points, _), steps in zip(chosen.parts, lengths, strict=True):
        end += steps
        folder = options.run / f"seed{options.seed}" / f"{list(ADDITIONS).index(name)}-{points}"
        training = Training(folder, (*arguments, f"--data.num_points={points}"), end, EPOCH, checkpoint)
        checkpoint = training.run()
    assert checkpoint is not None
    return checkpoint


def measure(options: argparse.Namespace, record: dict[str, Any]) -> None:
    """Train and test with each addition, and write the record after each."""
    data = data_module(options.data, 0, "modelnet10")
    found: dict[str, dict[str, Sequence[ProblemRow]]] = {}
    for name in ADDITIONS:
        checkpoint = train(name, options)
        file = options.run / f"seed{options.seed}" / f"{list(ADDITIONS).index(name)}.jsonl"
        build = partial(network, checkpoint)
        rows = solve_problems(file, build, data, options.problems, {"weights": digest(checkpoint)})
        steps = trained_steps(checkpoint)
        settings = {"steps": options.steps, "seed": options.seed}
        found[name] = {key: [row for row in rows if row.estimate == key] for key in TESTED}
        for estimate, own in found[name].items():
            key = f"{options.seed}|{name}|{estimate}"
            row = {"steps": steps, "settings": settings, "measured": provenance(file)}
            record["rows"][key] = figures(own, TABLE.recall) | row
            if name != NONE:
                compared = {"steps": [record["rows"][f"{options.seed}|{NONE}|{estimate}"]["steps"], steps]}
                record["effects"][key] = effect(found[NONE][estimate], own, TABLE.recall) | compared
            print(f"{key}: {record['rows'][key]}", flush=True)
        write_json(options.output, record)


def tables(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the table of the medians of both estimates with each addition."""
    seeds = sorted({int(key.split("|")[0]) for key in record["rows"]})
    lines = []
    for name, seed in product(ADDITIONS, seeds):
        found = [record["rows"].get(f"{seed}|{name}|{estimate}") for estimate in TESTED]
        if None not in found:
            rows = [Row(place, seed, name, figures) for place, figures in enumerate(found)]
            cells = [row.cell(error) for error in ("rotation", "recall") for row in rows]
            label = name + (f", seed {seed}" if len(seeds) > 1 else "")
            lines.append([label, f"{rows[0].figures['steps']:,}", *cells])
    heads = [f"{measure}{ESTIMATES[one]}" for measure in (MEASURES[0], recall_name(TABLE)) for one in TESTED]
    return {"rows": markdown(("", "steps", *heads), lines)}


def sheets(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows, and their differences from the row without an addition, in CSV."""
    keys = ("seed", "row", "estimate")
    return {"": sheet(keys, record["rows"]), "-effects": sheet(keys, record["effects"])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with modelnet10")
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "additions", help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the training (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=400, help="of the row without addition (default: %(default)s)")
    parser.add_argument("--problems", type=int, default=SETS["modelnet10"], help="at most (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    chosen = parser.parse_args()
    record = read_record(chosen.output)
    torch.set_num_threads(1)
    measure(chosen, record)
    publish("additions", chosen.output)
