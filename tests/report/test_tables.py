import dataclasses
import io
import math
from pathlib import Path

import pytest
from report_data import row
from rich.console import Console
from rich.table import Table

from bpnp.report import Results, write_results
from bpnp.report.page import describe_run, quartile_rows
from bpnp.report.tables import results_table
from bpnp.report.terminal import SplitTable, count_items, progress


def rendered(table: Table | SplitTable, width: int = 80) -> list[str]:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(table)
    return capture.get().splitlines()


def bold(table: SplitTable) -> list[list[str]]:
    """The bold numbers of each row."""
    rows = [cells for group in table.groups for _, cells in group]
    return [[cell.plain for cell in cells if cell.style == "bold"] for cells in rows]


@pytest.mark.parametrize("width", [80, 100, 160])
@pytest.mark.parametrize("scale", [1e-12, 1e-5, 1e-3, 1.0, 1e4])
def test_tables_fit_with_every_name_and_number_whole(tmp_path: Path, scale: float, width: int) -> None:
    runs = {}
    for name in ("a-run-with-a-rather-long-name/version_0", "[red]b[/red]"):
        rows = [row(i, estimate) for i in range(9) for estimate in ("ransac", "pnp")]
        rows = [
            dataclasses.replace(r, rotation_error_deg=min(180.0, r.rotation_error_deg * scale), seconds=0.0123,
                                translation_error=r.translation_error * scale,
                                reprojection_error_deg=min(180.0, r.reprojection_error_deg * scale))
            for r in rows
        ]  # fmt: skip
        runs[name] = write_results(tmp_path / name, rows)
    table = results_table(runs, paper="megadepth")
    lines = rendered(table, width)
    assert max(map(len, lines)) <= width
    assert "…" not in "".join(lines)
    rows_shown = [cells for group in table.groups for _, cells in group]
    numbers = [cell.plain for cells in rows_shown for cell in cells]
    words = " ".join(lines).split()
    assert len(numbers) == 12 * len(rows_shown)  # every problem has a pose
    assert all(words.count(cell) >= numbers.count(cell) for cell in numbers)
    together = "".join("".join(lines).split())
    assert "[red]b[/red]:pnp" in together
    assert "version_0:ransac" in together or width < 160


def test_the_results_of_a_run_are_one_table_in_80_columns(tmp_path: Path) -> None:
    """Also two runs, whose names are folded."""
    errors = {"rotation_error_deg": 0.2531, "translation_error": 0.00852, "reprojection_error_deg": 0.1634}
    rows = [row(0, "ransac", seconds=0.0263), row(0, "pnp"), row(0, "refined", seconds=0.152, **errors)]
    runs = {name: write_results(tmp_path / name, rows) for name in ("Lc", "LcLp")}
    for shown in ({"LcLp": runs["LcLp"]}, runs):
        lines = rendered(results_table(shown))
        assert max(map(len, lines)) <= 80
        assert sum("Q1" in line and "quartiles" not in line for line in lines) == 1
        numbers = next(line for line in lines if "0.0085" in line)
        assert numbers.split()[-12:] == [*["0.25"] * 3, *["0.0085"] * 3, *["0.16"] * 3, *["100"] * 2, "0.15"]
        assert "Every problem has a pose." in " ".join(lines)


def test_one_problem_is_singular_in_the_table_and_on_the_page(tmp_path: Path) -> None:
    one, two = (write_results(tmp_path / str(count), [row(i) for i in range(count)]) for count in (1, 2))
    heads = ["".join(rendered(results_table({"run": results}))[0].split()) for results in (one, two)]
    assert heads == ["Poseerrors,1problem", "Poseerrors,2problems"]
    assert [describe_run(results).split(" with ")[0] for results in (one, two)] == ["1 problem", "2 problems"]


def test_the_best_of_each_column_is_bold(tmp_path: Path) -> None:
    good = {"rotation_error_deg": 1.0, "translation_error": 0.1, "reprojection_error_deg": 0.5, "seconds": 2.0}
    bad = {"rotation_error_deg": 180.0, "translation_error": math.inf, "reprojection_error_deg": 180.0, "seconds": 1.0}
    results = write_results(tmp_path, [row(0, "ransac", **good), row(0, "pnp", **bad, found=False)])
    table = results_table({"run": results}, paper="modelnet40")
    best = ["1.00"] * 3 + ["0.10"] * 3 + ["0.50"] * 3 + ["100"] * 3
    assert bold(table) == [best, ["1.00"], *[[]] * 7]
    alone = write_results(tmp_path, [row(0, **good)])
    assert bold(results_table({"run": alone})) == [[]]


def test_the_best_of_a_column_is_that_of_runs_on_the_same_problems(tmp_path: Path) -> None:
    def run(name: str, error: float, **settings: object) -> Results:
        return write_results(tmp_path / name, [row(0, rotation_error_deg=error)], settings=settings)

    def data(**options: object) -> dict[str, object]:
        return {"class_path": "Meshes", "init_args": {"seed": 0, **options}}

    same = {"a": run("a", 1.0, data=data(batch_size=2)), "b": run("b", 2.0, data=data(batch_size=4))}
    assert bold(results_table(same))[0][:3] == ["1.00"] * 3
    counts = {f"{part}_{what}": 9 for part in ("train", "val") for what in ("problems", "shapes")}
    training = data(**counts, train_outliers={"ratio": 1}, fresh_views=True, cache_dir="cache")
    assert bold(results_table(same | {"b": run("e", 2.0, data=training)}))[0][:3] == ["1.00"] * 3
    other = same | {"c": run("c", 0.1, data=data(seed=1)), "d": run("d", 0.2, data=data(num_points=3))}
    shown = bold(results_table(other))
    assert [texts[:3] for texts in shown[:2]] == [["1.00"] * 3, shown[1][:3]]
    assert "0.100" not in shown[2]
    assert shown[2] == shown[3] == []
    best = {value for row in quartile_rows(other, None) for _, value, best in row.cells if best}
    assert 1.0 in best
    assert 0.1 not in best


def test_progress_is_drawn_on_a_terminal_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """FORCE_COLOR, which Jupyter and build servers set, makes no terminal of a pipe: there each item has a line."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    with count_items("photos", 2) as done:
        done("a.jpg: confident")
        done("b.jpg: failed")
    assert capsys.readouterr() == ("", "1/2 a.jpg: confident\n2/2 b.jpg: failed\n")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert not progress().disable
    assert progress(quiet=True).disable
