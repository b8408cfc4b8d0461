"""The page in headless Chromium. Skipped where selenium (the extra `browser`), chromium or its driver is absent."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_data import HOSTILE, rows, view, write_run

from bpnp.report import Results, write_page, write_results
from bpnp.report.sketches import sketches_of, write_sketches
from bpnp.report.tables import number
from bpnp.report.views import write_views

pytest.importorskip("selenium", reason="needs selenium; try: pip install bpnp[browser]")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--window-size=1280,900",
)  # fmt: skip
COUNT = 80


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from selenium import webdriver

    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in paths:
        pytest.skip("needs chromium and chromedriver; on Debian: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(paths[1]))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Results]]:
    folder = tmp_path_factory.mktemp("runs")
    results = {name: write_run(folder / name, COUNT, seed) for seed, name in enumerate(("first", "second"))}
    return write_page([folder / name for name in results], folder / "report.html", paper="modelnet40"), results


@pytest.fixture
def page(browser: Any, written: tuple[Path, dict[str, Results]]) -> Iterator[Callable[..., Any]]:
    """Runs a script on the freshly opened page. Afterwards nothing may have been logged or asked of a network."""
    address = written[0].as_uri()
    browser.get("about:blank")
    browser.get_log("performance")
    browser.get(address)
    yield browser.execute_script
    assert browser.get_log("browser") == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert {url.split("#")[0] for url in asked if not url.startswith("data:")} == {address}


def texts(page: Callable[..., Any], selector: str) -> list[str]:
    # As JSON, which can hold the halves of surrogate pairs that stand for bytes of no text.
    script = "return JSON.stringify([...document.querySelectorAll(arguments[0])].map((e) => e.textContent))"
    return json.loads(page(script, selector))


def press(page: Callable[..., Any], selector: str) -> None:
    page("document.querySelector(arguments[0]).click()", selector)


def column(results: Results, estimate: str, key: str) -> np.ndarray:
    return np.array([getattr(row, key) for row in results.rows if row.estimate == estimate])


def test_the_quartiles_are_those_of_the_files(page: Callable[..., Any], written: Any) -> None:
    shown = page(
        "return [...document.querySelectorAll('#quartile-table tbody tr')].map((row) =>"
        "[...row.children].map((cell) => [cell.textContent, cell.title]))"
    )
    estimates = {f"{name}: {key}": v for name, r in written[1].items() for key, v in r.estimates.items()}
    assert [row[0][0] for row in shown[:4]] == list(estimates)
    for row in shown[:4]:
        values = estimates[row[0][0]]
        for (text, exact), key in zip(row[1:4], ("rotation_q1_deg", "rotation_q2_deg", "rotation_q3_deg"), strict=True):
            assert text == number(values[key])
            assert float(exact) == values[key]
    assert [cell[0] for cell in shown[4][:3]] == ["paper, ModelNet40: Lc Lp R", "3.33", "8.09"]


def test_tables_sort_and_the_best_is_bold(page: Callable[..., Any], written: Any) -> None:
    medians = [v["rotation_q2_deg"] for r in written[1].values() for v in r.estimates.values()]
    press(page, "#quartile-table [data-key='1']")
    assert texts(page, "#quartile-table tbody tr:not(.paper) td:nth-child(3)") == [number(v) for v in sorted(medians)]
    assert page("return document.activeElement.dataset.key") == "1"
    press(page, "#quartile-table [data-key='1']")
    assert texts(page, "#quartile-table tbody tr:not(.paper) td:nth-child(3)") == [
        number(value) for value in sorted(medians, reverse=True)
    ]
    assert texts(page, "#quartile-table td.best:nth-child(3)") == [number(min(medians))]


def test_recall_curves_end_at_the_share_of_pairs_within(page: Callable[..., Any], written: Any) -> None:
    press(page, "#log-thresholds")
    labels = page(
        "return [...document.querySelectorAll('#recall-charts svg')].map((e) => e.getAttribute('aria-label'))"
    )
    for name, results in written[1].items():
        for estimate in ("ransac", "pnp"):
            rotation, translation, reprojection = (
                column(results, estimate, key)
                for key in ("rotation_error_deg", "translation_error", "reprojection_error_deg")
            )
            known = reprojection[~np.isnan(reprojection)]
            expected = (rotation <= 20, translation <= 1, (rotation <= 20) & (translation <= 0.5), known <= 2)
            for label, right in zip(labels, expected, strict=True):
                (share,) = re.findall(re.escape(f"{name}: {estimate} ends at ") + r"([\d.]+)%", label)
                assert float(share) == pytest.approx(100 * right.mean(), abs=0.051)


def test_runs_are_switched_off_and_on(page: Callable[..., Any]) -> None:
    lines = "#recall-charts figure:first-child path.series"
    assert len(texts(page, lines)) == 4
    press(page, "#series button:nth-child(2)")
    assert len(texts(page, lines)) == 3
    assert len(texts(page, "#quartile-table tbody tr:not(.paper)")) == 3
    assert page("return document.querySelector('#series button:nth-child(2)').getAttribute('aria-pressed')") == "false"
    for i in (1, 3, 4):
        press(page, f"#series button:nth-child({i})")
    assert texts(page, lines) == []
    press(page, "#series button:nth-child(1)")
    assert len(texts(page, lines)) == 1


def test_the_worst_pairs_come_first_and_filters_narrow_them(page: Callable[..., Any], written: Any) -> None:
    rotation = column(written[1]["first"], "ransac", "rotation_error_deg")
    shown = texts(page, "#pair-table tbody td:nth-child(2)")
    assert shown == [number(value) for value in np.sort(rotation)[::-1][: len(shown)]]
    press(page, "#pair-table [data-key='reprojection_error_deg']")
    press(page, "#pair-table [data-key='reprojection_error_deg']")
    reprojection = column(written[1]["first"], "ransac", "reprojection_error_deg")
    for _ in range(3):
        press(page, "#page-on")
    ordered = np.sort(reprojection)
    assert texts(page, "#pair-table tbody td:nth-child(5)") == [number(value) for value in ordered[75:].tolist()]
    page("const e = document.getElementById('pair-cause'); e.value = 2; e.dispatchEvent(new Event('input'))")
    assert set(texts(page, "#pair-table td.words")) == {"no pose"}
    without = sum(not row.found for row in written[1]["first"].rows) // 2
    assert f"{without} pairs" in texts(page, "#pager")[0]


def test_shares_of_causes_are_those_of_the_rows(page: Callable[..., Any], written: Any) -> None:
    row = texts(page, "#cause-table tbody tr:nth-child(2) td")[1:]
    results = written[1]["first"]
    found, converged = (column(results, "pnp", key).astype(bool) for key in ("found", "converged"))
    good = column(results, "pnp", "rotation_error_deg") <= 5
    fits = column(results, "pnp", "inliers") >= 0.5 * column(results, "pnp", "m")
    wrong = found & ~good & converged
    cases = (found & good & converged, found & good & ~converged, ~found, found & ~good & ~converged, wrong & fits)
    assert row == [f"{100 * case.mean():.1f}%" for case in (*cases, wrong & ~fits)]


def test_a_pair_opens_with_its_points_and_names_stay_text(page: Callable[..., Any], written: Any) -> None:
    page(
        "const e = document.getElementById('pair-filter'); e.value = 'SCRIPT'; e.dispatchEvent(new Event('input'));"
        "document.querySelector('#pair-table button.link').click()"
    )
    assert page("return document.getElementById('pair').open")
    assert texts(page, "#pair-title") == [HOSTILE]
    assert page("return document.title").startswith("bpnp: ")
    assert texts(page, "b") == []
    rows = [row for results in written[1].values() for row in results.rows if row.index == 0]
    assert texts(page, "#pair-numbers td:nth-child(2)") == [number(row.rotation_error_deg) for row in rows]
    assert "ransac" in texts(page, "#image-text")[0]
    assert "outside" not in texts(page, "#image-text")[0]
    drawn = "const c = document.getElementById(arguments[0]); return c.getContext('2d')"
    count = drawn + ".getImageData(0, 0, c.width, c.height).data.filter((v, i) => i % 4 === 3 && v > 0).length"
    assert page(count, "scene") > 100
    assert page(count, "image") > 100
    before = page("return document.getElementById('scene').toDataURL()")
    page("document.getElementById('scene').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))")
    assert page("return document.getElementById('scene').toDataURL()") != before
    press(page, "#pair-close")
    assert not page("return document.getElementById('pair').open")


def test_other_pairs_open_as_sketches_and_photos_lie_under_the_points(browser: Any, tmp_path: Path) -> None:
    """Of a page with three estimates; pixels of the photo's red shine through the canvas."""
    planted = rows(30, 0, ("ransac", "pnp", "refined"))
    write_results(tmp_path / "test", planted)
    names = {row.index: row.id for row in planted}
    views = [
        replace(view(i, names[i]), estimates=dict.fromkeys(("ransac", "pnp", "refined"), view(i, "").pose))
        for i in range(30)
    ]
    write_views(tmp_path / "test", [views[3]])
    write_sketches(tmp_path / "test", sketches_of(views))
    red = np.broadcast_to(np.array([255, 0, 0], np.uint8), (30, 40, 3))
    page = write_page([tmp_path], tmp_path / "r.html", photo=lambda id, box: red if id == names[3] else None)
    browser.get("about:blank")
    for index, points, lines in ((3, "30 of the image", False), (11, "24 of the image", True)):
        browser.get(f"{page.as_uri()}#pair={names[index].replace('/', '%2F')}")
        browser.refresh()
        assert points in browser.find_element("id", "image-text").text
        assert browser.find_element("css selector", "#pair-lines [value=assigned3d]").get_property("disabled") == lines
        assert len(browser.find_elements("css selector", "#pair-numbers tbody tr")) == 3
        options = [option.text for option in browser.find_elements("css selector", "#pair-estimate option")]
        assert options == ["true pose", "ransac", "pnp", "refined"]
        assert "outside" not in browser.find_element("id", "image-text").text
        reds = (
            "const c = document.getElementById('image');"
            "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;"
            "for (let i = 0; i < d.length; i += 4) n += d[i] > 200 && d[i + 1] < 60; return n"
        )
        assert (browser.execute_script(reds) > 1000) == (index == 3)
        assert browser.find_element("id", "pair-photo").is_displayed() == (index == 3)
    assert "all of the 30 pairs" in browser.execute_script("return document.getElementById('pair-kept').textContent")
    shown = browser.execute_script(
        "return [...document.querySelectorAll('#quartile-table tbody th')].map((e) => e.textContent)"
    )
    assert shown == ["ransac", "pnp", "refined"]
    assert browser.get_log("browser") == []


