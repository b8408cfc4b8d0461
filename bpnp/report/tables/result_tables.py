"""Tables of test results for the terminal: quartiles, recall at standard points, untrained against trained."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.report.folder import read_results
from bpnp.report.results import Results
from bpnp.report.runs import named_runs, read_runs, trained_only
from bpnp.report.tables.fitted_table import WIDTH, FittedTable
from bpnp.report.tables.published import Paper
from bpnp.report.tables.rows import (
    HERE,
    RECALL_COLUMNS,
    RESULT_COLUMNS,
    Column,
    Row,
    best_texts,
    cell,
    number,
    run_rows,
)
from bpnp.report.training_log import TrainingLog, read_training_log

CAPTION = (
    "rot, repr: errors in degrees; trans: in scene units; quartiles Q1, Q2, Q3. 15deg 0.5, 10deg 1.0: % of pairs with "
    "both rotation and translation error within. sec: mean seconds a pair. No pose counts as 180 deg and inf."
)


def results_table(runs: Mapping[str, Results], *, paper: Paper | None = None) -> FittedTable:
    """Quartiles, joint recalls, share of pairs with a pose and seconds per pair, a row per run and estimate.

    Runs that differ by their seeds only have rows of their mean and standard deviation beneath. The best number of each
    column is bold. `paper` adds the published rows of that data set, for orientation only: they
    are of other data and take no part in the comparison.
    """
    return fitted(_title("Pose errors", runs), RESULT_COLUMNS, run_rows(runs, paper), CAPTION)


def recall_table(runs: Mapping[str, Results]) -> FittedTable:
    """Recall in % at standard errors of rotation (deg), translation (scene units) and reprojection (deg)."""
    caption = "% of pairs with an error up to the number in the head: rot, repr in degrees; trans in scene units."
    return fitted(_title("Recall", runs), RECALL_COLUMNS, run_rows(runs), caption)


def fitted(title: str, columns: Sequence[Column], rows: Sequence[Row], caption: str) -> FittedTable:
    """The table of rows: those of runs, the best numbers bold, those of several seeds, those of the paper."""
    best = best_texts(columns, rows)
    groups: tuple[list[tuple[Text, list[Text]]], ...] = ([], [], [])
    for row in rows:
        place = 2 if row.source != HERE else int(row.seeds)
        dim = "dim" if place == 2 else ""
        texts = [(column.key, cell(column, row.values)) for column in columns]
        shown = [Text(text, "bold" if place == 0 and text == best[key] else dim) for key, text in texts]
        groups[place].append((Text(row.name, dim), shown))
    return FittedTable(title, [column.header for column in columns], groups, caption)


def learning_table(before: Results, after: Results) -> Table:
    """Correspondence loss and median rotation error of each estimate, untrained and trained, side by side.

    Raises ValueError if the two are not of the same pairs.
    """
    ids = [sorted({(row.index, row.id) for row in results.rows}) for results in (before, after)]
    if ids[0] != ids[1]:
        raise ValueError(f"expected the same pairs untrained and trained, got {len(ids[0])} and {len(ids[1])} pairs")
    table = Table(title=_title("Learning", {"": after}), box=box.SIMPLE_HEAD)
    table.add_column("")
    for header in ("untrained", "trained"):
        table.add_column(header, justify="right", no_wrap=True)
    table.add_row("correspondence loss", *(number(results.correspondence_loss) for results in (before, after)))
    for estimate in dict.fromkeys([*before.estimates, *after.estimates]):
        medians = (results.estimates.get(estimate, {}).get("rotation_q2_deg") for results in (before, after))
        table.add_row(Text(f"median rotation error, deg: {estimate}"), *map(number, medians))
    return table


def training_table(logs: Mapping[str, TrainingLog]) -> FittedTable:
    """The last and the smallest value of each curve of each training."""
    rows = []
    for name, log in logs.items():
        for curve, (steps, values) in log.curves.items():
            known = [value for value in values if math.isfinite(value)]
            shown = (f"{steps[-1]:.0f}", number(values[-1]), number(min(known, default=None)))
            rows.append((Text(curve if len(logs) == 1 else f"{name}: {curve}"), [Text(text) for text in shown]))
    return FittedTable("Training", ["steps", "last", "smallest"], [rows], "Nothing tested yet; try `bpnp test`.")


def report(
    paths: Sequence[Path], console: Console | None = None, *, paper: Paper | None = None, untrained: Path | None = None
) -> None:
    """Print the tables of one or several results folders, named by what their paths do not share.

    `untrained` is the folder of the last run's untrained weights. Without `console`, standard output at least `WIDTH`
    columns wide. Raises ValueError if a folder cannot be read.
    """
    if console is None:
        console = Console()
        console.width = max(console.width, WIDTH)
    logs = {name: read_training_log(path) for name, path in named_runs(paths).items()} if trained_only(paths) else {}
    known = {name: log for name, log in logs.items() if log is not None}
    if known:
        console.print(training_table(known))
        return
    runs = read_runs(paths)
    console.print(results_table(runs, paper=paper))
    console.print(recall_table(runs))
    if untrained is not None:
        console.print(learning_table(read_results(untrained), list(runs.values())[-1]))


def _title(what: str, runs: Mapping[str, Results]) -> str:
    sizes = sorted({results.pairs for results in runs.values()})
    return f"{what}, {' or '.join(map(str, sizes))} pairs"
