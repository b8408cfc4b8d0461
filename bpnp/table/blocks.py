"""From methods and data to blocks of tests, and from their results to the lines and files of a table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bpnp.files import write_text
from bpnp.report.figures import save_figure
from bpnp.report.runs import mean_and_spread
from bpnp.report.tables.rows import Row
from bpnp.report.tables.written_tables import as_csv, as_latex, as_markdown
from bpnp.table.methods import Method
from bpnp.table.pairs import TestPairs, with_outlier_ratio, with_setting
from bpnp.table.run import Block
from bpnp.table.sweep import sweep_figure


def blocks_of(
    output: Path,
    methods: Sequence[Method],
    data: dict[str, Any],
    limit: int | None,
    rho: float | None,
    seed: int | None,
) -> list[Block]:
    """The tests of all methods on the data with an outlier share and a seed, each in a folder of its own."""
    folder = output
    if rho is not None:
        data, folder = with_outlier_ratio(data, rho), folder / f"rho-{rho:g}"
    if seed is not None:
        data, folder = with_setting(data, "seed", seed), folder / f"seed-{seed}"
    indices = tuple(TestPairs(data).order[:limit])
    return [Block(method, data, folder / _folder_name(method.label), indices) for method in methods]


def rows_of(blocks: Sequence[Block], rho: float | None, seeds: int) -> list[Row]:
    """The rows of a share: each estimate of each method, its mean and standard deviation where there are several seeds.

    blocks: those of all methods for the first seed, then for the next.
    """
    results = [(block, block.summarise()) for block in blocks]
    rows = []
    for k in range(len(blocks) // seeds):
        own = results[k :: len(blocks) // seeds]
        block, first = own[0]
        pairs = {"pairs": sum(len(block.indices) for block, _ in own)}
        for estimate in first.estimates:
            label = f"{block.method.label} {estimate}" if len(first.estimates) > 1 else block.method.label
            mean, spread = mean_and_spread([each.estimates[estimate] for _, each in own])
            rows.append(Row(label, {**mean, **pairs}, rho=rho))
            if seeds > 1:
                label = f"{label}, standard deviation of {seeds} seeds"
                rows.append(Row(label, {**spread, **pairs}, seeds=True, rho=rho))
    return rows


def write_tables(folder: Path, rows: Sequence[Row]) -> list[Path]:
    written = []
    for name, write in (("table.csv", as_csv), ("table.md", as_markdown), ("table.tex", as_latex)):
        written.append(write_text(folder / name, write(rows)))
    if any(row.rho is not None for row in rows):
        written.append(save_figure(sweep_figure(rows), folder / "outliers.png"))
    return written


def _folder_name(label: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in label)
