"""Several runs: their names, their figures as a DataFrame, how each is drawn, and their training curves."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bpnp.report.palette import DASHES, LIGHT
from bpnp.report.results import SUMMARY, Results, read_results

if TYPE_CHECKING:
    from pandas import DataFrame, Series

LOGS = ("logs", "lightning_logs")  # folders of Lightning's CSVLogger
LOSS = "train/loss"
CURVES = (
    LOSS,
    "train/correspondence_loss",
    "train/pose_loss",
    "val/correspondence_loss",
    "val/rotation_q2_deg",
    "val/recall_joint_15deg_0.5",
)
SWITCH_MARKS = ("train/pose_loss", "train/without_pose")  # logged from the first step with a pose loss on
MOST_POINTS = 500  # of a curve


def read_runs(paths: Sequence[Path | str]) -> dict[str, Results]:
    """Results by the names of `named_runs`."""
    return {name: read_results(path) for name, path in named_runs(paths).items()}


def table(runs: Sequence[Path | str] | Mapping[str, Results]) -> "DataFrame":
    """Aggregates of one or several results: a DataFrame with a row per run and estimate, and the columns "run",
    "estimate", "correspondence_loss" and all numbers of `summarise`.

    runs: results folders, or results by name. Raises ValueError if a folder cannot be read.
    """
    from pandas import DataFrame

    return DataFrame(
        {"run": name, "estimate": estimate, "correspondence_loss": results.correspondence_loss, **values}
        for name, results in (runs if isinstance(runs, Mapping) else read_runs(runs)).items()
        for estimate, values in results.estimates.items()
    )


class Line(NamedTuple):
    """An estimate of a run as tables and figures show it. colour, dashes: indices of the palette."""

    run: str
    estimate: str
    label: str
    colour: int
    dashes: int


def lines_of(runs: Mapping[str, Results]) -> list[Line]:
    """Every estimate of every run, with the run's name only where there are several.

    With at most eight lines each has its own colour; with more, each run has one. Estimates of one name share dashes.
    """
    keys = [(run, estimate) for run, results in runs.items() for estimate in results.estimates]
    places, names = list(runs), list(dict.fromkeys(estimate for _, estimate in keys))
    lines = []
    for i, (run, estimate) in enumerate(keys):
        colour = i if len(keys) <= len(LIGHT) else places.index(run) % len(LIGHT)
        label = estimate if len(runs) == 1 else f"{run}: {estimate}"
        lines.append(Line(run, estimate, label, colour, names.index(estimate) % len(DASHES)))
    return lines


def named_runs(paths: Sequence[Path | str]) -> dict[str, Path]:
    """Results folders by what their paths do not share, at the start or at the end; a single one by its run.

    Of a run's folder, its `test`; of a folder of several results, such as that of `bpnp table`, all of them. Raises
    ValueError if there is none.
    """
    if not paths:
        raise ValueError("expected at least one results folder, got none; try the folder that `bpnp test` wrote")
    folders = [place for path in paths for place in _results_in(Path(path).absolute())]
    if len(folders) == 1:
        (folder,) = folders
        return {(folder.parent if folder.name == "test" else folder).name: folder}
    shared = os.path.commonpath([path.parent for path in folders])
    parts = [Path(os.path.relpath(path, shared)).parts for path in folders]
    while len(set(parts)) > 1 and min(map(len, parts)) > 1 and len({path[-1] for path in parts}) == 1:
        parts = [path[:-1] for path in parts]
    return {os.path.join(*path): folder for path, folder in zip(parts, folders, strict=True)}


def _results_in(folder: Path) -> list[Path]:
    for place in (folder, folder / "test"):
        if (place / SUMMARY).is_file():
            return [place]
    return sorted(path.parent for path in folder.rglob(SUMMARY)) or [folder]


@dataclass(frozen=True)
class TrainingLog:
    """Curves by name, each as (steps, values) of at most `MOST_POINTS` points.

    switch_step: the first logged step with the pose loss, None if it never joined. files: where the curves come from.
    """

    curves: dict[str, tuple[list[float], list[float]]]
    switch_step: int | None
    files: tuple[Path, ...]


def trained_only(paths: Sequence[Path | str]) -> dict[str, TrainingLog]:
    """The logs of trainings by the names of `named_runs`, if none of the folders has results yet; else none."""
    folders = named_runs(paths)
    if any((folder / SUMMARY).is_file() for folder in folders.values()):
        return {}
    logs = {name: read_training_log(folder) for name, folder in folders.items()}
    return {name: log for name, log in logs.items() if log is not None}


def read_training_log(results: Path | str) -> TrainingLog | None:
    """The log of the run that a results folder belongs to: in `logs` or `lightning_logs` of it or of its parent.

    Of several versions the newest that trained counts, with the steps before it of those that it continues (a resumed
    run); of a training too short to log its loss, what was validated. None if nothing was trained. Raises ValueError
    that names the file if a value is no number.
    """
    folder = Path(results).absolute()
    for place in (folder, folder.parent):
        files = [file for name in LOGS for file in (place / name).glob("version_*[0-9]/metrics.csv")]
        files.sort(key=lambda file: int(file.parent.name.rpartition("_")[2]), reverse=True)
        logs = {file: _read_log(file) for file in files}
        # Of a test of untrained weights everything is at step 0.
        trained = {file: log for file, log in logs.items() if LOSS in log} or {
            file: log for file, log in logs.items() if log.index.max() > 0
        }
        if trained:
            return _joined(trained)
    return None


def _read_log(file: Path) -> "DataFrame":
    """The curves, a row per step."""
    from pandas import read_csv

    try:
        log = read_csv(file, index_col="step", usecols=lambda name: name in {"step", *CURVES, *SWITCH_MARKS})
        return log.astype(float).groupby(log.index.astype(int)).last().dropna(axis=1, how="all")
    except ValueError as error:
        raise ValueError(f"expected numbers in {file}, and a column 'step', got {error}") from error


def _joined(logs: "dict[Path, DataFrame]") -> TrainingLog:
    """The newest log, which is the first, and of others that started before it the steps up to its start."""
    (newest, log), *older = logs.items()
    files = [newest]
    for file, before in older:
        if (start := _start(log)) > _start(before):
            files.insert(0, file)
            log = log.combine_first(before[before.index < start])
    marks = [log[name].dropna().index[0] for name in SWITCH_MARKS if name in log]
    curves = {name: _thinned(log[name].dropna()) for name in CURVES if name in log}
    return TrainingLog(curves, min(map(int, marks), default=None), tuple(files))


def _start(log: "DataFrame") -> int:
    """The first step that was trained, as far as it was logged."""
    return int((log[LOSS].dropna().index if LOSS in log else log.index[log.index > 0])[0])


def _thinned(curve: "Series[float]") -> tuple[list[float], list[float]]:
    """Steps and values in order; of long curves the means of equal parts."""
    parts = np.arange(len(curve)) // math.ceil(len(curve) / MOST_POINTS)
    means = curve.reset_index().groupby(parts).mean()
    return means.iloc[:, 0].tolist(), means.iloc[:, 1].tolist()
