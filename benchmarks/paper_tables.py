"""What the benchmarks of the paper's tables share: trainings and tests that go on where they were stopped, rows with
intervals, and the tables of a page."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import LightningDataModule
from torch import nn

from bpnp.files import written_whole
from bpnp.layers import RansacPnP, WeightedPnP
from bpnp.models import BPnPNet, TrainedNet
from bpnp.models.evaluation import round_widths
from bpnp.models.weights import read_checkpoint
from bpnp.report.intervals import Interval, bootstrap, paired_difference, quantile, share
from bpnp.report.results import ProblemRow, rows_from
from bpnp.report.tables import PRINTED
from bpnp.report.terminal import Paper
from bpnp.training.comparison import problem_order

ERRORS = {
    "rotation": "rotation_error_deg",
    "translation": "translation_error",
    "reprojection": "reprojection_error_deg",
}
QUARTERS = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Training:
    """A `bpnp fit` of so many steps, in epochs of `epoch` steps with a checkpoint each.

    start: checkpoint to go on from where the folder has none of its own.
    """

    folder: Path
    arguments: tuple[str, ...]
    steps: int
    epoch: int
    start: Path | None = None

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    def run(self) -> Path:
        """Train what is missing and return the checkpoint."""
        done = trained_steps(self.checkpoint)
        if done >= self.steps:
            print(f"{self.folder}: {done} steps are there", flush=True)
            return self.checkpoint
        start = ["--ckpt_path", "last"] if done else ["--ckpt_path", str(self.start)] if self.start else []
        command = [
            sys.executable, "-m", "bpnp", "fit", *self.arguments,
            f"--trainer.limit_train_batches={self.epoch}", f"--trainer.max_epochs={self.steps // self.epoch}",
            "--trainer.enable_progress_bar=false", "--trainer.log_every_n_steps=10",
            f"--trainer.default_root_dir={self.folder}", *start,
        ]  # fmt: skip
        print(f"{self.folder}: {done} of {self.steps} steps\n  {' '.join(command[1:])}", flush=True)
        subprocess.run(command, check=True)
        return self.checkpoint


def trained_steps(checkpoint: str | Path) -> int:
    """Return the optimiser steps of a checkpoint; 0 if there is none."""
    return int(read_checkpoint(checkpoint)["global_step"]) if Path(checkpoint).is_file() else 0


def network(checkpoint: str | Path, *, ours: bool = False) -> BPnPNet:
    """Load a BPnPNet with the inference of the paper, or with ours.

    The paper's: OpenCV's P3P-RANSAC and EPnP among 1.5 min(m, n) matches within 0.01, L-BFGS on all. Ours: LO-RANSAC
    among 16 min(m, n) matches within 0.004, eight rounds of matching again under the pose, refinement.
    """
    net = TrainedNet.from_checkpoint(checkpoint)
    assert isinstance(net, BPnPNet)
    if ours:
        net.ransac, net.pnp, net.rounds = RansacPnP(threshold=0.004, matches_factor=16.0), WeightedPnP(), 8
    else:
        net.ransac = RansacPnP(backend="opencv")
        net.pnp, net.rounds = WeightedPnP(solver="lbfgs", tolerance=1e-8, max_iterations=75), 0
    net.widths = round_widths(net.rounds, net.ransac)
    net.refinement.enabled = ours
    return net.eval()


def solve_problems(
    file: Path, build: Callable[[], nn.Module], data: LightningDataModule, limit: int, identity: Mapping[str, Any]
) -> list[ProblemRow]:
    """Test a solver on the first `limit` problems of a fixed random order, each by itself, and return the rows.

    Rows are appended to a file as they come. Those of the same `identity` that are there already are not measured
    again; those of another are dropped. Seconds are of one thread's CPU time.
    """
    data.setup("test")
    problems = data.datasets["test"]  # type: ignore[attr-defined]
    order = problem_order(len(problems))[:limit]
    head = json.dumps({"identity": identity}, sort_keys=True)
    lines = file.read_text().splitlines() if file.is_file() else []
    if not lines or lines[0] != head:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(head + "\n")
        lines = [head]
    rows = [ProblemRow(**json.loads(line)) for line in lines[1:]]
    missing = [i for i in order if i not in {row.index for row in rows}]
    solver = build() if missing else nn.Identity()
    with file.open("a") as out:
        for i in missing:
            batch = problems.problem(i)
            wall, cpu = time.perf_counter(), time.process_time()
            with torch.no_grad():
                prediction = solver(batch)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            prediction.seconds.update({name: value * cpu / wall for name, value in prediction.seconds.items()})
            new = rows_from(prediction, batch, cpu)
            out.write("".join(json.dumps(asdict(row)) + "\n" for row in new))
            out.flush()
            rows += new
    chosen = set(order)
    return sorted((row for row in rows if row.index in chosen), key=lambda row: row.index)


def figures(rows: Sequence[ProblemRow], recall: tuple[float, float]) -> dict[str, Any]:
    """Quartiles of the errors and the recall with 95 % intervals, problems, and seconds of one estimate."""
    found: dict[str, Any] = {"problems": len(rows)}
    for name, field in ERRORS.items():
        values = np.array([getattr(row, field) for row in rows])
        found[name] = [_rounded(bootstrap(values, quantile(quarter))) for quarter in QUARTERS]
    found["recall"] = _rounded(bootstrap(successes(rows, recall), share))
    found["seconds"] = round(float(np.mean([row.seconds for row in rows])), 4)
    return found


def successes(rows: Sequence[ProblemRow], recall: tuple[float, float]) -> Any:
    """1 for each problem whose rotation and translation errors are within the two limits, else 0."""
    within = [row.rotation_error_deg < recall[0] and row.translation_error < recall[1] for row in rows]
    return np.array(within, float)


def effect(first: Sequence[ProblemRow], second: Sequence[ProblemRow], recall: tuple[float, float]) -> dict[str, Any]:
    """Paired differences, second minus first, of the medians and of the recall, with 95 % intervals."""
    shared = {row.index for row in first} & {row.index for row in second}
    one, other = ([row for row in rows if row.index in shared] for rows in (first, second))
    found: dict[str, Any] = {"problems": len(one)}
    for name, field in ERRORS.items():
        before, after = (np.array([getattr(row, field) for row in rows]) for rows in (one, other))
        found[name] = _rounded(paired_difference(before, after))
        found[f"{name} better"] = round(float(np.mean(after < before)), 3)
    found["recall"] = _rounded(paired_difference(successes(one, recall), successes(other, recall), share))
    return found


def _rounded(interval: Interval) -> list[float]:
    return [float(f"{value:.4g}") for value in (interval.value, interval.low, interval.high)]


def row_text(label: str, found: Mapping[str, Any]) -> str:
    """A line of a table; the interval of the median and of the recall in brackets."""
    cells = [label, str(found["problems"])]
    for name in ERRORS:
        low, middle, high = found[name]
        cells.append(
            f"{_short(low[0])} / {_short(middle[0])} [{_short(middle[1])}, {_short(middle[2])}] / {_short(high[0])}"
        )
    value, low, high = (100 * x for x in found["recall"])
    cells += [f"{value:.0f} [{low:.0f}, {high:.0f}]", _short(found["seconds"])]
    return f"| {' | '.join(cells)} |\n"


def printed_rows(paper: Paper) -> Iterator[str]:
    """The lines of the paper's table."""
    _, _, text = PRINTED[paper]
    for line in text.strip().splitlines():
        label, values = line.split("|")
        numbers = values.split()
        cells = [f"*paper: {label.strip()}*", ""]
        cells += [" / ".join(numbers[k : k + 3]) for k in (0, 3, 6)]
        cells += [numbers[10] if len(numbers) > 10 else "", numbers[9]]
        yield f"| {' | '.join(cells)} |\n"


