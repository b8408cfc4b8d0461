import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from report_data import HOSTILE, rows, view, write_run

from bpnp.report import write_page, write_results
from bpnp.report.page import MOST_BYTES, page_html, script_json


class Elements(HTMLParser):
    """What a browser would make of the page: its elements and the text of its scripts."""

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


def unpacked(column: dict[str, str]) -> np.ndarray:
    ((kind, text),) = column.items()
    return np.frombuffer(base64.b64decode(text), "<" + kind)


def test_the_page_holds_the_numbers_of_the_results(tmp_path: Path) -> None:
    written = [write_run(tmp_path / name, 20, seed) for seed, name in enumerate(("a", "b"))]
    page = write_page([tmp_path / "a" / "test", tmp_path / "b"], tmp_path / "out" / "report.html", paper="megadepth")
    data = json.loads(Elements(page.read_text(encoding="utf-8")).scripts[0])
    assert [run["name"] for run in data["runs"]] == ["a", "b"]
    assert data["ids"] == [[HOSTILE, *(f"scene/{i:04d}" for i in range(1, 20))]]
    for run, results in zip(data["runs"], written, strict=True):
        assert unpacked(run["sizes"]["n"]).tolist() == [row.n for row in results.rows if row.estimate == "pnp"]
        for name, estimate in run["estimates"].items():
            written_rows = [row for row in results.rows if row.estimate == name]
            for key in ("rotation_error_deg", "translation_error", "reprojection_error_deg", "seconds", "inliers"):
                np.testing.assert_allclose(
                    unpacked(estimate["columns"][key]), [getattr(row, key) for row in written_rows], rtol=1e-6
                )
            assert estimate["cells"][1][1] == results.estimates[name]["rotation_q2_deg"]
    assert [row["name"] for row in data["paper"]] == ["paper, MegaDepth: Lc Lp R", "paper, MegaDepth: Lc Lp"]
    assert [log["switch_step"] for log in data["logs"]] == [50, 50]


def test_nothing_on_the_page_comes_from_elsewhere_or_escapes_its_place(tmp_path: Path) -> None:
    write_run(tmp_path / HOSTILE[:8].replace("/", "-"), 9, 0)
    page = page_html(list(tmp_path.iterdir()))
    elements = Elements(page)
    assert len(elements.scripts) == 3
    assert not re.search(r"\b(src|srcset|action|data)=|@import|url\(|\bfetch\(|XMLHttpRequest|innerHTML", page)
    links = [attributes["href"] or "" for tag, attributes in elements.tags if "href" in attributes]
    assert all(link == "data:," or link.startswith("#") for link in links)
    assert set(re.findall(r"https?://[^\"']*", page)) == {"http://www.w3.org/2000/svg"}
    policy = next(a["content"] or "" for tag, a in elements.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none';")


def test_eight_runs_of_ten_thousand_pairs_stay_under_20_mb(tmp_path: Path) -> None:
    """Numbers grow with the pairs, points of views with the runs, and sketches fill the room that is left."""
    sizes = []
    for count in (200, 1200):
        write_results(tmp_path / str(count), rows(count, 0, ("ransac", "pnp", "refined")))
        sizes.append(len(page_html([tmp_path / str(count)]).encode()))
    views = 24 * 300 * 2 * (2 + 3 + 1 + 1) * 4 / 3
    assert sizes[0] + 8 * (10_795 * (sizes[1] - sizes[0]) / 1000 + views) < MOST_BYTES - 5e6
    assert sizes[0] < 20e6 - MOST_BYTES


@pytest.mark.parametrize("text", [HOSTILE, "<!--<script>", "]]>", "\u2028\u2029", "\\", '"', "\x00"])
def test_any_text_survives_in_a_script_element(text: str) -> None:
    written = script_json({"name": text})
    assert json.loads(written) == {"name": text}
    assert not set("<>&\u2028") & set(written)


def test_views_are_drawn_to_a_thousandth_of_the_picture(tmp_path: Path) -> None:
    write_run(tmp_path, 9, 0)
    data = json.loads(Elements(page_html([tmp_path])).scripts[0])
    shown = data["runs"][0]["views"]["0"]
    expected = view(0, HOSTILE)
    for name in ("points2d", "points3d"):
        points = getattr(expected, name)
        low, size = (np.array(shown[name][key]) for key in ("low", "size"))
        steps = unpacked({"u2": shown[name]["u2"]}).reshape(points.shape)
        assert np.abs(low + steps / 65535 * size - points).max() < 1e-4 * size.max()
    assert shown["estimates"]["pnp"] is None
    pose = np.array(shown["estimates"]["ransac"])
    camera = expected.points3d @ pose[:9].reshape(3, 3).T + pose[9:]
    np.testing.assert_allclose(camera[:, :2] / camera[:, 2:], expected.points2d, atol=1e-5)


def test_what_cannot_be_read_is_named_and_no_page_is_left(tmp_path: Path) -> None:
    output = tmp_path / "report.html"
    (tmp_path / "unfinished").mkdir()
    with pytest.raises(ValueError, match=r"expected a results folder with summary.json, got no .*unfinished"):
        write_page([tmp_path / "unfinished"], output)
    with pytest.raises(ValueError, match="expected at least one results folder"):
        write_page([], output)
    write_run(tmp_path / "run", 9, 0)
    (tmp_path / "run" / "test" / "views.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"expected views of a test in .*views.npz"):
        write_page([tmp_path / "run"], output)
    (tmp_path / "run" / "test" / "views.npz").unlink()
    (tmp_path / "run" / "logs" / "version_0" / "metrics.csv").write_text("step,train/loss\n1,much\n")
    with pytest.raises(ValueError, match=r"expected numbers in .*metrics.csv, line 2"):
        write_page([tmp_path / "run"], output)
    assert not output.exists()
