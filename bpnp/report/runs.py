"""Several results side by side: what they are called, and their aggregates as plain rows."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bpnp.report.results import Results, read_results

if TYPE_CHECKING:
    from pandas import DataFrame


def named_runs(paths: Sequence[Path | str]) -> dict[str, Path]:
    """Results folders by what their paths do not share, at the start or at the end. Of a run's folder, its `test`.

    Raises ValueError if there is none.
    """
    if not paths:
        raise ValueError("expected at least one results folder, got none; try the folder that `bpnp test` wrote")
    folders = [Path(path).absolute() for path in paths]
    folders = [
        path / "test" if (path / "test" / "summary.json").is_file() and not (path / "summary.json").exists() else path
        for path in folders
    ]
    shared = os.path.commonpath([path.parent for path in folders])
    parts = [Path(os.path.relpath(path, shared)).parts for path in folders]
    while len(set(parts)) > 1 and min(map(len, parts)) > 1 and len({own[-1] for own in parts}) == 1:
        parts = [own[:-1] for own in parts]
    return {os.path.join(*own): path for own, path in zip(parts, folders, strict=True)}


def table(runs: Sequence[Path | str] | Mapping[str, Results]) -> "DataFrame":
    """Aggregates of one or several results for notebooks: a dataframe with a row per run and estimate and the columns
    "run", "estimate", "correspondence_loss" and all numbers of `summarise`.

    runs: results folders, or results by name. Raises ValueError if a folder cannot be read.
    """
    from pandas import DataFrame

    if not isinstance(runs, Mapping):
        runs = {name: read_results(path) for name, path in named_runs(runs).items()}
    rows = [
        {"run": name, "estimate": estimate, "correspondence_loss": results.correspondence_loss, **values}
        for name, results in runs.items()
        for estimate, values in results.estimates.items()
    ]
    return DataFrame(rows)