def head(recall: tuple[float, float]) -> str:
    names = (
        "row",
        "problems",
        "rotation, deg",
        "translation",
        "reprojection, deg",
        f"% within {recall[0]:g} deg, {recall[1]:g}",
        "seconds",
    )
    return f"| {' | '.join(names)} |\n|{' --- |' * len(names)}\n"


def effect_text(label: str, found: Mapping[str, Any]) -> str:
    """A line on a paired difference."""
    cells = [label, str(found["problems"])]
    for name in ERRORS:
        value, low, high = found[name]
        cells.append(f"{value:+.2g} [{low:+.2g}, {high:+.2g}], better in {100 * found[f'{name} better']:.0f} %")
    value, low, high = (100 * x for x in found["recall"])
    cells.append(f"{value:+.0f} [{low:+.0f}, {high:+.0f}]")
    return f"| {' | '.join(cells)} |\n"


def effect_head(recall: tuple[float, float]) -> str:
    names = (
        "estimate",
        "problems",
        "rotation, deg",
        "translation",
        "reprojection, deg",
        f"% within {recall[0]:g} deg, {recall[1]:g}",
    )
    return f"| {' | '.join(names)} |\n|{' --- |' * len(names)}\n"


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}" if value < 10 else f"{value:.3g}"


def filled(text: str, marker: str, tables: Mapping[str, str]) -> str:
    """Return a page with the tables between `<!-- marker: name -->` and `<!-- end of marker -->`."""

    def replaced(match: re.Match[str]) -> str:
        new = tables.get(match[1])
        return match[0] if new is None else f"<!-- {marker}: {match[1]} -->\n{new}<!-- end of {marker} -->"

    return re.sub(rf"<!-- {marker}: ([a-z0-9-]+) -->\n(.*?)<!-- end of {marker} -->", replaced, text, flags=re.DOTALL)


def fill_pages(pages: Iterable[Path], marker: str, tables: Mapping[str, str], *, check: bool) -> None:
    """Write the tables into the pages, or exit with status 1 if a page differs and `check` is set."""
    stale = []
    for page in pages:
        text = page.read_text(encoding="utf-8")
        if (new := filled(text, marker, tables)) != text:
            stale.append(page.name)
            if not check:
                with written_whole(page) as temporary:
                    temporary.write_text(new, encoding="utf-8")
    if check and stale:
        sys.exit(f"tables of {', '.join(stale)} are not those of the record; run without --check")
