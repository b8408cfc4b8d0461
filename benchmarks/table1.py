"""Table 1 of the paper: trains L_c and its fork L_c + L_p on ModelNet10, and tests them and the baselines.

    python -m benchmarks table1 --data DATA                 # hours; a run that was stopped goes on
    python -m benchmarks table1 --data DATA --steps 5000    # a longer training goes on from a shorter one
    python -m benchmarks table1 --data DATA --seed 1        # another training, tested on the same problems
    python -m benchmarks table1 --data DATA --quick         # 20 minutes, another folder, no page

DATA is a folder with the data sets `modelnet10` and `psb` (docs/data.md). The training is configs/paper/modelnet40.yaml
but for data, steps and learning rate. At step `--steps` it forks: one branch goes on with L_c, the other with
L_c + L_p, `--pose_steps` each. Tests keep every problem's result in the folder of the run; the figures go to
benchmarks/table1.json, each row with its settings, and from there to docs/table1.md, with the commands that give them.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import paper_tables
from paper_tables import LONGER, Method, Table, Training, Weights
from record import ROOT
from torch import nn

from bpnp.datamodules import MeshDataModule
from bpnp.models.baselines import GOSMA, RandomRansac, SoftPOSIT
from bpnp.models.weights import checkpoint_path, pretrained_names

SETS = {"modelnet10": 500, "psb": 100}  # test shapes
TABLE = Table("table1", "modelnet40", (15.0, 0.5), tuple(SETS))
FILE = ROOT / "benchmarks" / "table1.json"
PACKAGED = ("procedural-euler", "paper-lc", "paper-lclp")
BASELINES: dict[str, Callable[[], nn.Module]] = {"SoftPOSIT": SoftPOSIT, "RANSAC": RandomRansac, "GOSMA": GOSMA}


def data_module(root: Path, seed: int, name: str) -> MeshDataModule:
    """The paper's protocol: 1,000 fixed points a shape, one view of each test shape."""
    settings = {"num_points": 1000, "pool_size": 1000, "test_problems": SETS[name], "seed": seed}
    return MeshDataModule(str(root / name), **settings)  # type: ignore[arg-type]


def trainings(options: argparse.Namespace) -> dict[str, Training]:
    """The common part, and the two branches."""
    arguments = (
        "--config=paper/modelnet40", f"--data.root={options.data / 'modelnet10'}", "--data.val_problems=48",
        f"--model.learning_rate={options.learning_rate}", f"--seed_everything={options.seed}",
        f"--data.seed={options.seed}",
    )  # fmt: skip
    return paper_tables.branches(options.run / f"seed{options.seed}", arguments, options)


def methods(options: argparse.Namespace, trained: dict[str, Training], _: str) -> Iterator[Method]:
    """Networks with the paper's inference and with ours, then other methods."""
    known = {
        name: Weights("training", name, checkpoint_path(name), {}) for name in PACKAGED if name in pretrained_names()
    }
    weights = [*paper_tables.branch_weights(trained, options), *(known | given_weights(options.weights)).values()]
    yield from paper_tables.network_methods(weights, options)
    yield from paper_tables.other_methods(BASELINES, options)


def given_weights(words: list[str]) -> dict[str, Weights]:
    """Parse `NAME=CHECKPOINT` words; a packaged name is tested with this file instead."""
    found = {}
    for word in words:
        name, _, file = word.partition("=")
        if not Path(file).is_file():
            sys.exit(f"--weights {word}: {file or word} is no file; write NAME=CHECKPOINT")
        found[name] = Weights("training", name, Path(file), {"weights": name})
    return found


def measure(options: argparse.Namespace) -> dict[str, Any]:
    trained = trainings(options)
    data = partial(data_module, options.data, options.test_seed)
    return paper_tables.measure(TABLE, trained, partial(methods, options, trained), data, options)


def tables(record: dict[str, Any]) -> dict[str, str]:
    return paper_tables.tables(TABLE, record)


def sheets(record: dict[str, Any]) -> dict[str, str]:
    return paper_tables.sheets(record)


def main() -> None:
    run = ROOT / "runs" / "table1"
    parser = paper_tables.options(__doc__, file=FILE, run=run, sets=TABLE.sets, steps=3000, pose_steps=600, epoch=100)
    parser.add_argument(
        "--weights", nargs="*", default=[], metavar="NAME=CHECKPOINT",
        help=f"more rows of the group of the packaged weights; {LONGER!r} is compared with paper-lclp",
    )  # fmt: skip
    paper_tables.run(TABLE, parser, measure)
