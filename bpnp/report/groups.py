"""Results by class, scene or landmark of the problems, and the settings in which runs differ."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from bpnp.report.results import Results
from bpnp.report.tables import lines_of
from bpnp.report.terminal import number

MOST_GROUPS = 60
MOST_DIFFERENCES = 8


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


def differences(runs: Mapping[str, Results]) -> list[str]:
    """Return a line for each setting in which the runs differ, with the value of each run."""
    flat = {name: _flat(results.settings) for name, results in runs.items()}
    keys = dict.fromkeys(key for settings in flat.values() for key in settings)
    lines = []
    for key in keys:
        values = {name: settings.get(key) for name, settings in flat.items()}
        if len({repr(value) for value in values.values()}) > 1:
            lines.append(f"{key}: " + ", ".join(f"{value} ({name})" for name, value in values.items()))
    return lines[:MOST_DIFFERENCES]


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings by their dotted names, without the levels of class_path and init_args."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        name = prefix if key == "init_args" else f"{prefix}.{key}".strip(".")
        if isinstance(value, Mapping):
            found |= _flat(value, name)
        else:
            found[name.removesuffix(".class_path")] = value
    return found
