"""Shared parts of the benchmarks of the paper's tables: trainings and tests that go on where they were stopped, rows
with intervals, and the tables of a page.

A record has rows and paired effects. Each row has its own settings (the options of the command that it depends on) and
the commit, the date and the processor of its measurement. A later measurement of other rows does not change these.
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from lightning import LightningDataModule
from pages import comma_separated, is_default, markdown, publish
from record import DATA, ROOT, measured_today, write_json
from torch import nn

from bpnp.files import fingerprint, write_atomically, write_text
from bpnp.layers import RansacPnP, WeightedPnP
from bpnp.models import BPnPNet, Search, TrainedNet
from bpnp.models.pose_stages import round_widths
from bpnp.models.weights import read_checkpoint
from bpnp.report.figure_files import save_figure
from bpnp.report.figures import line_style
from bpnp.report.intervals import Interval, bootstrap, fraction, paired_difference, quantile
from bpnp.report.results import ProblemRow, rows_from
from bpnp.report.tables import PRINTED
from bpnp.report.terminal import Paper
from bpnp.training.comparison import problem_order

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERRORS = {
    "rotation": "rotation_error_deg",
    "translation": "translation_error",
    "reprojection": "reprojection_error_deg",
}
MEASURES = ("rotation, deg", "translation", "reprojection, deg")  # columns of `ERRORS`
QUARTERS = (0.25, 0.5, 0.75)
# Of 2,500 steps an epoch: 120 epochs, then 20 to 80 with the pose loss (section 3.5).
PRINTED_STEPS = {"Lc": "300,000", "Lc Lp": "350,000 to 500,000"}
PICTURES = ROOT / "docs" / "images"
NEVER = 10**6  # an epoch that no training reaches
WEIGHTS_OPTION = "--model.weights="


SEARCH_SECONDS = 10.0

ESTIMATES = {"pnp": "", "ransac": " R", "refined": ", refined"}
BRANCHES = ("Lc", "Lc Lp")
Inference = Literal["paper", "headings", "ransac", "ours"]
INFERENCES: dict[Inference, str] = {
    "paper": "", "headings": ", headings", "ransac": ", our RANSAC", "ours": ", our inference"
}  # fmt: skip
HEADINGS = 6
TITLES = {  # of the parts of the table of medians
    "training": "our training, the paper's inference",
    "paper, our RANSAC": "the paper's training, our RANSAC",
    "training, our RANSAC": "our training, our RANSAC",
    "paper, our inference": "the paper's training, our inference",
    "training, our inference": "our training, our inference",
}
LONGER = "paper-lc, as many steps of L_c"  # a name for `--weights`
PAIRS = {  # of a group, the rows without and with L_p
    "paper": (BRANCHES,),
    "training": (("paper-lc", "paper-lclp"), (LONGER, "paper-lclp")),
}
DEFAULTS = {
    "seed": 0,
    "test_seed": 0,
    "epoch": 100,
    "learning_rate": 1e-4,
    "pose_learning_rate": None,
    "problems": 500,
    "our_problems": 500,
    "baseline_problems": 60,
}
LIMITS = ("problems", "our_problems", "baseline_problems")
QUICK = {"steps": 150, "pose_steps": 50, "epoch": 50, "problems": 20, "our_problems": 5, "baseline_problems": 1}


@dataclass(frozen=True)
class Table:
    """A table of the paper: its name, its printed rows, the limits of its recall, and our test sets."""

    name: str
    paper: Paper
    recall: tuple[float, float]  # degrees, scene units
    sets: tuple[str, ...]


@dataclass(frozen=True)
class Method:
    """A solver of a table."""

    group: str
    label: str
    build: Callable[[], nn.Module]
    limit: int  # number of problems
    identity: dict[str, Any]  # values that its results depend on, besides the problems
    settings: dict[str, Any]  # options of the command that these results depend on

    @property
    def file(self) -> str:
        return re.sub(r"[^\w-]+", "_", f"{self.group}-{self.label}") + ".jsonl"

    @property
    def seed(self) -> int:
        """The seed of its training; 0 for a method that the command does not train."""
        return int(self.settings.get("seed", 0))


@dataclass(frozen=True)
class Weights:
    """A checkpoint of a table, by group and label, and the options of the command that it depends on."""

    group: str
    label: str
    checkpoint: Path
    settings: dict[str, Any]


@dataclass(frozen=True)
class Training:
    """A `bpnp fit` of a number of steps, in epochs of `epoch` steps with a checkpoint each.

    Its arguments, and the content of the weights that it starts from, are kept in `training.json` of the folder: a
    training that was begun with others is not taken for this one.
    """

    folder: Path
    arguments: tuple[str, ...]
    steps: int
    epoch: int
    start: Path | None = None  # checkpoint to go on from where the folder has none of its own
    forks: bool = False  # branches start from here; a copy of the checkpoint at exactly `steps` is kept for them

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def switch(self) -> Path:
        """The checkpoint at exactly `steps`; a longer training does not change it."""
        return self.folder.with_name(f"{self.folder.name}-{self.steps}.ckpt")

    def run(self) -> Path:
        """Train what is missing and return the checkpoint."""
        weights = [word.removeprefix(WEIGHTS_OPTION) for word in self.arguments if word.startswith(WEIGHTS_OPTION)]
        starts = [path for path in (self.start, *map(Path, weights)) if path]
        check_beginning(self.folder, self.arguments, starts, epoch=self.epoch)
        if (done := trained_steps(self.checkpoint)) < self.steps:
            self._train(done)
            if (done := trained_steps(self.checkpoint)) != self.steps:
                sys.exit(f"{self.folder} has {done} steps instead of {self.steps}; was it begun with another --epoch?")
        else:
            print(f"{self.folder}: {done} steps are there", flush=True)
        if self.forks and done == self.steps and not self.switch.is_file():
            with write_atomically(self.switch) as temporary:
                shutil.copyfile(self.checkpoint, temporary)
        return self.checkpoint

    def _train(self, done: int) -> None:
        if not done and self.start and not self.start.is_file():
            sys.exit(
                f"{self.start} is missing, from which {self.folder.name} starts; if the training before it is longer "
                "already, give --steps as many as that has, or another --run"
            )
        start = ["--ckpt_path", "last"] if done else ["--ckpt_path", str(self.start)] if self.start else []
        command = [
            sys.executable, "-m", "bpnp", "fit", *self.arguments,
            f"--trainer.limit_train_batches={self.epoch}", f"--trainer.max_epochs={self.steps // self.epoch}",
            "--trainer.enable_progress_bar=false", "--trainer.log_every_n_steps=10",
            f"--trainer.default_root_dir={self.folder}", f"--data.num_workers={workers()}", *start,
        ]  # fmt: skip
        print(f"{self.folder}: {done} of {self.steps} steps\n  {' '.join(command[1:])}", flush=True)
        subprocess.run(command, check=True)


def workers() -> int:
    """Return how many processes draw the problems of a training: none without a GPU, which would wait for them."""
    return len(os.sched_getaffinity(0)) // 2 if torch.cuda.is_available() else 0


def check_beginning(folder: Path, arguments: Iterable[str], starts: Iterable[Path], **settings: Any) -> None:
    """Exit if the training in a folder was begun with others; write how this one begins to its `training.json`.

    The weights that it starts from are compared by content if all of them still exist.
    """
    content = [digest(path) if path.is_file() else None for path in starts]
    now = {"arguments": list(arguments), "starts": content} | settings
    file = folder / "training.json"
    if not ((folder / "checkpoints" / "last.ckpt").is_file() and file.is_file()):
        write_json(file, now)
        return
    before = json.loads(file.read_text(encoding="utf-8"))
    changed = [name for name in now if now[name] != before.get(name) and (name != "starts" or None not in content)]
    if changed:
        sys.exit(
            f"the training in {folder} was begun with other {', '.join(changed)} ({file.name}); give another --run, "
            "or delete the folder"
        )


def trained_steps(checkpoint: str | Path) -> int:
    """Return the optimiser steps of a checkpoint; 0 if there is none."""
    return int(read_checkpoint(checkpoint)["global_step"]) if Path(checkpoint).is_file() else 0


def network(checkpoint: str | Path, *, inference: Inference = "paper", hypotheses: int = 1000) -> BPnPNet:
    """Load a BPnPNet with the inference of the paper, also for several headings, with our RANSAC, or with all of ours.

    The paper's: OpenCV's P3P-RANSAC and EPnP among 1.5 min(m, n) matches within 0.01, L-BFGS on all. Our RANSAC:
    LO-RANSAC among 16 min(m, n) matches within 0.004, Newton's method on all. Ours: then eight rounds of matching again
    under the pose, and refinement. Headings share the number of RANSAC hypotheses.
    """
    net = TrainedNet.from_checkpoint(checkpoint)
    assert isinstance(net, BPnPNet)
    net.headings = HEADINGS if inference == "headings" else 1
    if inference in ("paper", "headings"):
        net.ransac = RansacPnP(backend="opencv", max_iterations=hypotheses // net.headings)
        net.pnp = WeightedPnP(solver="lbfgs", tolerance=1e-8, max_iterations=75)
    else:
        net.ransac, net.pnp = RansacPnP(threshold=0.004, matches_factor=16.0), WeightedPnP()
    net.rounds = 8 if inference == "ours" else 0
    net.widths = round_widths(net.rounds, net.ransac)
    net.refinement.enabled = inference == "ours"
    return net.eval()


def solve_problems(
    file: Path,
    build: Callable[[], nn.Module],
    data: LightningDataModule,
    limit: int,
    identity: Mapping[str, Any],
    *,
    solve: bool = True,
) -> list[ProblemRow]:
    """Test a solver on the first `limit` problems of a fixed random order, each by itself, and return the rows.

    Rows are appended to a file as they come, a line for each problem, below a line with commit, date and processor.
    Those of the same `identity` and the same problems that are there already are not measured again; a file of others
    is kept as *.previous.jsonl. Seconds are of one thread's CPU time. Without `solve`, nothing is measured or moved,
    and there are no rows unless the file has all of them.
    """
    data.setup("test")
    problems = data.datasets["test"]  # type: ignore[attr-defined]
    order = problem_order(len(problems))[:limit]
    drawn = fingerprint(problems.problem(order[0]).points2d.tolist()) if order else ""
    head = {"identity": dict(identity), "problems": drawn}
    lines = read_lines(file)
    found = lines[0] if lines else {}
    same = all(found.get(name) == value for name, value in head.items())
    rows = [ProblemRow(**row) for line in lines[1:] if isinstance(line, list) for row in line] if same else []
    missing = [i for i in order if i not in {row.index for row in rows}]
    if not order or (missing and not solve):
        return []
    now = {"measured": measured_today()}
    if not same:
        if lines:
            previous = file.replace(file.with_suffix(".previous.jsonl"))
            print(f"{previous} has other weights, settings or problems; measured again", flush=True)
        lines = [head | now]
    elif missing and measurements(lines)[-1:] != [now["measured"]]:
        lines.append(now)
    if missing or not same:  # without the incomplete end of a run that was stopped
        write_text(file, "".join(f"{json.dumps(line, sort_keys=True)}\n" for line in lines))
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
            out.write(json.dumps([asdict(row) for row in new]) + "\n")
            out.flush()
            rows += new
    chosen = set(order)
    return sorted((row for row in rows if row.index in chosen), key=lambda row: row.index)


def read_lines(file: Path) -> list[Any]:
    """Return the complete lines of a file of `solve_problems`; none if there is no file."""
    text = file.read_text() if file.is_file() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def measurements(lines: Iterable[Any]) -> list[dict[str, str]]:
    """Return commit, date and processor of each part of a file of `solve_problems`."""
    return [line["measured"] for line in lines if isinstance(line, dict) and "measured" in line]


def provenance(file: Path) -> dict[str, str]:
    """Return commit, date and processor of the rows of `solve_problems`, each several ones if of several runs."""
    parts = measurements(read_lines(file))
    return {key: ", ".join(dict.fromkeys(part[key] for part in parts)) for key in parts[0]}


def branches(
    folder: Path, arguments: tuple[str, ...], options: argparse.Namespace, after: tuple[str, ...] | None = None
) -> dict[str, Training]:
    """Return a training with L_c, and two that go on from it for as many steps: with L_c, and with L_c + L_p.

    These two have the arguments `after`, if others.
    """
    steps, epoch, rate = options.steps, options.epoch, options.pose_learning_rate
    later = () if rate is None else (f"--model.learning_rate={rate}",)
    never, switch = f"--pose_loss.start_epoch={NEVER}", f"--pose_loss.start_epoch={steps // epoch}"
    first, end = Training(folder / "lc", (*arguments, never), steps, epoch, forks=True), steps + options.pose_steps
    after = arguments if after is None else after
    without, posed = (*after, never, *later), (*after, switch, *later)
    return {
        "first": first,
        "Lc": Training(folder / f"lc-from{steps}", without, end, epoch, first.switch),
        "Lc Lp": Training(folder / f"lclp-from{steps}", posed, end, epoch, first.switch),
    }


def branch_weights(trained: Mapping[str, Training], options: argparse.Namespace) -> list[Weights]:
    """The checkpoints of the branches that exist."""
    shared = {name: getattr(options, name) for name in ("seed", "steps", "epoch", "learning_rate")}
    if options.pose_learning_rate is not None:
        shared["pose_learning_rate"] = options.pose_learning_rate
    found = {label: trained_steps(trained[label].checkpoint) - options.steps for label in BRANCHES}
    return [
        Weights("paper", label, trained[label].checkpoint, shared | {"pose_steps": steps})
        for label, steps in found.items()
        if steps > 0
    ]


def network_methods(
    weights: Iterable[Weights],
    options: argparse.Namespace,
    inferences: Sequence[Inference] = ("paper", "ransac", "ours"),
) -> Iterator[Method]:
    """Networks with the paper's inference, then with others."""
    listed = [(one, trained_steps(one.checkpoint), digest(one.checkpoint)) for one in weights]
    for inference in inferences:
        suffix = INFERENCES[inference]
        for one, steps, content in listed:
            identity = {"steps": steps, "weights": content, "inference": inference}
            papers = inference in ("paper", "headings")
            limit = options.problems if papers else min(options.problems, options.our_problems)
            settings = one.settings | {"problems" if papers else "our_problems": limit}
            build = partial(network, one.checkpoint, inference=inference)
            yield Method(one.group + suffix, one.label, build, limit, identity, settings)


