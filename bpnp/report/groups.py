"""Results by class, scene or landmark of the problems, and the settings in which runs differ."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.report.results import Results
from bpnp.report.tables import lines_of
from bpnp.report.terminal import number
from bpnp.report.training_run import training_config, training_of

MOST_GROUPS = 60
MOST_DIFFERENCES = 16
TRAINING = ("model", "optimizer", "lr_scheduler", "trainer", "seed_everything", "data")  # parts of a configuration
LITTLE = ("trainer.default_root_dir", "trainer.logger", "trainer.enable_", "trainer.profiler", "trainer.plugins")


def group_of(name: str) -> str:
    """Return the group of a problem: the part of its name before the first "/", such as a class or a scene."""
    return name.partition("/")[0]


def group_rows(runs: Mapping[str, Results]) -> list[tuple[str, int, list[str]]]:
    """Return the group, the number of problems, and the median rotation error of each run and estimate.

    The largest groups come first. The list is empty unless the problems belong to two or more groups.

    Args:
        runs: Results by name.
    """
    counts = Counter(group_of(row.id) for row in _problems(runs) if "/" in row.id)
    if len(counts) < 2 or max(counts.values()) < 2:
        return []
    rows = []
    for group, count in counts.most_common(MOST_GROUPS):
        cells = []
        for line in lines_of(runs):
            members = [row for row in runs[line.run].of(line.estimate) if group_of(row.id) == group]
            cells.append(number(float(np.median([row.rotation_error_deg for row in members]))) if members else "")
        rows.append((group, count, cells))
    return rows


def _problems(runs: Mapping[str, Results]) -> list[Any]:
    first = next(iter(runs.values()))
    return first.of(next(iter(first.estimates)))


def training_configs(folders: Mapping[str, Path], runs: Mapping[str, Results]) -> dict[str, dict[str, Any]]:
    """Return the configuration of the training of each run, empty for a run without one.

    Args:
        folders: Results folders by name.
        runs: Their results.
    """
    trainings = {name: training_of(folder, runs[name]) for name, folder in folders.items()}
    return {name: (training_config(run) if run else None) or {} for name, run in trainings.items()}


def differences(runs: Mapping[str, Results], trainings: Mapping[str, Mapping[str, Any]] | None = None) -> list[str]:
    """Return a line for each setting in which the runs differ, with the value of each run.

    Settings of the training come first. Those of `LITTLE` are left out, and so are data and solver of the training
    where the test differs in the same way.

    Args:
        runs: Results by name.
        trainings: Configurations of their trainings, from `training_configs`. Default: None, without.
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
