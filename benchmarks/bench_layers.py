"""The layers against the paper's method (`paper_layers.py`), on the same inputs in the same run.

    python benchmarks/bench_layers.py [--quick] [--out benchmarks/results/cpu-2core.json]

Prints a table and writes it, with the machine and a plot of the ratios, to benchmarks/results/<machine kind>.json and
.png. Ours and the paper's take turns; times are medians over the rounds, ratios medians of the rounds' ratios, with
quartiles. Errors are against float64 (`exact.py`). Inputs (`problems.py`) are told by the kind of the features and the
share of the assignment on the true pairs.

Where other programs run beside it, compare the ratios of processor times.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from layer_rows import Row, Size, all_rows
from rich.console import Console
from rich.table import Table
from timing import Spread, machine, restart_with_settings, write_json

RESULTS = Path(__file__).parent / "results"
COLUMNS = ("what", "inputs", "B", "ours ms", "paper's ms", "ratio", "CPU ratio", "target", "error", "paper's error")


def show(rows: Sequence[Row], title: str) -> None:
    table = Table(*COLUMNS, title=title)
    for row in rows:
        race = row.race
        table.add_row(
            row.what, row.inputs, str(row.batch), _spread(race.ours.wall), _spread(race.baseline.wall),
            _spread(race.ratio), f"{race.cpu_ratio.median:.3g}", row.target, row.figure, row.paper_figure,
        )  # fmt: skip
    Console(width=None if Console().is_terminal else 170).print(table)


def _spread(value: Spread) -> str:
    return f"{value.median:.3g} ({value.low:.3g}-{value.high:.3g})"


def save_plot(rows: Sequence[Row], path: Path) -> None:
    """Ratio of every row with its quartiles, on a logarithmic axis."""
    figure, axes = plt.subplots(figsize=(12, 0.4 * len(rows) + 1), layout="constrained")
    ratios = [row.race.ratio for row in rows]
    medians = [ratio.median for ratio in ratios]
    axes.barh([f"{row.what}, {row.inputs}, B={row.batch}" for row in rows], medians, color="tab:blue")
    spread = [[r.median - r.low for r in ratios], [r.high - r.median for r in ratios]]
    axes.errorbar(medians, range(len(rows)), xerr=spread, fmt="none", ecolor="black", capsize=2)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="times faster than the paper's method")
    axes.invert_yaxis()
    figure.savefig(path, dpi=80, bbox_inches="tight")
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="200 points and 3 rounds, to see that it works")
    parser.add_argument("--out", type=Path, help="JSON file; the plot lies beside it")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--points", type=int, help="on each side (default 1000)")
    parser.add_argument("--rounds", type=int, help="timings of each side in a row (default 7)")
    parser.add_argument("--batches", type=int, nargs=2, help="batch sizes (default 4 16)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    points, rounds, batches = (200, 3, (2, 4)) if options.quick else (1000, 7, (4, 16))
    size = Size(options.points or points, options.rounds or rounds, tuple(options.batches or batches))
    before = machine()
    rows = []
    console = Console(stderr=True)
    for row in all_rows(size):
        rows.append(row)
        console.print(f"{row.what}, {row.inputs}, B={row.batch}: {row.race.ratio.median:.3g}x")
    title = f"{size.points} points, {size.rounds} rounds, {before['cpu']}, {before['threads']} threads"
    show(rows, title)
    out = options.out or RESULTS / f"{before['kind']}.json"
    busy = {"load_average_before": before.pop("load_average"), "load_average_after": machine()["load_average"]}
    write_json(out, {"machine": before | busy, "size": asdict(size), "rows": [asdict(row) for row in rows]})
    save_plot(rows, out.with_suffix(".png"))
    console.print(f"written to {out} and {out.with_suffix('.png')}")


if __name__ == "__main__":
    restart_with_settings()
    main()