def other_methods(baselines: Mapping[str, Callable[[], nn.Module]], options: argparse.Namespace) -> Iterator[Method]:
    """The baselines, 30 seconds a problem, and the search, 10."""
    for name, baseline in baselines.items():
        limit = options.baseline_problems
        yield Method("baselines", name, baseline, limit, {"time_limit": 30}, {"baseline_problems": limit})
    limit = options.our_problems
    search = partial(Search, time_limit=SEARCH_SECONDS)
    yield Method("baselines", "search", search, limit, {"time_limit": SEARCH_SECONDS}, {"our_problems": limit})


def digest(file: Path) -> str:
    """Return the first 16 digits of the SHA-256 sum of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def read_record(file: Path) -> dict[str, Any]:
    """Return the rows and the effects of a record; none if there is no file."""
    record = json.loads(file.read_text()) if file.is_file() else {}
    return {key: record.get(key, {}) for key in ("rows", "effects")}


def measure(
    table: Table,
    trained: Mapping[str, Training],
    methods: Callable[[str], Iterable[Method]],  # by the name of a test set
    data: Callable[[str], LightningDataModule],
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Train what is missing, test the chosen methods on all sets, and return the record, written after each set."""
    record = read_record(options.output)
    known = {row["settings"]["test_seed"] for row in record["rows"].values()}
    if known - {options.test_seed}:
        sys.exit(f"{options.output} has rows of the test seed {min(known)}; give another --output for another")
    parts = [one for one in trained.values() if one.steps % one.epoch]
    if parts and not options.only_test:
        names = ", ".join(f"{one.folder.name} has {one.steps} and {one.epoch}" for one in parts)
        sys.exit(f"the steps of each training must be a multiple of those between checkpoints: {names}")
    for one in trained.values():
        if not options.only_test:
            one.run()
    steps = {label: trained_steps(trained[label].checkpoint) for label in BRANCHES}
    if not options.only_test and len(set(steps.values())) > 1:
        lengths = ", ".join(f"{label} {number:,}" for label, number in steps.items())
        sys.exit(f"the branches differ in their steps ({lengths}); give a larger --pose_steps to train the shorter one")
    tests = f"tests-{options.test_seed}" if options.test_seed else "tests"
    for name in options.sets:
        problems = data(name)
        found: dict[tuple[str, str, str], tuple[Method, list[ProblemRow]]] = {}
        chosen = set()
        for method in methods(name):
            solve = any(part in f"{method.group} {method.label}" for part in options.only)
            file = options.run / f"seed{method.seed}" / tests / name / method.file
            rows = solve_problems(file, method.build, problems, method.limit, method.identity, solve=solve)
            for estimate in dict.fromkeys(row.estimate for row in rows):
                key = (method.group, method.label, estimate)
                found[key] = method, [row for row in rows if row.estimate == estimate]
                if solve:
                    chosen.add(key)
                    text = "|".join((name, str(method.seed), *key))
                    record["rows"][text] = figures(found[key][1], table.recall) | {
                        "steps": method.identity.get("steps"),
                        "settings": method.settings | {"test_seed": options.test_seed},
                        "measured": provenance(file),
                    }
                    print(f"{text}: {record['rows'][text]}", flush=True)
        for group, pairs in PAIRS.items():
            for pair, estimate in product(pairs, ("pnp", "ransac")):
                keys = [(group, label, estimate) for label in pair]
                seeds = {str(found[key][0].seed) for key in chosen.intersection(keys)}
                for text in ("|".join((name, seed, group, *pair, estimate)) for seed in seeds):
                    record["effects"].pop(text, None)  # one of its rows is a new one
                    if all(key in found for key in keys):
                        (before, first), (after, second) = (found[key] for key in keys)
                        compared = {"steps": [before.identity["steps"], after.identity["steps"]]}
                        record["effects"][text] = effect(first, second, table.recall) | compared
        write_json(options.output, record)
        curves = {
            label + ESTIMATES[estimate]: found["paper", label, estimate][1]
            for label, estimate in product(BRANCHES, ("pnp", "ransac"))
            if ("paper", label, estimate) in found
        }
        lowest = min((int(key.split("|")[1]) for key in record["rows"]), default=0)
        if curves and name == table.sets[0] and options.seed == lowest and options.published:
            save_figure(recall_picture(curves, table), PICTURES / f"{table.name}.png")
    return record


