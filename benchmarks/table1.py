"""Table 1 of the paper: trains L_c and its fork L_c + L_p on ModelNet10, and tests them and the baselines.

    python -m benchmarks table1                            # hours; a run that was stopped goes on
    python -m benchmarks table1 --steps 5000               # a longer training goes on from a shorter one
    python -m benchmarks table1 --quick                    # 20 minutes, another folder, no page
    python -m benchmarks table1 --check                    # whether docs/table1.md is what the record says

The training is configs/paper/modelnet40.yaml but for data, steps and learning rate. At step `--steps` it forks: one
branch goes on with L_c, the other with L_c + L_p, `--pose_steps` each. Tests keep every problem's result in the folder
of the run; the figures go to benchmarks/table1.json and from there to docs/table1.md.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from paper_tables import (
    Training,
    effect,
    effect_head,
    effect_text,
    figures,
    fill_pages,
    head,
    network,
    printed_rows,
    row_text,
    solve_problems,
    trained_steps,
)
from record import DATA, ROOT, write
from torch import nn

from bpnp.datamodules import MeshDataModule
from bpnp.models import Search
from bpnp.models.baselines import GOSMA, RandomRansac, SoftPOSIT
from bpnp.models.weights import checkpoint_path, pretrained_names
from bpnp.report.results import ProblemRow

FILE, PAGES = ROOT / "benchmarks" / "table1.json", (ROOT / "docs" / "table1.md", ROOT / "README.md")
RECALL = (15.0, 0.5)  # degrees, scene units
SETS = {"modelnet10": 500, "psb": 100}  # test shapes
ESTIMATES = {"pnp": "", "ransac": " R", "refined": ", refined"}
BASELINES: dict[str, Callable[[], nn.Module]] = {
    "SoftPOSIT": SoftPOSIT,
    "RANSAC": RandomRansac,
    "GOSMA": GOSMA,
    "search": partial(Search, time_limit=10.0),
}


@dataclass(frozen=True)
class Method:
    """A solver of the table: its group, its label, and what its results depend on."""

    group: str
    label: str
    build: Callable[[], nn.Module]
    limit: int
    identity: dict[str, Any]

    @property
    def file(self) -> str:
        return f"{self.group}-{self.label}".replace(" ", "_").replace(",", "")


def data_module(root: Path, name: str, seed: int) -> MeshDataModule:
    """The paper's protocol: 1,000 fixed points a shape, one view of each test shape."""
    known = {"num_points": 1000, "pool_size": 1000, "test_problems": SETS[name], "seed": seed}
    return MeshDataModule(str(root / name), **known)  # type: ignore[arg-type]


def trainings(options: argparse.Namespace) -> dict[str, Training]:
    """The common part, and the two branches."""
    folder = options.run / f"seed{options.seed}"
    arguments = (
        "--config=paper/modelnet40", f"--data.root={options.data / 'modelnet10'}", "--data.val_problems=48",
        f"--model.learning_rate={options.learning_rate}", f"--seed_everything={options.seed}",
        f"--data.seed={options.seed}",
    )  # fmt: skip
    epoch, end = options.epoch, options.steps + options.pose_steps
    first = Training(folder / "lc", arguments, options.steps, epoch)
    posed = (*arguments, f"--pose_loss.start_epoch={options.steps // epoch}")
    branch = f"from{options.steps}"
    return {
        "first": first,
        "Lc": Training(folder / f"lc-{branch}", arguments, end, epoch, first.checkpoint),
        "Lc Lp": Training(folder / f"lclp-{branch}", posed, end, epoch, first.checkpoint),
    }


