"""`bpnp table`: several methods on the same pairs, in the form of the paper's tables."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from rich.console import Console
from rich.progress import track

from bpnp.report.figures import save_figure
from bpnp.report.published import Paper
from bpnp.report.tables import WIDTH
from bpnp.table.layout import Line, as_csv, as_latex, as_markdown, terminal
from bpnp.table.methods import SHORT_NAMES, Method, parse_methods
from bpnp.table.pairs import TestPairs, read_data, with_outlier_ratio
from bpnp.table.sweep import sweep_figure
from bpnp.table.work import Block, run

DESCRIPTION = """Run several methods on the same test pairs and print the paper's table. Started again, it goes on where
it was; a longer --limit adds to what is there. `--data.NAME=VALUE` overrides the recipe's data."""
METHODS_HELP = f"""[LABEL=]METHOD[@CHECKPOINT]: {", ".join(SHORT_NAMES)}, a class path, or a .yaml file with
model.solver. bpnpnet, matcher and hungarian need a checkpoint to be more than untrained."""


def table_command(arguments: Sequence[str], console: Console | None = None) -> None:
    """`bpnp table --data RECIPE --methods METHOD... [--limit N] [--rho SHARE...] [--output FOLDER]`.

    Raises ValueError or OSError for what cannot be read, is unknown, or does not belong to the folder's earlier runs.
    """
    chosen, overrides = _parser().parse_known_args(list(arguments))
    foreign = [text for text in overrides if text.startswith("-") and not text.startswith("--data.")]
    if foreign:
        raise ValueError(f"expected options of `bpnp table` or --data.NAME=VALUE, got {' '.join(foreign)}")
    methods = parse_methods(chosen.methods, time_limit=chosen.time_limit)
    data = read_data(chosen.data, overrides)
    indices = tuple(TestPairs(data).order[: chosen.limit])
    blocks = _blocks(chosen, methods, data, indices)
    missing = sum(len(block.missing) for _, block in blocks)
    console = console or _console()
    solved = run([block for _, block in blocks], processes=chosen.processes)
    for _ in track(solved, "pairs", total=missing, console=console, disable=missing == 0, transient=True):
        pass
    lines = [line for rho, block in blocks for line in _lines(block, rho)]
    paper = _paper(chosen.paper, data["class_path"])
    console.print(terminal(lines, paper))
    for path in _write(chosen.output, lines, paper):
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bpnp table", description=DESCRIPTION, allow_abbrev=False)
    parser.add_argument("--data", type=Path, required=True, metavar="RECIPE", help="YAML with `data`")
    parser.add_argument("--methods", nargs="+", required=True, metavar="METHOD", help=METHODS_HELP)
    parser.add_argument("--limit", type=_positive, help="pairs, a fixed random choice (default: all)")
    parser.add_argument(
        "--rho", nargs="+", type=_share, help="outliers a true pair on both sides: a table and a plot over these"
    )
    parser.add_argument("--time-limit", type=float, metavar="SECONDS", help="of a pair, for methods that have a limit")
    parser.add_argument("--processes", type=_positive, default=1, help="of one thread each (default: 1)")
    parser.add_argument(
        "--output", type=Path, default=Path("runs/table"), metavar="FOLDER", help="(default: runs/table)"
    )
    parser.add_argument(
        "--paper", choices=("auto", "modelnet40", "megadepth", "none"), default="auto", help="published rows beneath"
    )
    return parser


def _blocks(
    chosen: argparse.Namespace, methods: Sequence[Method], data: dict[str, object], indices: tuple[int, ...]
) -> list[tuple[float | None, Block]]:
    """A block for each method and outlier share; its folder is claimed for them."""
    blocks: list[tuple[float | None, Block]] = []
    for rho in chosen.rho or [None]:
        described = data if rho is None else with_outlier_ratio(data, rho)
        for method in methods:
            folder = chosen.output / ("" if rho is None else f"rho-{rho:g}") / _folder_name(method.label)
            block = Block(method, described, folder, indices)
            block.finished.claim({"method": method.identity, "data": described})
            blocks.append((rho, block))
    return blocks


def _lines(block: Block, rho: float | None) -> list[Line]:
    results = block.finished.summarise(block.indices)
    several = len(results.estimates) > 1
    return [
        Line(f"{block.method.label} {estimate}" if several else block.method.label, len(block.indices), values, rho)
        for estimate, values in results.estimates.items()
    ]


def _write(folder: Path, lines: Sequence[Line], paper: Paper | None) -> list[Path]:
    written = []
    for name, write in (("table.csv", as_csv), ("table.md", as_markdown), ("table.tex", as_latex)):
        (folder / name).write_text(write(lines, paper), encoding="utf-8", newline="")
        written.append(folder / name)
    if any(line.rho is not None for line in lines):
        written.append(save_figure(sweep_figure(lines), folder / "outliers.png"))
    return written


def _paper(wanted: str, class_path: str) -> Paper | None:
    if wanted != "auto":
        return None if wanted == "none" else cast(Paper, wanted)
    if class_path.endswith("MeshDataModule"):
        return "modelnet40"
    return "megadepth" if class_path.endswith("ColmapDataModule") else None


def _folder_name(label: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in label)


def _console() -> Console:
    console = Console()
    console.width = max(console.width, WIDTH + 10)
    return console


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a number of 1 or more, got {number}")
    return number


def _share(text: str) -> float:
    share = float(text)
    if not 0 <= share < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a share of 0 or more, got {text}")
    return share