def recall_picture(rows: Mapping[str, Sequence[ProblemRow]], table: Table) -> "Figure":
    """Fraction of the problems within an error, a curve per row, and the quartiles of the paper's rows as rings."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), layout="constrained")
    printed = {
        name.strip(): values.split() for name, _, values in (line.partition("|") for line in _lines(table.paper))
    }
    fields = (("rotation_error_deg", "rotation error, degrees", 30.0), ("translation_error", "translation error", 1.0))
    for k, (axes, (field, label, limit)) in enumerate(zip(figure.subplots(1, 2, sharey=True), fields, strict=True)):
        for place, (name, found) in enumerate(rows.items()):
            style = line_style(place, place)
            draw_recall(axes, [getattr(row, field) for row in found], label=name, **style)
            quartiles = [float(value) for value in printed[name][3 * k : 3 * k + 3]]
            axes.plot(quartiles, [25, 50, 75], "o", mfc="none", color=style["color"], label=f"paper: {name}")
        axes.set(xlabel=label, xlim=(0, limit))
    return finish_recall(figure)


def draw_recall(axes: "Axes", errors: Sequence[float], **line: Any) -> None:
    """Draw the percentage of the problems within an error; `line` are matplotlib's options."""
    axes.step(np.sort(errors), 100 * np.arange(1, len(errors) + 1) / len(errors), where="post", **line)


