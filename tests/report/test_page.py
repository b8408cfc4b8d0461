import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from plotly.offline import get_plotlyjs
from report_data import HOSTILE, inflated, row, rows, write_run

from bpnp.report import write_page, write_results
from bpnp.report.charts import RECALLS, Error, chart_text, recall_chart
from bpnp.report.page import page_html, page_numbers
from bpnp.report.points import write_points
from bpnp.report.results import CAUSES
from bpnp.report.terminal import number


class Elements(HTMLParser):
    """The page as a browser parses it: its elements and the text of its scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] == "script":
            self.scripts[-1] += data


def test_the_page_holds_the_numbers_of_the_results(tmp_path: Path) -> None:
    """All to five significant digits, those of the tables in full."""
    written = {name: write_run(tmp_path / name, 20, seed) for seed, name in enumerate(("a", "b"))}
    page = write_page([tmp_path / "a" / "test", tmp_path / "b"], tmp_path / "out" / "report.html", paper="megadepth")
    text = page.read_text(encoding="utf-8")
    data = json.loads(inflated(Elements(text).scripts[0]))
    columns = data["columns"]
    assert [(own["run"], own["estimate"]) for own in data["series"]] == [
        (r, e) for r in "ab" for e in ("ransac", "pnp")
    ]
    for own in data["series"]:
        results = written[own["run"]]
        assert columns[own["ids"]] == [HOSTILE.replace("\udcff", "?"), *(f"scene/{i:04d}" for i in range(1, 20))]
        for key in ("rotation_error_deg", "translation_error", "reprojection_error_deg", "seconds", "inliers", "n"):
            shown = np.array(columns[own["numbers"][key]], float)
            np.testing.assert_allclose(shown, [getattr(r, key) for r in results.of(own["estimate"])], rtol=6e-5)
        median = results.estimates[own["estimate"]]["rotation_q2_deg"]
        assert re.search(f'title="{re.escape(str(median))}">{re.escape(number(median))}</td>', text)
        causes = [r.cause for r in results.of(own["estimate"])]
        assert "".join(f"<td>{5 * causes.count(cause):.1f}%</td>" for cause in CAUSES) in text
    assert text.count("paper, MegaDepth: Lc Lp") == 2


def test_recall_curves_of_the_page_are_fractions_of_the_rows(tmp_path: Path) -> None:
    results = write_run(tmp_path, 200, 0)
    errors = np.array([row.rotation_error_deg for row in results.of("pnp")])
    recall = recall_chart({"run": results}, "rotation_deg")
    assert recall is not None
    line = recall.data[1]
    assert line.name == "pnp"
    np.testing.assert_allclose(line.y, [(errors <= limit * (1 + 1e-6)).mean() for limit in line.x], atol=0.006)
    assert chart_text(recall).endswith(f"pnp ends at {100 * (errors <= 90).mean():.1f}%")
    # The same line and colour as in the table: one a series.
    assert len({(trace.line.color, trace.line.dash) for trace in recall.data}) == len(recall.data)


def test_the_charts_show_the_quartiles_that_the_paper_prints(tmp_path: Path) -> None:
    """Table 2: Lc Lp has 1.32, 3.31 and 8.84 degrees. Rings belong to no run, and are no ends of curves."""
    results = write_run(tmp_path, 9, 0)
    chart = recall_chart({"run": results}, "rotation_deg", paper="megadepth")
    assert chart is not None
    (rings,) = (trace for trace in chart.data if trace.name == "paper: Lc Lp")
    np.testing.assert_allclose(rings.x, [1.32, 3.31, 8.84], rtol=1e-6)
    assert (list(rings.y), rings.mode, rings.meta) == ([0.25, 0.5, 0.75], "markers", None)
    assert "paper" not in chart_text(chart)
    joint = recall_chart({"run": results}, "joint", paper="megadepth")
    assert joint is not None
    assert len(joint.data) == 2


def test_intervals_and_curves_come_first(tmp_path: Path) -> None:
    """Before quartiles, groups, failures and problems; the links have the same order."""
    for seed, name in enumerate("ab"):
        write_run(tmp_path / name, 20, seed)
    page = page_html([tmp_path / "a", tmp_path / "b"])
    order = ["intervals", "recall", "quartiles", "groups", "versus-section", "failures", "problems"]
    assert re.findall('<section id="(.*?)">', page) == order
    assert re.findall('<a href="#(.*?)">', page) == order
    first = page[page.index('<section id="intervals">') : page.index('<section id="recall">')]
    assert '<th scope="row">minus a: pnp</th>' in first
    assert first.count('data-head="seconds mean"') == 6  # four estimates, two differences


def test_convergence_is_shown_only_where_a_problem_is_not_solved(tmp_path: Path) -> None:
    """A search that solves all and reports no convergence, and one that solves 8 of 10."""
    for name, wrong in (("all", 0), ("some", 2)):
        solved = [row(i, converged=False, rotation_error_deg=90.0 if i < wrong else 1.0) for i in range(10)]
        write_results(tmp_path / name, solved)
    page = page_html([tmp_path / "all", tmp_path / "some"])
    table = page[page.index('id="cause-table"') : page.index('id="problems"')]
    last = [re.findall("<td>(.*?)</td>", cells)[-1] for cells in re.findall("<tr data-series.*?</tr>", table, re.S)]
    assert last == ["", "0.0%"]


def test_the_page_opens_with_the_outcome_and_folds_the_settings(tmp_path: Path) -> None:
    settings = {"checkpoint": "runs/mine/last.ckpt"}
    write_results(tmp_path / "a" / "test", rows(9, 0), correspondence_loss=None, settings=settings)
    write_points(tmp_path / "a" / "test", [])
    page = page_html([tmp_path / "a"])
    opening = page[page.index("<h1>") : page.index("<details>")]
    assert "median rotation error" in opening
    assert "last.ckpt" not in opening
    assert "checkpoint runs/mine/last.ckpt" in page
    assert page.index("<details>") < page.index('id="quartiles"')


def test_the_page_loads_nothing_and_escapes_every_name(tmp_path: Path) -> None:
    write_run(tmp_path / HOSTILE[:8].replace("/", "-"), 9, 0)
    page = page_html(list(tmp_path.iterdir()))
    elements = Elements(page)
    assert len(elements.scripts) == 4
    assert not re.search(r"\b(src|srcset|action|data)=|@import|url\(|\bfetch\(|XMLHttpRequest|innerHTML", page)
    assert inflated(elements.scripts[2]) == get_plotlyjs()
    links = [attributes["href"] or "" for tag, attributes in elements.tags if "href" in attributes]
    assert len(links) > 3
    assert all(link == "data:," or link.startswith("#") for link in links)
    assert not re.search("https?://", page)
    policy = next(a["content"] or "" for tag, a in elements.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none';")


def test_unreadable_results_are_named_and_no_page_is_written(tmp_path: Path) -> None:
    output = tmp_path / "report.html"
    (tmp_path / "unfinished").mkdir()
    with pytest.raises(ValueError, match=r"unfinished is no results folder: it has no summary.json"):
        write_page([tmp_path / "unfinished"], output)
    with pytest.raises(ValueError, match="no results folder is given"):
        write_page([], output)
    write_run(tmp_path / "run", 9, 0)
    (tmp_path / "run" / "test" / "points.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"cannot read the points of a test in .*points.npz"):
        write_page([tmp_path / "run"], output)
    assert not output.exists()


def test_problems_of_one_name_in_other_data_are_not_paired(tmp_path: Path) -> None:
    """Two seeds of a data set draw other views of the same shapes; of two runs on one, some problems may be left."""

    def settings(seed: int) -> dict[str, object]:
        return {"data": {"class_path": "bpnp.datamodules.MeshDataModule", "init_args": {"seed": seed}}}

    runs = {
        name: write_results(tmp_path / name, rows(8, seed)[2 * first :], settings=settings(data))
        for name, seed, first, data in (("a", 0, 0, 1), ("part", 1, 3, 1), ("other", 2, 0, 2))
    }
    numbers = page_numbers(runs)
    problems = {own["name"]: numbers["columns"][own["problems"]] for own in numbers["series"]}
    assert problems["a: ransac"] == problems["a: pnp"]
    assert problems["part: ransac"] == problems["a: ransac"][3:]
    assert not {*problems["other: ransac"]} & {*problems["a: ransac"]}
    assert len({*problems["other: ransac"]}) == 8
    note = "No differences for part, other: a was tested on other problems."
    assert note in page_html([tmp_path / name for name in runs])
    twins = write_results(tmp_path / "twins", [row(0, id="x"), row(1, id="x")])
    numbers = page_numbers({"twins": twins})
    assert len({*numbers["columns"][numbers["series"][0]["problems"]]}) == 2


@pytest.mark.parametrize("error", ["rotation_deg", "reprojection_deg"])
def test_a_chart_of_a_test_without_a_pose_shows_no_problem_within_a_limit(tmp_path: Path, error: Error) -> None:
    """Errors of 180 degrees stand for no pose; a curve that reached them would end at 100 %."""
    lost = {"rotation_error_deg": 180.0, "reprojection_error_deg": 180.0, "translation_error": math.inf}
    runs = {"lost": write_results(tmp_path, [row(i, **lost, centre_error=math.inf, found=False) for i in range(3)])}
    chart = recall_chart(runs, error)
    assert chart is not None
    assert max(chart.data[0].x) <= 90
    assert set(chart.data[0].y) == {0}


def test_a_chart_of_exact_poses_shows_all_problems_within_every_limit(tmp_path: Path) -> None:
    exact = dict.fromkeys(("rotation_error_deg", "translation_error", "centre_error", "reprojection_error_deg"), 0.0)
    runs = {"exact": write_results(tmp_path, [row(i, **exact) for i in range(3)])}
    for error in RECALLS:
        chart = recall_chart(runs, error)
        assert chart is not None
        assert set(chart.data[0].y) == {1}