def test_a_pair_opens_from_the_keyboard_and_from_its_address(browser: Any, page: Callable[..., Any]) -> None:
    from selenium.webdriver.common.keys import Keys

    button = browser.find_element("css selector", "#pair-table tbody tr:nth-child(3) button")
    name = button.text.removeprefix("◉ ")
    button.send_keys(Keys.ENTER)
    assert texts(page, "#pair-title") == [name]
    browser.switch_to.active_element.send_keys(Keys.ESCAPE)
    assert not page("return document.getElementById('pair').open || location.hash !== ''")
    assert page("return document.activeElement === arguments[0]", button)
    page("location.hash = 'pair=scene%2F0042'; location.reload()")
    assert texts(page, "#pair-title") == ["scene/0042"]


def test_the_pose_loss_is_marked_where_it_joins(page: Callable[..., Any]) -> None:
    assert texts(page, "#training-charts figure:first-child .mark-text") == [
        "first: pose loss",
        "second: pose loss",
    ]
    frame, mark = page(
        "const f = document.querySelector('#training-charts figure');"
        "return [f.querySelector('.frame').getBBox(), f.querySelector('line.mark').x1.baseVal.value]"
    )
    # Step 50 of an axis from 0 to 90.
    assert (mark - frame["x"]) / frame["width"] == pytest.approx(50 / 90, abs=0.01)


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_sticks_out_sideways(browser: Any, page: Callable[..., Any], width: int) -> None:
    metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        browser.refresh()
        assert page("return document.documentElement.scrollWidth") == width
        widths = page("return [...document.querySelectorAll('.chart')].map((e) => [e.clientWidth, e.getBBox().width])")
        assert all(drawn <= room for room, drawn in widths)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
