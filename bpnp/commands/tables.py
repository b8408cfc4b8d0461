"""`bpnp table`: several methods on the same pairs, in the form of the paper's tables."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bpnp.commands.output import console, progress, say
from bpnp.commands.parser import at_least
from bpnp.files import claimed, packaged_config
from bpnp.report.tables.published import Paper

if TYPE_CHECKING:
    from bpnp.table.run import Block

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

    Started again, it resumes; a longer --limit adds to what is there. `--data.NAME=VALUE` overrides the
    recipe's data.

    Args:
        data: name or file of a configuration with `data`.
        methods: [LABEL=]METHOD[@CHECKPOINT]; METHOD is softposit, ransac, gosma, gopac, constellation, hungarian,
            bpnpnet, matcher, search, a class path, or a .yaml file with model.solver. bpnpnet, matcher and hungarian
            need a CHECKPOINT (a file, or the name of packaged weights) to be more than untrained.
        limit: pairs, a fixed random choice; all by default.
        rho: outliers a true pair on both sides; a table and a plot over these.
        seeds: of the data; the table of each, and their mean with its standard deviation.
        time_limit: seconds a pair, for methods that have a limit.
        processes: worker processes of one thread each.
        output: folder of the results.
        paper: published rows beneath.
    """
    from bpnp.report.tables.result_tables import CAPTION, fitted
    from bpnp.report.tables.rows import paper_rows
    from bpnp.report.tables.written_tables import COLUMNS, note
    from bpnp.table.blocks import blocks_of, rows_of, write_tables
    from bpnp.table.methods import parse_methods
    from bpnp.table.pairs import read_data
    from bpnp.table.run import run

    at_least(1, limit=limit, processes=processes)
    at_least(0, time_limit=time_limit, rho=min(rho, default=None) if rho else None)
    chosen = parse_methods(methods, time_limit=time_limit)
    described = read_data(Path(packaged_config(data)), overrides or [])
    every: list[int | None] = [None] if seeds is None else [*dict.fromkeys(seeds)]
    lists: list[tuple[float | None, list["Block"]]] = [
        (share, [block for seed in every for block in blocks_of(output, chosen, described, limit, share, seed)])
        for share in ([None] if rho is None else dict.fromkeys(rho))
    ]
    blocks = [block for _, own in lists for block in own]
    out = console()
    with ExitStack() as held:
        for block in blocks:
            held.enter_context(claimed(block.folder))
            block.claim()
        missing = sum(len(block.missing()) for block in blocks)
        with progress() as shown:
            task = shown.add_task("pairs", total=missing)
            for tested in run(blocks, processes=processes):
                shown.advance(task, tested)
        rows = [row for ratio, own in lists for row in rows_of(own, ratio, len(every))]
    published = PAPERS.get(described["class_path"].rpartition(".")[2]) if paper == "auto" else paper
    rows += paper_rows(None if published == "none" else published)
    out.print(fitted("Pose errors", COLUMNS, rows, " ".join([CAPTION, *note(rows)])))
    for path in write_tables(output, rows):
        say(f"wrote {path}", to=out)
