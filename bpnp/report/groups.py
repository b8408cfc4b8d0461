"""Results by class, scene or landmark of the problems, and the settings in which runs differ."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bpnp.report.intervals import IntervalTable, interval_columns, interval_rows
from bpnp.report.results import ProblemRow, Results
from bpnp.report.training_run import training_config, training_of

MOST_GROUPS = 60
MOST_DIFFERENCES = 16
TRAINING = ("model", "optimizer", "lr_scheduler", "trainer", "seed_everything", "data")  # parts of a configuration
LITTLE = ("trainer.default_root_dir", "trainer.logger", "trainer.enable_", "trainer.profiler", "trainer.plugins")


def group_of(name: str) -> str:
    """Return the group of a problem: the part of its name before the first "/", such as a class or a scene."""
    return name.partition("/")[0]


def group_table(runs: Mapping[str, Results]) -> IntervalTable | None:
    """Return the table of intervals of each group of problems, the largest first.

    It is None if the problems of the first run do not belong to two or more groups.
    """
    parts = {name: split_groups(results) for name, results in runs.items()}
    first = next(iter(parts.values()))
    counts = Counter({group: results.problems for group, results in first.items()}).most_common(MOST_GROUPS)
    if len(counts) < 2 or counts[0][1] < 2:
        return None
    groups = {}
    for group, count in counts:
        members = {name: split[group] for name, split in parts.items() if group in split}
        groups[f"{group}, {count} problems" if count > 1 else f"{group}, 1 problem"] = interval_rows(runs, members)
    return IntervalTable("By class or scene", interval_columns(runs), groups)


def split_groups(results: Results) -> dict[str, Results]:
    """Return the rows of each group; problems whose names have no "/" are left out."""
    rows: dict[str, list[ProblemRow]] = {}
    for row in results.rows:
        if "/" in row.id:
            rows.setdefault(group_of(row.id), []).append(row)
    return {group: replace(results, rows=tuple(members)) for group, members in rows.items()}


def training_configs(folders: Mapping[str, Path], runs: Mapping[str, Results]) -> dict[str, dict[str, Any]]:
    """Return the configuration of the training of each run, empty for a run without one."""
    trainings = {name: training_of(folder, runs[name]) for name, folder in folders.items()}
    return {name: (training_config(run) if run else None) or {} for name, run in trainings.items()}


def differences(runs: Mapping[str, Results], trainings: Mapping[str, Mapping[str, Any]] | None = None) -> list[str]:
    """Return a line for each setting in which the runs differ, with the value of each run.

    Settings of the training, from `training_configs`, come first. Those of `LITTLE` are left out, and so are data and
    solver of the training where the test differs in the same way.
    """
    tested = {name: _test_settings(results.settings) for name, results in runs.items()}
    trained = {name: _training_settings((trainings or {}).get(name) or {}) for name in runs}
    lines = _differences(tested)
    of_training = {key: line for key, line in _differences(trained).items() if lines.get(key) != line}
    named = [f"training {key}: {line}" if key in lines else f"{key}: {line}" for key, line in of_training.items()]
    named += [f"{key}: {line}" for key, line in lines.items()]
    more = len(named) - MOST_DIFFERENCES
    return named if more <= 0 else [*named[:MOST_DIFFERENCES], f"and {more} more settings"]


def _differences(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the values of each setting in which runs differ, as text."""
    lines = {}
    for key in dict.fromkeys(key for values in settings.values() for key in values):
        runs_of: dict[str, list[str]] = {}
        for name, values in settings.items():
            value = values.get(key)
            runs_of.setdefault("none" if value is None else str(value), []).append(name)
        if len(runs_of) > 1:
            lines[key] = ", ".join(f"{value} ({', '.join(names)})" for value, names in runs_of.items())
    return lines


def _test_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a test by their dotted names; `bpnp table` repeats most of them in "method"."""
    own = {key: value for key, value in settings.items() if key != "method"}
    return _flat(own | {key: value for key, value in (settings.get("method") or {}).items() if key == "time_limit"})


def _training_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a training by their dotted names, which are those of a test for its solver and data."""
    chosen = {key: config[key] for key in TRAINING if config.get(key) is not None}
    names = {key: key.removeprefix("model.") if key.startswith("model.solver") else key for key in _flat(chosen)}
    return {names[key]: value for key, value in _flat(chosen).items() if not key.startswith(LITTLE)}


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings by their dotted names, without the levels of class_path and init_args.

    Objects in a list, such as callbacks, have the name of their class in place of a number.
    """
    found: dict[str, Any] = {}
    for key, value in settings.items():
        name = prefix if key == "init_args" else f"{prefix}.{key}".strip(".")
        if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            value = {str(item.get("class_path", i)).rpartition(".")[2]: item for i, item in enumerate(value)}
        if isinstance(value, Mapping):
            found |= _flat(value, name)
        else:
            found[name.removesuffix(".class_path")] = value
    return found