def finish_recall(figure: "Figure") -> "Figure":
    """Add the grids, the axis of percentages and the legend of the first panel."""
    for axes in figure.axes:
        axes.set_ylim(0, 100)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("% of problems within")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def tables(table: Table, record: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of a record by name.

    These are the rows of a set beside the paper's (of several seeds, the lowest), their medians, those of all seeds,
    those of the other trainings and inferences, the effects of L_p, the trainings, and the commands.
    """
    rows: dict[tuple[str, str], list[Row]] = {}
    for key, found in record["rows"].items():
        name, seed, group, label, estimate = key.split("|")
        place = list(ESTIMATES).index(estimate) if estimate in ESTIMATES else 0
        row = Row(place, int(seed), label + ESTIMATES.get(estimate, ""), found)
        rows.setdefault((name, group), []).append(row)
    result = {"commands": "```\n" + "".join(f"{line}\n" for line in commands(table, record)) + "```\n"}
    for (name, group), several in rows.items():
        if group == "paper":
            result[f"{name}-paper"] = compared(table, several)
            result[f"{name}-summary"] = summary(table, several)
            result[f"{name}-spread"] = spread(table, several)
        if group == "baselines":
            result[f"{name}-baselines"] = summary(table, several)
    if others := {key: several for key, several in rows.items() if key[1] not in ("paper", "baselines")}:
        result["medians"] = medians(table, others)
    for title, effects in effect_rows(record["effects"]).items():
        result[title] = markdown(effect_head(table.recall), effects)
    return result | training_table(record)


@dataclass(frozen=True)
class Row:
    """A row of a record: an estimate of a network, or another method."""

    place: int  # of the estimate
    seed: int
    label: str
    figures: Mapping[str, Any]

    @property
    def order(self) -> tuple[int, int]:
        return self.seed, self.place

    def cell(self, error: str) -> str:
        """Return the median of an error, or the percentage within the limits, with its 95 % interval."""
        if error == "recall":
            value, low, high = (100 * x for x in self.figures[error])
            return f"{value:.0f} [{low:.0f}, {high:.0f}]"
        value, low, high = self.figures[error][1]
        return f"{_short(value)} [{_short(low)}, {_short(high)}]"

    def value(self, error: str) -> str:
        """Return the same without the interval."""
        return self.cell(error).split(" [")[0]


def lowest(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of the lowest seed, in the order of the estimates."""
    ordered = sorted(rows, key=lambda row: row.order)
    return [row for row in ordered if row.seed == ordered[0].seed]


def recall_name(table: Table) -> str:
    return f"% within {table.recall[0]:g} deg, {table.recall[1]:g}"


def compared(table: Table, rows: Iterable[Row]) -> str:
    """Return a table with our rows beside the paper's: quartiles of each error, recall and seconds."""
    lines = []
    for column, measure in enumerate((*MEASURES, recall_name(table), "seconds"), start=3):
        lines.append([f"**{measure}**", "", ""])
        lines += [
            [row.label, row_cells(row.label, row.figures)[column], printed_row(table, row.label)[column]]
            for row in lowest(rows)
        ]
    return markdown(("", "ours", "paper"), lines)


def summary(table: Table, rows: Iterable[Row]) -> str:
    """Return a table with our medians of rotation and translation and our recall, each beside the paper's."""
    measures = {"rotation": MEASURES[0], "translation": MEASURES[1], "recall": recall_name(table)}
    lines = []
    for row in lowest(rows):
        *_, rotation, translation, _, recall, _ = printed_row(table, row.label)
        paper = [cell.split(" / ")[1] if cell else "" for cell in (rotation, translation)] + [recall]
        cells = zip((row.cell(error) for error in measures), paper, strict=True)
        lines.append([row.label, *(cell for pair in cells for cell in pair)])
    return markdown(("", *(head for measure in measures.values() for head in (measure, "paper"))), lines)


def spread(table: Table, rows: Iterable[Row]) -> str:
    """Return a table with the medians of all seeds, or a sentence if there is one seed."""
    seeds = sorted({row.seed for row in rows})
    if len(seeds) == 1:
        return "Measured with one seed.\n"
    by_label: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.order):
        by_label.setdefault(row.label, []).append(row)
    errors = (*ERRORS, "recall")
    lines = [
        [label, *(", ".join(row.value(error) for row in several) for error in errors)]
        for label, several in by_label.items()
    ]
    return markdown((f"seeds {', '.join(map(str, seeds))}", *MEASURES, recall_name(table)), lines)


