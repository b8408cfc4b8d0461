"""`bpnp table`: several methods on the same pairs, in the form of the paper's tables."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

from rich.progress import Progress

from bpnp.commands.output import console, say
from bpnp.commands.parser import at_least
from bpnp.configs import packaged_config
from bpnp.files import claimed
from bpnp.report.figures import save_figure
from bpnp.report.published import Paper
from bpnp.report.runs import mean_and_spread
from bpnp.table.layout import Line, as_csv, as_latex, as_markdown, terminal
from bpnp.table.methods import Method, parse_methods
from bpnp.table.pairs import TestPairs, read_data, with_outlier_ratio, with_setting
from bpnp.table.run import Block, run
from bpnp.table.sweep import sweep_figure

PAPERS: dict[str, Paper] = {"MeshDataModule": "modelnet40", "ColmapDataModule": "megadepth"}


def table(
    *,
    data: str,
    methods: list[str],
    limit: int | None = None,
    rho: list[float] | None = None,
    seeds: list[int] | None = None,
    time_limit: float | None = None,
    processes: int = 1,
    output: Path = Path("runs/table"),
    paper: Literal["auto", "modelnet40", "megadepth", "none"] = "auto",
    overrides: list[str] | None = None,
) -> None:
    """Test several methods on the same pairs and print the paper's table.

    Started again, it goes on where it was; a longer --limit adds to what is there. `--data.NAME=VALUE` overrides the
    recipe's data.

    Args:
        data: name or file of a configuration with `data`.
        methods: [LABEL=]METHOD[@CHECKPOINT]; METHOD is softposit, ransac, gosma, gopac, hungarian, bpnpnet, matcher,
            search, a class path, or a .yaml file with model.solver. bpnpnet, matcher and hungarian need a checkpoint to
            be more than untrained.
        limit: pairs, a fixed random choice; all by default.
        rho: outliers a true pair on both sides; a table and a plot over these.
        seeds: of the data; the table of each, and their mean with its standard deviation.
        time_limit: seconds a pair, for methods that have a limit.
        processes: worker processes of one thread each.
        output: folder of the results.
        paper: published rows beneath.
    """
    at_least(1, limit=limit, processes=processes)
    at_least(0, time_limit=time_limit, rho=min(rho, default=None) if rho else None)
    chosen = parse_methods(methods, time_limit=time_limit)
    described = read_data(Path(packaged_config(data)), overrides or [])
    every: list[int | None] = [None] if seeds is None else [*dict.fromkeys(seeds)]
    lists: list[tuple[float | None, list[Block]]] = [
        (share, [block for seed in every for block in _blocks(output, chosen, described, limit, share, seed)])
        for share in ([None] if rho is None else dict.fromkeys(rho))
    ]
    blocks = [block for _, own in lists for block in own]
    out = console()
    with ExitStack() as held:
        for block in blocks:
            held.enter_context(claimed(block.folder))
            block.claim()
        missing = sum(len(block.missing()) for block in blocks)
        with Progress(console=out, disable=missing == 0, transient=True) as progress:
            bar = progress.add_task("pairs", total=missing)
            for tested in run(blocks, processes=processes):
                progress.advance(bar, tested)
        lines = [line for ratio, own in lists for line in _lines(own, ratio, len(every))]
    published = PAPERS.get(described["class_path"].rpartition(".")[2]) if paper == "auto" else _paper(paper)
    out.print(terminal(lines, published))
    for path in _write(output, lines, published):
        say(path, to=out)


def _blocks(
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


def _lines(blocks: Sequence[Block], rho: float | None, seeds: int) -> list[Line]:
    """The rows of a share: each estimate of each method, its mean and standard deviation where there are several seeds.

    blocks: those of all methods for the first seed, then for the next.
    """
    results = [(block, block.summarise()) for block in blocks]
    lines = []
    for k in range(len(blocks) // seeds):
        own = results[k :: len(blocks) // seeds]
        block, first = own[0]
        for estimate in first.estimates:
            label = f"{block.method.label} {estimate}" if len(first.estimates) > 1 else block.method.label
            pairs = sum(len(block.indices) for block, _ in own)
            mean, spread = mean_and_spread([each.estimates[estimate] for _, each in own])
            lines.append(Line(label, pairs, mean, rho))
            if seeds > 1:
                lines.append(Line(label, pairs, spread, rho, spread_of=seeds))
    return lines


def _write(folder: Path, lines: Sequence[Line], paper: Paper | None) -> list[Path]:
    written = []
    for name, write in (("table.csv", as_csv), ("table.md", as_markdown), ("table.tex", as_latex)):
        (folder / name).write_text(write(lines, paper), encoding="utf-8", newline="")
        written.append(folder / name)
    if any(line.rho is not None for line in lines):
        written.append(save_figure(sweep_figure(lines), folder / "outliers.png"))
    return written


def _paper(wanted: str) -> Paper | None:
    return next((paper for paper in PAPERS.values() if paper == wanted), None)


def _folder_name(label: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in label)
