"""Runs that differ by their seeds only, and the mean and the spread of their figures."""

import math
import os
import re
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from bpnp.report.results import Results

SEEDS = frozenset({"seed", "training_seed"})
PLACES = frozenset({"checkpoint", "complete"})  # settings that need not be equal
SPREAD = "  standard deviation"  # of a sample, n - 1; what a table calls its row

Values = Mapping[str, float]


def seed_groups(runs: Mapping[str, Results]) -> dict[str, tuple[str, ...]]:
    """The runs of each group of two or more by the group's name, such as "psb, mean of 3 seeds".

    Runs of a group have the same estimates and the same settings but for their seeds: all settings named "seed", of the
    data say, and "training_seed", that of the checkpoint's training. Runs of which two have the same seeds, or one has
    seeds that are not known, are no group: they differ by something else.
    """
    alike: dict[str, dict[str, tuple[Any, ...]]] = {}
    for name, results in runs.items():
        seeds: list[Any] = []
        settings = _without_seeds(results.settings, seeds)
        known = [seed is not None for seed in seeds]
        if any(known):
            trained = results.settings.get("checkpoint") is not None
            alike.setdefault(repr((settings, known, trained, sorted(results.estimates))), {})[name] = tuple(seeds)
    groups = [tuple(own) for own in alike.values() if len(own) > 1 and len(set(own.values())) == len(own)]
    return {f"{shared_name(group)}, mean of {len(group)} seeds": group for group in groups}


def with_spread(
    rows: Mapping[tuple[str, str], Values], groups: Mapping[str, Sequence[str]]
) -> list[tuple[str, Values]]:
    """For each estimate of each group two rows (label, values) of a table: the mean, and the standard deviation.

    rows: the values of each run and estimate.
    """
    found: list[tuple[str, Values]] = []
    for name, runs in groups.items():
        for estimate in (estimate for run, estimate in rows if run == runs[0]):
            mean, spread = mean_and_spread([rows[run, estimate] for run in runs])
            found += [(f"{name}: {estimate}", mean), (SPREAD, spread)]
    return found


def mean_and_spread(runs: Sequence[Values]) -> tuple[Values, Values]:
    """Mean and standard deviation over runs of each value that the first has; NaN where one is not finite, or alone.

    >>> mean_and_spread([{"found": 0.5}, {"found": 1.0}])
    ({'found': 0.75}, {'found': 0.3535533905932738})
    """
    columns = {key: [run.get(key, math.nan) for run in runs] for key in runs[0]}
    mean = {key: sum(values) / len(values) for key, values in columns.items()}
    spread = {
        key: statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan
        for key, values in columns.items()
    }
    return mean, spread


def shared_name(names: Sequence[str]) -> str:
    """What the names of runs begin with, without the word seed at its end; "runs" if they begin with nothing.

    >>> shared_name(["psb-seed0", "psb-seed12"])
    'psb'
    """
    return re.sub(r"[^A-Za-z0-9]*(seed)?[^A-Za-z0-9]*$", "", os.path.commonprefix(list(names))) or "runs"


def _without_seeds(settings: Any, seeds: list[Any]) -> Any:
    """The settings without seeds and places; the seeds are added to the list."""
    if not isinstance(settings, Mapping):
        return settings
    seeds += [settings[key] for key in sorted(SEEDS & settings.keys())]
    kept = sorted(settings.keys() - SEEDS - PLACES)
    return [(key, _without_seeds(settings[key], seeds)) for key in kept]