def medians(table: Table, rows: Mapping[tuple[str, str], Iterable[Row]]) -> str:
    """Return a table with the median rotation errors and the recalls of all sets, a part for each group."""
    groups = [f"{first}{suffix}" for suffix in INFERENCES.values() for first in PAIRS]
    names = list(dict.fromkeys(name for name, _ in rows))
    names.sort(key=table.sets.index)
    lines = []
    for group in (one for one in groups if any(key[1] == one for key in rows)):
        found = {name: {row.label: row for row in lowest(rows.get((name, group), []))} for name in names}
        kept = dict.fromkeys(label for cells in found.values() for label in cells if is_changed(group, label))
        lines.append([f"**{TITLES[group]}**", *[""] * (2 * len(names))])
        lines += [
            [label, *(found[name][label].value(error) if label in found[name] else "" for name in names
                      for error in ("rotation", "recall"))]
            for label in kept
        ]  # fmt: skip
    heads = [f"{name}: {measure}" for name in names for measure in (MEASURES[0], recall_name(table))]
    return markdown(("", *heads), lines)


def is_changed(group: str, label: str) -> bool:
    """Return whether an inference of ours changes the estimate: our RANSAC that of RANSAC, all of ours the others."""
    return label.endswith(" R") == ("RANSAC" in group) or group in PAIRS


