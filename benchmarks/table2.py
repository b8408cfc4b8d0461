"""Table 2 of the paper: trains L_c and its fork L_c + L_p on photos of COLMAP models, and tests them on other scenes.

    python -m benchmarks table2 --data DATA            # hours; a run that was stopped goes on
    python -m benchmarks table2 --data DATA --quick    # 20 minutes, another folder, no page

DATA is a folder with a folder `colmap` of COLMAP models, those of `TRAINED` and `TESTED` (docs/data.md). The training
is configs/paper/megadepth.yaml but for data, steps, learning rate and normalised scene points (the scenes have
different units): first on drawn maps, `--drawn_steps` of each of `DRAWN_STAGES`, then on the photos of `TRAINED` but
one for validation, and after the switch on drawn maps again. Test landmarks are not in the training. Photos have up to
1,000 of the points that they see.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import paper_tables
from paper_tables import QUICK, Method, Table, Training, Weights
from record import ROOT
from torch import nn

from bpnp.datamodules import ColmapDataModule
from bpnp.models.baselines import GOSMA, RandomRansac, SoftPOSIT

TRAINED = ("castle-P30", "statue_of_liberty", "sceaux_castle_txt", "walkthrough", "walk_2", "walk_4", "walk_6")
TESTED = ("fountain-P11", "south_building", "tabletop")
TABLE = Table("table2", "megadepth", (10.0, 1.0), ("photos",))
FILE = ROOT / "benchmarks" / "table2.json"
POINTS = 1000
EPOCH = 18  # batches of the training photos of `TRAINED`; an epoch has no more
DRAWN_EPOCH = 90  # steps on drawn maps between checkpoints
SHORT = {"drawn_steps": [90, 90, 90, 90], "steps": 72, "pose_steps": 36, "epoch": EPOCH}  # of a quick run
BASELINES: dict[str, Callable[[], nn.Module]] = {
    "SoftPOSIT near the truth": partial(SoftPOSIT, start="near_truth"),
    "RANSAC": RandomRansac,
    "GOSMA": GOSMA,
}
DRAWN_STAGES = {  # points, learning rate, standard deviation of headings about that of a view, degrees (None: any)
    "drawn128": (128, 1e-3, None),
    "drawn256": (256, 1e-3, None),
    "near256": (256, 3e-4, 40),
    "near1000": (POINTS, 3e-4, 40),
}
# After the switch. The loss of translations is in scene units: 0.1 to 0.5 a metre, near those of the photos.
AFTER = ("num_points=512", "heading_deg=40", "scale_range=[0.1,0.5]")
DRAWN = ("outliers=0.0", "frame=y_down", "tilt_deg=8", "val_problems=48", "batch_size=16")


def data_module(root: Path, seed: int, _: str) -> ColmapDataModule:
    """All photos of the scenes that are left out."""
    scenes = [str(root / "colmap" / scene) for scene in TESTED]
    return ColmapDataModule(scenes, test_fraction=1.0, eval_max_points=POINTS, seed=seed)


def trainings(options: argparse.Namespace) -> dict[str, Training]:
    """On drawn maps, then on photos, and the two branches, on drawn maps again."""
    shared = (
        "--config=paper/megadepth", "--model.solver.features3d.normalise=true", f"--seed_everything={options.seed}",
    )  # fmt: skip
    folder = options.run / f"seed{options.seed}"
    maps = ("--data=bpnp.datamodules.SyntheticMapDataModule", *(f"--data.{option}" for option in DRAWN))
    seed, never = f"--data.seed={options.seed}", f"--pose_loss.start_epoch={paper_tables.NEVER}"
    stages: dict[str, Training] = {}
    weights: tuple[str, ...] = ()
    for (name, (points, rate, heading)), steps in zip(DRAWN_STAGES.items(), options.drawn_steps, strict=True):
        headings = () if heading is None else (f"--data.heading_deg={heading}",)
        drawn = (*maps, seed, f"--model.learning_rate={rate}", never, f"--data.num_points={points}", *headings)
        stages[name] = Training(folder / name, (*shared, *drawn, *weights), steps, DRAWN_EPOCH)
        weights = (f"{paper_tables.WEIGHTS_OPTION}{stages[name].checkpoint}",)
    roots = json.dumps([str(options.data / "colmap" / scene) for scene in TRAINED])
    photos = (f"--data.root={roots}", "--data.test_fraction=0", "--data.val_fraction=0.15")
    rate_then = f"--model.learning_rate={options.learning_rate}"
    after = (*shared, *maps, *(f"--data.{option}" for option in AFTER), rate_then, seed)
    return stages | paper_tables.branches(folder, (*shared, *photos, rate_then, seed, *weights), options, after)


def methods(options: argparse.Namespace, trained: dict[str, Training]) -> Iterator[Method]:
    """Networks with the paper's inference and with ours, then other methods."""
    drawn = {"drawn_steps": list(options.drawn_steps)}
    branches = paper_tables.branch_weights(trained, options)
    weights = [Weights(one.group, one.label, one.checkpoint, one.settings | drawn) for one in branches]
    yield from paper_tables.network_methods(weights, options)
    yield from paper_tables.other_methods(BASELINES, options)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    trained = trainings(options)
    data = partial(data_module, options.data, options.test_seed)
    return paper_tables.measure(TABLE, trained, partial(methods, options, trained), data, options)


def tables(record: dict[str, Any]) -> dict[str, str]:
    return paper_tables.tables(TABLE, record)


def sheets(record: dict[str, Any]) -> dict[str, str]:
    return paper_tables.sheets(record)


def main() -> None:
    run = ROOT / "runs" / "table2"
    parser = paper_tables.options(__doc__, file=FILE, run=run, sets=TABLE.sets, steps=1980, pose_steps=396, epoch=EPOCH)
    default = (1800, 1800, 900, 180)
    parser.add_argument(
        "--drawn_steps",
        type=int,
        nargs=len(DRAWN_STAGES),
        default=default,
        help="of each stage on drawn maps (default: %(default)s)",
    )
    paper_tables.run(TABLE, parser, measure, QUICK | SHORT)
