"""The training curves of a run, from the CSV files that Lightning's CSVLogger leaves beside its results."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FOLDERS = ("logs", "lightning_logs")
LOSS = "train/loss"
CURVES = (
    LOSS,
    "train/correspondence_loss",
    "train/pose_loss",
    "val/correspondence_loss",
    "val/rotation_q2_deg",
    "val/recall_joint_15deg_0.5",
)
# These are logged from the first step with a pose loss on.
SWITCH_MARKS = ("train/pose_loss", "train/without_pose")
MOST_POINTS = 500
Columns = dict[str, dict[int, float]]  # by name, the values by step


@dataclass(frozen=True)
class TrainingLog:
    """Curves by name, each as (steps, values) of at most `MOST_POINTS` points.

    switch_step: the first logged step with the pose loss, None if it never joined. files: where the curves come from.
    """

    curves: dict[str, tuple[list[float], list[float]]]
    switch_step: int | None
    files: tuple[Path, ...]


def read_training_log(results: Path | str) -> TrainingLog | None:
    """The log of the run that a results folder belongs to: in `logs` or `lightning_logs` of it or of its parent.

    Of several versions the newest that trained counts, with those before it that it continues (a resumed run); of a
    training too short to log its loss, what was validated. None if nothing was trained. Raises ValueError that names
    the file if a value is no number.
    """
    folder = Path(results).absolute()
    for place in (folder, folder.parent):
        files = [file for name in FOLDERS for file in (place / name).glob("version_*/metrics.csv")]
        logs = [(file, _read(file)) for file in sorted(files, key=_version)]
        trained = [own for own in logs if LOSS in own[1]] or [own for own in logs if _steps(own[1])]
        if trained:
            return _joined(trained)
    return None


def _joined(logs: list[tuple[Path, Columns]]) -> TrainingLog:
    """The newest log, and of older ones that started before it the steps up to its start."""
    files: list[Path] = []
    curves: dict[str, dict[int, float]] = {}
    start = math.inf
    for file, log in reversed(logs):
        first = _steps(log)[0]
        if first < start:
            files.insert(0, file)
            for name, values in log.items():
                before = {step: value for step, value in values.items() if step < start}
                curves[name] = before | curves.get(name, {})
            start = first
    marks = [step for name in SWITCH_MARKS for step in curves.get(name, {})]
    thinned = {name: _thinned(curves[name]) for name in CURVES if name in curves}
    return TrainingLog(thinned, min(marks, default=None), tuple(files))


def _steps(log: Columns) -> list[int]:
    """The steps that were trained, as far as they were logged; untrained weights are at step 0."""
    return sorted(log.get(LOSS) or {step for values in log.values() for step in values if step > 0})


def _read(path: Path) -> Columns:
    """By column, the values by step."""
    columns: Columns = {}
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames is not None and "step" not in reader.fieldnames:
            raise ValueError(f"expected column 'step' in {path}, got {reader.fieldnames}")
        for row in reader:
            try:
                for name in {*CURVES, *SWITCH_MARKS} & {name for name, text in row.items() if text}:
                    columns.setdefault(name, {})[int(row["step"])] = float(row[name])
            except ValueError as error:
                raise ValueError(f"expected numbers in {path}, line {reader.line_num}, got {error}") from error
    return columns


def _thinned(values: dict[int, float]) -> tuple[list[float], list[float]]:
    """Steps and values in order; of long curves the means of equal parts."""
    curve = np.array(sorted(values.items()), float)
    size = math.ceil(len(curve) / MOST_POINTS)
    steps, means = np.transpose([part.mean(0) for part in np.split(curve, range(size, len(curve), size))]).tolist()
    return steps, means


def _version(path: Path) -> tuple[float, str]:
    number = path.parent.name.removeprefix("version_")
    return float(number if number.isdigit() else "inf"), str(path)
