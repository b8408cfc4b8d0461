"""`bpnp table`: several methods on the same pairs, in the form of the paper's tables."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

from rich.progress import track

from bpnp.commands.output import console, say
from bpnp.commands.parser import at_least
from bpnp.configs import packaged_config
from bpnp.files import claimed
from bpnp.report.figures import save_figure
from bpnp.report.published import Paper
from bpnp.table.layout import Line, as_csv, as_latex, as_markdown, terminal
from bpnp.table.methods import Method, parse_methods
from bpnp.table.pairs import TestPairs, read_data, with_outlier_ratio
from bpnp.table.run import Block, run
from bpnp.table.sweep import sweep_figure

PAPERS: dict[str, Paper] = {"MeshDataModule": "modelnet40", "ColmapDataModule": "megadepth"}


def table(
    *,
    data: str,
    methods: list[str],
    limit: int | None = None,
    rho: list[float] | None = None,
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
        time_limit: seconds a pair, for methods that have a limit.
        processes: worker processes of one thread each.
        output: folder of the results.
        paper: published rows beneath.
    """
    at_least(1, limit=limit, processes=processes)
    at_least(0, time_limit=time_limit, rho=min(rho, default=None) if rho else None)
    chosen = parse_methods(methods, time_limit=time_limit)
    described = read_data(Path(packaged_config(data)), overrides or [])
    indices = tuple(TestPairs(described).order[:limit])
    shares: list[float | None] = [None] if rho is None else [*rho]
    blocks = [(share, block) for share in shares for block in _blocks(output, chosen, described, indices, share)]
    out = console()
    with ExitStack() as held:
        for _, block in blocks:
            held.enter_context(claimed(block.folder))
            block.claim()
        missing = sum(len(block.missing()) for _, block in blocks)
        solved = run([block for _, block in blocks], processes=processes)
        for _ in track(solved, "pairs", total=missing, console=out, disable=missing == 0, transient=True):
            pass
        lines = [line for ratio, block in blocks for line in _lines(block, ratio)]
    published = PAPERS.get(described["class_path"].rpartition(".")[2]) if paper == "auto" else _paper(paper)
    out.print(terminal(lines, published))
    for path in _write(output, lines, published):
        say(path, to=out)


def _blocks(
    output: Path, methods: Sequence[Method], data: dict[str, Any], indices: tuple[int, ...], rho: float | None
) -> list[Block]:
    harder = data if rho is None else with_outlier_ratio(data, rho)
    folder = output if rho is None else output / f"rho-{rho:g}"
    return [Block(method, harder, folder / _folder_name(method.label), indices) for method in methods]


def _lines(block: Block, rho: float | None) -> list[Line]:
    results = block.summarise()
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


def _paper(wanted: str) -> Paper | None:
    return next((paper for paper in PAPERS.values() if paper == wanted), None)


def _folder_name(label: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in label)
