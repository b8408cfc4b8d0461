"""Several runs: names, figures as a DataFrame, and mean and spread of those that differ by their seeds only."""

import math
import os
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bpnp.report.folder import read_results
from bpnp.report.palette import styles
from bpnp.report.results import Results

if TYPE_CHECKING:
    from pandas import DataFrame

SEEDS = frozenset({"seed", "training_seed"})
PLACES = frozenset({"checkpoint", "complete"})  # settings that need not be equal
SPREAD = "  standard deviation"  # of a sample, n - 1; what a table calls its row

Values = Mapping[str, float]


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


class Series(NamedTuple):
    """An estimate of a run as tables and figures show it. colour, dashes: indices of the palette."""

    run: str
    estimate: str
    label: str
    colour: int
    dashes: int


def series_of(runs: Mapping[str, Results]) -> list[Series]:
    """Every estimate of every run, with the run's name only where there are several."""
    shapes = styles({run: list(results.estimates) for run, results in runs.items()})
    return [Series(*key, key[1] if len(runs) == 1 else ": ".join(key), *shape) for key, shape in shapes.items()]


def trained_only(paths: Sequence[Path | str]) -> bool:
    """Whether these are folders of trainings of which none has results yet."""
    return bool(paths) and not any(path.is_file() for place in paths for path in Path(place).rglob("summary.json"))


def named_runs(paths: Sequence[Path | str]) -> dict[str, Path]:
    """Results folders by what their paths do not share, at the start or at the end; a single one by its run.

    Of a run's folder, its `test`; of a folder of several results, such as that of `bpnp table`, all of them. Raises
    ValueError if there is none.
    """
    if not paths:
        raise ValueError("expected at least one results folder, got none; try the folder that `bpnp test` wrote")
    folders = [Path(path).absolute() for path in paths]
    folders = [place for path in folders for place in _results_in(path)]
    if len(folders) == 1:
        (folder,) = folders
        return {(folder.parent if folder.name == "test" else folder).name: folder}
    shared = os.path.commonpath([path.parent for path in folders])
    parts = [Path(os.path.relpath(path, shared)).parts for path in folders]
    while len(set(parts)) > 1 and min(map(len, parts)) > 1 and len({own[-1] for own in parts}) == 1:
        parts = [own[:-1] for own in parts]
    return {os.path.join(*own): path for own, path in zip(parts, folders, strict=True)}


def _results_in(folder: Path) -> list[Path]:
    for place in (folder, folder / "test"):
        if (place / "summary.json").is_file():
            return [place]
    return sorted(path.parent for path in folder.rglob("summary.json")) or [folder]


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
