"""`bpnp table`: several methods on the same problems, in the form of the paper's tables."""

import json
from contextlib import ExitStack
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bpnp.commands.output import say
from bpnp.commands.parser import at_least
from bpnp.files import claimed, packaged_config, write_text
from bpnp.report.terminal import Paper, console

if TYPE_CHECKING:
    from bpnp.report.tables import Row
    from bpnp.training.comparison import MethodTest

PAPERS: dict[str, Paper] = {"MeshDataModule": "modelnet40", "ColmapDataModule": "megadepth"}


def table(
    *,
    data: str,
    methods: list[str],
    limit: int | None = None,
    rho: list[float] | None = None,
    seeds: list[int] | None = None,
    time_limit: float | None = None,
    output: Path = Path("runs/table"),
    paper: Literal["auto", "modelnet40", "megadepth", "none"] = "auto",
    overrides: list[str] | None = None,
) -> None:
    """Test several methods on the same problems and print the paper's table.

    Each method has a folder of results, as of `bpnp test`. Started again, it skips the methods that are finished.
    `--data.NAME=VALUE` overrides the recipe's data.

    Args:
        data: name or file of a configuration with `data`.
        methods: [LABEL=]METHOD[@CHECKPOINT]; METHOD is softposit, ransac, gosma, gopac, hungarian, bpnpnet,
            matcher, search, a class path, or a .yaml file with model.solver. bpnpnet, matcher and hungarian need a
            CHECKPOINT (a file, or the name of packaged weights) to be more than untrained.
        limit: problems, a fixed random choice; all by default.
        rho: outliers a match on both sides; a table and a plot over these.
        seeds: of the data; the mean over these and its standard deviation.
        time_limit: seconds a problem, for methods that have a limit.
        output: folder of the results.
        paper: published rows beneath.
    """
    from bpnp.datamodules import Outliers
    from bpnp.report.figures import outlier_curves, save_figure
    from bpnp.report.tables import CAPTION, FILE_COLUMNS, as_latex, note, paper_rows, table_frame, table_of_rows
    from bpnp.training.comparison import MethodTest, parse_methods, read_data

    at_least(1, limit=limit)
    at_least(0, time_limit=time_limit, rho=min(rho, default=None) if rho else None)
    chosen = parse_methods(methods, time_limit=time_limit)
    recipe = Path(packaged_config(data))
    tests: dict[tuple[float | None, str], list[MethodTest]] = {}  # by share of outliers and method, a test a seed
    shares: list[float | None] = [*dict.fromkeys(rho)] if rho else [None]
    drawn: list[int | None] = [*dict.fromkeys(seeds)] if seeds else [None]
    for share, seed in product(shares, drawn):
        changes, folder = list(overrides or []), output
        if share is not None:
            outliers = json.dumps(asdict(Outliers(share)))
            changes, folder = [*changes, f"--data.test_outliers={outliers}"], folder / f"rho-{share:g}"
        if seed is not None:
            changes, folder = [*changes, f"--data.seed={seed}"], folder / f"seed-{seed}"
        described = read_data(recipe, changes)
        for method in chosen:
            name = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in method.label)
            tests.setdefault((share, method.label), []).append(MethodTest(method, described, folder / name, limit))
    every = [test for several in tests.values() for test in several]
    out = console()
    with ExitStack() as held:
        for test in every:
            held.enter_context(claimed(test.folder))
        missing = [test for test in every if test.results() is None]
        if len(missing) < len(every):
            say(f"{len(every) - len(missing)} of {len(every)} tests are finished, in {output}", to=out)
        for test in missing:
            say(f"testing {test.method.label} in {test.folder}", to=out)
            test.run(progress_bar=out.is_interactive)
        rows = [row for (share, label), repeated in tests.items() for row in _rows(label, share, repeated)]
    published = PAPERS.get(described["class_path"].rpartition(".")[2]) if paper == "auto" else paper
    rows += paper_rows(None if published == "none" else published)
    out.print(table_of_rows("Pose errors", FILE_COLUMNS, rows, " ".join([CAPTION, *note(rows)])))
    frame = table_frame(rows)
    for name, text in {"table.csv": frame.to_csv(index=False), "table.tex": as_latex(rows)}.items():
        say(f"wrote {write_text(output / name, text)}", to=out)
    if rho is not None:
        say(f"wrote {save_figure(outlier_curves(frame), output / 'outliers.png')}", to=out)


def _rows(label: str, share: float | None, tests: "list[MethodTest]") -> "list[Row]":
    """A row per estimate of a method; of several seeds their mean and standard deviation."""
    from pandas import DataFrame

    from bpnp.report.tables import Row

    results = [result for test in tests if (result := test.results()) is not None]
    count = {"problems": sum(result.problems for result in results)}
    rows = []
    for estimate in results[0].estimates:
        name = f"{label} {estimate}" if len(results[0].estimates) > 1 else label
        frame = DataFrame([result.estimates[estimate] for result in results])
        mean: dict[str, Any] = frame.mean(skipna=False).to_dict()
        rows.append(Row(name, mean | count, rho=share, problems=("rho", share)))
        if len(results) > 1:
            spread = frame.std(skipna=False).to_dict()
            rows.append(Row(f"{name}, standard deviation of {len(results)} seeds", spread | count, rho=share))
    return rows