def methods(options: argparse.Namespace, trained: dict[str, Training]) -> Iterator[Method]:
    """Networks with the paper's inference and with ours, then baselines."""
    branches = {label: trained[label].checkpoint for label in ("Lc", "Lc Lp")}
    weights = [("paper", label, checkpoint) for label, checkpoint in branches.items() if checkpoint.is_file()]
    packaged = [name for name in ("procedural-euler", "paper-lc", "paper-lclp") if name in pretrained_names()]
    weights += [("training", name, checkpoint_path(name)) for name in packaged]
    for ours in (False, True):
        for kind, label, checkpoint in weights:
            group = f"{kind}, our inference" if ours else kind
            identity = {"steps": trained_steps(checkpoint), "bytes": checkpoint.stat().st_size, "ours": ours}
            build = partial(network, checkpoint, ours=ours)
            limit = min(options.problems, options.our_problems) if ours else options.problems
            yield Method(group, label, build, limit, identity)
    for name, baseline in BASELINES.items():
        limit = options.problems if name == "search" else options.baseline_problems
        limit = min(limit, options.our_problems) if name == "search" else limit
        yield Method("baselines", name, baseline, limit, {"time_limit": 10 if name == "search" else 30})


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Test all methods on all sets; the record is written after each."""
    trained = trainings(options)
    for one in trained.values():
        if not options.only_test:
            one.run()
    record: dict[str, Any] = json.loads(options.output.read_text()) if options.output.is_file() else {}
    record = {key: record.get(key, {}) for key in ("rows", "effects", "training")}
    record["training"][f"seed {options.seed}"] = {
        label: trained_steps(one.checkpoint) for label, one in trained.items() if one.checkpoint.is_file()
    } | {"learning_rate": options.learning_rate, "switch": options.steps}
    for name in options.sets:
        found: dict[str, list[ProblemRow]] = {}
        for method in methods(options, trained):
            if not any(part in f"{method.group} {method.label}" for part in options.only):
                continue
            file = options.run / f"seed{options.seed}" / "tests" / name / f"{method.file}.jsonl"
            data = data_module(options.data, name, options.seed)
            rows = solve_problems(file, method.build, data, method.limit, method.identity)
            for estimate in dict.fromkeys(row.estimate for row in rows):
                key = f"{name}|{options.seed}|{method.group}|{method.label}|{estimate}"
                chosen = [row for row in rows if row.estimate == estimate]
                found[f"{method.group}|{method.label}|{estimate}"] = chosen
                record["rows"][key] = figures(chosen, RECALL)
                print(f"{key}: {record['rows'][key]}", flush=True)
            for estimate in ("pnp", "ransac"):
                pair = [found.get(f"paper|{label}|{estimate}") for label in ("Lc", "Lc Lp")]
                if pair[0] and pair[1]:
                    record["effects"][f"{name}|{options.seed}|{estimate}"] = effect(pair[0], pair[1], RECALL)
            write(options.output, record)
    return record


def tables(record: dict[str, Any]) -> dict[str, str]:
    """By name, the Markdown of each table: the rows of a set and a group, the effect of L_p, the trainings."""
    result: dict[str, str] = {}
    lowest = min((int(key.split("|")[1]) for key in record["rows"]), default=0)
    lines: dict[str, list[tuple[int, str]]] = {}
    for key, found in record["rows"].items():
        name, seed, group, label, estimate = key.split("|")
        if int(seed) == lowest:
            place = list(ESTIMATES).index(estimate) if estimate in ESTIMATES else 0
            table = f"{name}-{group}".replace(", ", "-").replace(" ", "-")
            lines.setdefault(table, []).append((place, row_text(label + ESTIMATES.get(estimate, ""), found)))
    printed = list(printed_rows("modelnet40"))
    for table, rows in lines.items():
        beside = printed[3:] if table.endswith("-paper") else printed[:3] if table.endswith("-baselines") else []
        result[table] = (
            head(RECALL) + "".join(text for _, text in sorted(rows, key=lambda row: row[0])) + "".join(beside)
        )
    for name in SETS:
        of_set = {
            key.split("|")[2]: found for key, found in record["effects"].items() if key.startswith(f"{name}|{lowest}|")
        }
        named = {"pnp": "Lc Lp minus Lc", "ransac": "Lc Lp R minus Lc R"}
        if of_set:
            texts = (effect_text(named[estimate], of_set[estimate]) for estimate in named if estimate in of_set)
            result[f"{name}-effect"] = effect_head(RECALL) + "".join(texts)
    names = ("training", "steps until the switch", "steps of Lc", "steps of Lc Lp", "learning rate")
    trained = [
        (seed, one["switch"], one.get("Lc", 0), one.get("Lc Lp", 0), f"{one['learning_rate']:g}")
        for seed, one in record["training"].items()
    ]
    cells = [names, ["---"] * len(names), *trained]
    result["training"] = "".join(f"| {' | '.join(map(str, row))} |\n" for row in cells)
    return result


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--data", type=Path, default=DATA, help="folder with modelnet10 and psb")
    options.add_argument("--run", type=Path, default=ROOT / "runs" / "table1", help="(default: runs/table1)")
    options.add_argument("--seed", type=int, default=0, help="of training and tests (default: %(default)s)")
    options.add_argument("--steps", type=int, default=3000, help="until the switch (default: %(default)s)")
    options.add_argument("--pose_steps", type=int, default=600, help="after it (default: %(default)s)")
    options.add_argument("--epoch", type=int, default=100, help="steps between checkpoints (default: %(default)s)")
    options.add_argument("--learning_rate", type=float, default=1e-4, help="the paper has 1e-5 (default: %(default)s)")
    options.add_argument("--sets", nargs="*", default=list(SETS), help="test sets (default: %(default)s)")
    options.add_argument("--only", nargs="*", default=[""], help="parts of names: only methods with one of them")
    options.add_argument("--problems", type=int, default=500, help="of a set, of networks (default: %(default)s)")
    options.add_argument("--our_problems", type=int, default=500, help="with our inference (default: %(default)s)")
    options.add_argument("--baseline_problems", type=int, default=60, help="of a set (default: %(default)s)")
    options.add_argument("--only_test", action="store_true", help="no training")
    options.add_argument("--output", type=Path, default=FILE, help="(default: benchmarks/table1.json)")
    options.add_argument("--quick", action="store_true", help="150 + 50 steps, 20 problems, its own folder")
    options.add_argument("--check", action="store_true", help="compare the pages with the record, measure nothing")
    chosen = options.parse_args()
    if chosen.check:
        fill_pages(PAGES, "table1", tables(json.loads(chosen.output.read_text())), check=True)
        return
    torch.set_num_threads(1)
    if chosen.quick:
        chosen.run = chosen.run.with_name(f"{chosen.run.name}-quick")
        chosen.output = chosen.run / "table1.json"
        chosen.steps, chosen.pose_steps, chosen.epoch = 150, 50, 50
        chosen.problems, chosen.our_problems, chosen.baseline_problems = 20, 5, 1
    found = tables(measure(chosen))
    if chosen.quick:
        print("\n\n".join(f"{name}\n{text}" for name, text in found.items()))
    else:
        fill_pages(PAGES, "table1", found, check=False)