def training_table(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the table of the trainings of a record, if it has any."""
    trained: dict[tuple[str, int, str, str], dict[str, int]] = {}
    for key, found in record["rows"].items():
        _, seed, group, label, _ = key.split("|")
        if group == "paper":
            settings = found["settings"]
            drawn = " + ".join(f"{steps:,}" for steps in settings.get("drawn_steps", ()))
            rates = [settings[name] for name in ("learning_rate", "pose_learning_rate") if name in settings]
            name = (seed, settings["steps"], ", then ".join(f"{rate:g}" for rate in rates), drawn)
            trained.setdefault(name, {})[label] = found["steps"]
    names = ("training", "steps until the switch", "steps of Lc", "steps of Lc Lp", "learning rate")
    rows = [
        [f"seed {seed}{f', after {drawn} steps on drawn maps' if drawn else ''}", str(switch),
         *(str(steps.get(label, "")) for label in BRANCHES), rates]
        for (seed, switch, rates, drawn), steps in trained.items()
    ]  # fmt: skip
    return {"training": markdown(names, rows)} if rows else {}


def effect_rows(effects: Mapping[str, Any]) -> dict[str, list[list[str]]]:
    """Return a row for each pair, seed and estimate, by name of the table."""
    seeds = {key.split("|")[1] for key in effects}
    result: dict[str, list[list[str]]] = {}
    for key in sorted(effects, key=lambda key: (*key.split("|")[:2], list(ESTIMATES).index(key.split("|")[-1]))):
        name, seed, group, first, second, estimate = key.split("|")
        before, after = effects[key]["steps"]
        names = f"{second}{ESTIMATES[estimate]}", f"{first}{ESTIMATES[estimate]}"
        if before == after:
            label = f"{' minus '.join(names)}, {after:,} steps"
        else:
            label = f"{names[0]} ({after:,} steps) minus {names[1]} ({before:,} steps)"
        label += f", seed {seed}" if len(seeds) > 1 and group == "paper" else ""
        label += ", unequal training" if before != after else ""
        title = f"{name}-effect" if group == "paper" else f"{name}-{group}-effect"
        result.setdefault(title, []).append(effect_cells(label, effects[key]))
    return result


def commands(table: Table, record: Mapping[str, Any]) -> list[str]:
    """The commands that give the rows of a record, one for each training; DATA stands for the folder of the data."""
    settings = [row["settings"] for row in record["rows"].values()]
    limits = {name: max((one.get(name, 0) for one in settings), default=0) for name in LIMITS}
    weights = sorted({one["weights"] for one in settings if "weights" in one})
    trainings = [
        {name: value for name, value in one.items() if name not in LIMITS} for one in settings if "steps" in one
    ]
    distinct = [one for i, one in enumerate(trainings) if one not in trainings[:i]]
    result = []
    for one in distinct or [{"only_test": None}]:
        words = [
            word
            for name, value in (one | limits).items()
            if name not in DEFAULTS or DEFAULTS[name] != value
            for word in (f"--{name}", *([] if value is None else map(str, np.atleast_1d(value))))
        ]
        if weights:
            words += ["--weights", *(f"{name}=CHECKPOINT" for name in weights)]
        result.append(shlex.join(["python", "-m", "benchmarks", table.name, "--data", "DATA", *words]))
    return result


def options(
    doc: str | None, *, file: Path, run: Path, sets: Sequence[str], steps: int, pose_steps: int, epoch: int
) -> argparse.ArgumentParser:
    """The options of a table."""
    found = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--data", type=Path, default=DATA, help="folder of the data sets")
    found.add_argument("--run", type=Path, default=run, help="(default: %(default)s)")
    found.add_argument("--seed", type=int, help="of the training (default: %(default)s)")
    found.add_argument("--test_seed", type=int, help="of the test problems (default: %(default)s)")
    found.add_argument("--steps", type=int, default=steps, help="until the switch (default: %(default)s)")
    found.add_argument("--pose_steps", type=int, default=pose_steps, help="after it (default: %(default)s)")
    found.add_argument("--epoch", type=int, help="steps between checkpoints (default: %(default)s)")
    found.add_argument("--learning_rate", type=float, help="the paper has 1e-5 (default: %(default)s)")
    found.add_argument("--pose_learning_rate", type=float, help="after the switch (default: that before it)")
    found.add_argument("--sets", nargs="*", default=list(sets), help="test sets (default: %(default)s)")
    found.add_argument("--only", nargs="*", default=[""], help="parts of names: only methods with one of them")
    found.add_argument("--problems", type=int, help="of a set, at most (default: %(default)s)")
    found.add_argument("--our_problems", type=int, help="with our inference, and of the search (default: %(default)s)")
    found.add_argument("--baseline_problems", type=int, help="of a set (default: %(default)s)")
    found.add_argument("--only_test", action="store_true", help="no training")
    found.add_argument("--output", type=Path, default=file, help="(default: %(default)s)")
    found.add_argument("--quick", action="store_true", help="few steps, 20 problems, its own folder")
    found.set_defaults(**DEFAULTS | {"epoch": epoch})
    return found


def run(
    table: Table,
    parser: argparse.ArgumentParser,
    measure: Callable[[argparse.Namespace], object],
    quick: Mapping[str, Any] = QUICK,
) -> None:
    """Parse the options, measure, which writes the record, and write the pages.

    A quick run, with the options `quick`, and one with a record of its own print the tables instead, and draw nothing.
    """
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    if chosen.quick:
        chosen.run = chosen.run.with_name(f"{chosen.run.name}-quick")
        chosen.output = chosen.run / "record.json"
        vars(chosen).update(quick)
    chosen.published = is_default(parser, chosen)
    measure(chosen)
    publish(table.name, chosen.output)


def figures(rows: Sequence[ProblemRow], recall: tuple[float, float]) -> dict[str, Any]:
    """Quartiles of the errors and the recall with 95 % intervals, problems, and seconds of one estimate."""
    found: dict[str, Any] = {"problems": len(rows)}
    for name, field in ERRORS.items():
        values = np.array([getattr(row, field) for row in rows])
        found[name] = [_round_interval(bootstrap(values, quantile(quarter))) for quarter in QUARTERS]
    found["recall"] = _round_interval(bootstrap(successes(rows, recall), fraction))
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
        found[name] = _round_interval(paired_difference(before, after))
        found[f"{name} better"] = round(float(np.mean(after < before)), 3)
    found["recall"] = _round_interval(paired_difference(successes(one, recall), successes(other, recall), fraction))
    return found


def _round_interval(interval: Interval) -> list[float]:
    return [float(f"{value:.4g}") for value in (interval.value, interval.low, interval.high)]


def row_cells(label: str, found: Mapping[str, Any]) -> list[str]:
    """Return a row of a table; the interval of the median and of the recall is in brackets."""
    steps = "" if found.get("steps") is None else f"{found['steps']:,}"
    cells = [label, steps, str(found["problems"])]
    for name in ERRORS:
        low, middle, high = found[name]
        cells.append(
            f"{_short(low[0])} / {_short(middle[0])} [{_short(middle[1])}, {_short(middle[2])}] / {_short(high[0])}"
        )
    value, low, high = (100 * x for x in found["recall"])
    return [*cells, f"{value:.0f} [{low:.0f}, {high:.0f}]", _short(found["seconds"])]


def printed_rows(paper: Paper) -> list[list[str]]:
    """Return the rows of the paper's table."""
    rows = []
    for line in _lines(paper):
        label, values = line.split("|")
        numbers = values.split()
        cells = [f"*paper: {label.strip()}*", PRINTED_STEPS.get(label.split(" R")[0].strip(), ""), ""]
        cells += [" / ".join(numbers[k : k + 3]) for k in (0, 3, 6)]
        cells += [numbers[10] if len(numbers) > 10 else "", numbers[9]]
        rows.append(cells)
    return rows


def _lines(paper: Paper) -> list[str]:
    return PRINTED[paper][2].strip().splitlines()


def printed_row(table: Table, label: str) -> list[str]:
    """Return the row of the paper's table with this label, or empty cells."""
    name = label.removesuffix(" near the truth")  # as in the paper's table 2
    return next((row for row in printed_rows(table.paper) if row[0] == f"*paper: {name}*"), [""] * 8)


def sheets(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows and the effects of a table of the paper in CSV, by name of the file without that of the table."""
    pair = ("set", "seed", "group", "before", "after", "estimate")
    rows = sheet(("set", "seed", "group", "row", "estimate"), record["rows"])
    return {"": rows, "-effects": sheet(pair, record["effects"])}


def sheet(keys: Sequence[str], found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures of a record in CSV: a line for each key, whose parts are its first cells."""
    rows = [dict(zip(keys, key.split("|"), strict=True)) | dict(flat(figures)) for key, figures in found.items()]
    return comma_separated(list(dict.fromkeys(name for row in rows for name in row)), rows)


def flat(figures: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield a name for each figure of a row; an interval is the value and its two limits."""
    for name, value in figures.items():
        if name == "measured":
            yield from value.items()
        elif name == "settings":
            yield name, json.dumps(value)
        elif name == "steps" and isinstance(value, list):
            yield from zip(("steps_before", "steps_after"), value, strict=True)
        elif isinstance(value, list):
            quartiles = {f"{name}_q{i}": one for i, one in enumerate(value, start=1)}
            for title, one in quartiles.items() if isinstance(value[0], list) else [(name, value)]:
                yield from zip((title, f"{title}_low", f"{title}_high"), one, strict=True)
        else:
            yield name.replace(" ", "_"), value


def head(recall: tuple[float, float]) -> list[str]:
    return ["row", "steps", "problems", *MEASURES, f"% within {recall[0]:g} deg, {recall[1]:g}", "seconds"]


def effect_head(recall: tuple[float, float]) -> list[str]:
    return ["estimate", "problems", *MEASURES, f"% within {recall[0]:g} deg, {recall[1]:g}"]


def effect_cells(label: str, found: Mapping[str, Any]) -> list[str]:
    """Return a row on a paired difference."""
    cells = [label, str(found["problems"])]
    for name in ERRORS:
        value, low, high = found[name]
        shown = "-" if np.isnan(value) else f"{value:+.2g}"  # of two infinite medians
        cells.append(f"{shown} [{low:+.2g}, {high:+.2g}], better in {100 * found[f'{name} better']:.0f} %")
    value, low, high = (100 * x for x in found["recall"])
    return [*cells, f"{value:+.0f} [{low:+.0f}, {high:+.0f}]"]


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}" if value < 10 else f"{value:.3g}"
