"""Tables of test results for the terminal: quartiles, recall at standard points, untrained against trained."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.metrics import RecallThresholds, pose_recalls
from bpnp.report.folder import read_results
from bpnp.report.results import Results
from bpnp.report.runs import named_runs, read_runs, seed_groups, trained_only, with_spread
from bpnp.report.tables.fitted_table import WIDTH, FittedTable
from bpnp.report.tables.published import Paper, published_rows
from bpnp.report.training_log import TrainingLog, read_training_log

Values = Mapping[str, float]


@dataclass(frozen=True)
class Column:
    """Where a column's number is found, what is written above it, and whether it is a share (shown in %, more is
    better) or an error or a time (less is better)."""

    key: str
    header: str
    share: bool = False


QUARTILES = tuple(
    Column(f"{error}_q{number}{unit}", f"{short}\nQ{number}")
    for error, unit, short in (
        ("rotation", "_deg", "rot"),
        ("translation", "", "trans"),
        ("reprojection", "_deg", "repr"),
    )
    for number in (1, 2, 3)
)
RESULT_COLUMNS = (
    *QUARTILES,
    Column("recall_joint_15deg_0.5", "15deg\n0.5", share=True),
    Column("recall_joint_10deg_1", "10deg\n1.0", share=True),
    Column("found", "found\n%", share=True),
    Column("seconds_mean", "sec"),
)
STANDARD_POINTS = RecallThresholds((1, 2, 5, 10, 20), (0.05, 0.1, 0.2, 0.5, 1), (), (0.25, 0.5, 1, 2))
RECALL_COLUMNS = (
    *(Column(f"recall_rotation_{limit:g}deg", f"rot\n{limit:g}", share=True) for limit in STANDARD_POINTS.rotation_deg),
    *(
        Column(f"recall_translation_{limit:g}", f"trans\n{limit:g}", share=True)
        for limit in STANDARD_POINTS.translation
    ),
    *(
        Column(f"recall_reprojection_{limit:g}deg", f"repr\n{limit:g}", share=True)
        for limit in STANDARD_POINTS.reprojection_deg
    ),
)


def results_table(runs: Mapping[str, Results], *, paper: Paper | None = None) -> FittedTable:
    """Quartiles, joint recalls, share of pairs with a pose and seconds per pair, a row per run and estimate.

    Runs that differ by their seeds only have rows of their mean and standard deviation beneath. The best number of each
    column is bold. `paper` adds the published rows of that data set, for orientation only: they
    are of other data and take no part in the comparison.
    """
    caption = (
        "rot, repr: errors in degrees; trans: in scene units; 15deg 0.5, 10deg 1.0: % of pairs with both rotation and "
        "translation error within; sec: seconds per pair. A pair without a pose counts as 180 deg and inf."
    )
    return _table(_title("Pose errors", runs), RESULT_COLUMNS, runs, published_rows(paper), caption)


def recall_table(runs: Mapping[str, Results]) -> FittedTable:
    """Recall in % at standard errors of rotation (deg), translation (scene units) and reprojection (deg)."""
    caption = "% of pairs with an error up to the number in the head: rot, repr in degrees; trans in scene units."
    return _table(_title("Recall", runs), RECALL_COLUMNS, runs, {}, caption)


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
    paths: Sequence[Path],
    console: Console | None = None,
    *,
    paper: Paper | None = None,
    untrained: Path | None = None,
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


def number(value: float | None) -> str:
    """Three significant digits in at most six characters: two digits below 0.01; "-" for none."""
    if value is None:
        return "-"
    size = abs(value)
    if size == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 0.01 <= size < 999.5:
        return f"{value:#.3g}".rstrip(".")
    if 0.001 <= size < 0.01:
        return f"{value:.4f}"
    if 999.5 <= size < 99_999.5:
        return f"{value:.0f}"
    mantissa, exponent = f"{value:.{0 if size < 1e-9 else 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _values(results: Results, estimate: str) -> Values:
    standard = pose_recalls(results.errors(estimate), STANDARD_POINTS)
    return results.estimates[estimate] | {key: float(value) for key, value in standard.items()}


def _title(what: str, runs: Mapping[str, Results]) -> str:
    sizes = sorted({results.pairs for results in runs.values()})
    return f"{what}, {' or '.join(map(str, sizes))} pairs"


def _table(
    title: str,
    columns: Sequence[Column],
    runs: Mapping[str, Results],
    published: Mapping[str, Mapping[str, str]],
    caption: str,
) -> FittedTable:
    """A row per run and estimate, then mean and spread of the runs that differ by their seeds, then what is printed."""
    rows = {(run, name): _values(results, name) for run, results in runs.items() for name in results.estimates}
    best = best_texts(columns, list(rows.values()))
    shown = {key: {column.key: cell(column, values) for column in columns} for key, values in rows.items()}
    here = [
        (
            Text(estimate if len(runs) == 1 else f"{run}: {estimate}"),
            [Text(text, "bold" if text == best[key] else "") for key, text in cells.items()],
        )
        for (run, estimate), cells in shown.items()
    ]
    seeds = [
        (Text(label), [Text(cell(column, values)) for column in columns])
        for label, values in with_spread(rows, seed_groups(runs))
    ]
    paper = [
        (Text(label, "dim"), [Text(printed.get(column.key, "-"), "dim") for column in columns])
        for label, printed in published.items()
    ]
    return FittedTable(title, [column.header for column in columns], [here, seeds, paper], caption)


def cell(column: Column, values: Values) -> str:
    """What a table shows of a column: a share in percent, else `number`."""
    value = values.get(column.key)
    return f"{100 * value:.1f}" if column.share and value is not None else number(value)


def best_texts(columns: Sequence[Column], rows: Sequence[Values]) -> dict[str, str | None]:
    """The best number of each column as it is shown; None where there is nothing to compare."""
    return {column.key: _best(column, rows) for column in columns}


def _best(column: Column, rows: Sequence[Values]) -> str | None:
    """The best number as it is shown, so that what reads the same is marked the same; nothing to mark in one row."""
    known = [row for row in rows if math.isfinite(row.get(column.key, math.nan))]
    if len(rows) < 2 or not known:
        return None
    return cell(column, (max if column.share else min)(known, key=lambda row: row[column.key]))
