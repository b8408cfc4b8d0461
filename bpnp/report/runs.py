"""Several runs: their names, their figures as a DataFrame, and how each is drawn."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bpnp.report.results import SUMMARY, Results, read_results
from bpnp.report.terminal import DASHES, LIGHT

if TYPE_CHECKING:
    from pandas import DataFrame


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
