"""The page in headless Chromium. Skipped where selenium (the extra `browser`), Chromium or its driver is absent,
unless BPNP_REQUIRE_BROWSER is set."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from report_data import HOSTILE, drawn_problem, rows, write_run

from bpnp.report import Results, write_page, write_results
from bpnp.report.points import write_points
from bpnp.report.terminal import DARK, LIGHT

pytestmark = pytest.mark.nightly

REQUIRED = bool(os.environ.get("BPNP_REQUIRE_BROWSER"))
if not REQUIRED:
    pytest.importorskip("selenium", reason="needs selenium; try: pip install bpnp[browser]")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--window-size=1280,900",
)  # fmt: skip
COUNT = 80


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from selenium import webdriver

    paths = [shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")]
    if None in paths:
        (pytest.fail if REQUIRED else pytest.skip)(
            "needs chromium and chromedriver; on Debian: apt-get install chromium chromium-driver"
        )
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


def opened(browser: Any, address: str) -> None:
    """Opens an address afresh and waits until the page is ready."""
    from selenium.webdriver.support.wait import WebDriverWait

    browser.get("about:blank")
    browser.get(address)
    WebDriverWait(browser, 20).until(lambda b: b.execute_script("return document.documentElement.dataset.ready"))


def severe(browser: Any) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.fixture
def page(browser: Any, written: tuple[Path, dict[str, Results]]) -> Iterator[Callable[..., Any]]:
    """Run a script on the freshly opened page; afterwards no error is logged, and no network was used."""
    address = written[0].as_uri()
    browser.get("about:blank")
    browser.get_log("performance")
    opened(browser, address)
    yield browser.execute_script
    assert severe(browser) == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert {url.split("#")[0] for url in asked if not url.startswith(("data:", "blob:", "about:"))} == {address}


def texts(page: Callable[..., Any], selector: str) -> list[str]:
    # As JSON, which can hold the halves of surrogate pairs that stand for bytes of no text.
    script = "return JSON.stringify([...document.querySelectorAll(arguments[0])].map((e) => e.textContent))"
    return json.loads(page(script, selector))


def press(page: Callable[..., Any], selector: str) -> None:
    page("document.querySelector(arguments[0]).click()", selector)


def choose(page: Callable[..., Any], name: str, value: str) -> None:
    page(
        "const e = document.getElementById(arguments[0]);"
        "if (e.type === 'checkbox') e.checked = Boolean(arguments[1]); else e.value = arguments[1];"
        "e.dispatchEvent(new Event('input', {bubbles: true}))",
        name,
        value,
    )


def column(results: Results, estimate: str, key: str) -> np.ndarray:
    return np.array([getattr(row, key) for row in results.of(estimate)])


def floats(cells: list[str]) -> list[float]:
    return [float(cell) for cell in cells]


def test_runs_are_switched_off_and_on_and_the_address_keeps_it(browser: Any, page: Callable[..., Any]) -> None:
    page("document.querySelector('#recall').scrollIntoView()")
    lines = "#recall .chart:first-child .scatterlayer .trace .js-line"  # the paper's rings have none
    for _ in range(50):
        if len(texts(page, lines)) == 4:
            break
        browser.execute_async_script("setTimeout(arguments[0], 100)")
    assert len(texts(page, lines)) == 4
    press(page, "#series1")
    assert len(texts(page, lines)) == 3
    assert len(texts(page, "#quartile-table tbody tr:not(.paper):not([hidden])")) == 3
    rows = "#intervals tbody tr:not([hidden])"  # without "first: pnp"; those of the second run have a difference each
    assert len(texts(page, rows)) == 5
    assert len(texts(page, f"{rows}.minus")) == 2
    assert not page("return document.getElementById('series1').checked")
    opened(browser, page("return location.href"))
    assert not page("return document.getElementById('series1').checked")
    press(page, "#series1")
    assert len(texts(page, "#quartile-table tbody tr:not(.paper):not([hidden])")) == 4


def test_the_worst_pairs_come_first_and_filters_narrow_them(
    browser: Any, page: Callable[..., Any], written: Any
) -> None:
    results = written[1]["first"]
    rotation = column(results, "ransac", "rotation_error_deg")
    first = floats(texts(page, "#problem-table tbody td:nth-child(2)"))
    assert first == pytest.approx(np.sort(rotation)[::-1][: len(first)].tolist(), rel=0.005)
    press(page, "#problem-table [data-key='reprojection_error_deg']")
    press(page, "#problem-table [data-key='reprojection_error_deg']")
    for _ in range(3):
        press(page, "#more")
    ordered = np.sort(column(results, "ransac", "reprojection_error_deg"))
    every = floats(texts(page, "#problem-table tbody td:nth-child(5)"))
    assert every == pytest.approx(ordered.tolist(), rel=0.005, nan_ok=True)
    choose(page, "cause", "1")
    assert set(texts(page, "#problem-table tbody td.words")) == {" no pose"}
    without = sum(not row.found for row in results.of("ransac"))
    assert f"{without} of {COUNT} problems" in texts(page, "#place")[0]
    choose(page, "cause", "")
    choose(page, "least", "12.5")
    chosen = [r for r in results.of("ransac") if r.rotation_error_deg >= 12.5]
    assert f"{len(chosen)} of {COUNT} problems" in texts(page, "#place")[0]
    opened(browser, page("return location.href"))
    assert f"{len(chosen)} of {COUNT} problems" in texts(page, "#place")[0]
    assert page("return document.getElementById('least').value") == "12.5"


def test_a_pair_opens_with_its_points_and_names_stay_text(page: Callable[..., Any], written: Any) -> None:
    choose(page, "name", "SCRIPT")
    press(page, "#problem-table button.link")
    assert page("return document.getElementById('problem').open")
    assert texts(page, "#problem-title") == [HOSTILE.replace("\udcff", "?")]
    assert page("return document.title").startswith("bpnp: ")
    assert texts(page, "b") == []
    rows = [row for results in written[1].values() for row in results.rows if row.index == 0]
    cells = floats(texts(page, "#problem-numbers tbody td:nth-child(2)"))
    assert cells == pytest.approx([row.rotation_error_deg for row in rows], rel=0.005)
    # The points in space and in the image are the planted ones, and both runs' cameras are there.
    planted = drawn_problem(0, HOSTILE)
    names, image = page(
        "return [document.getElementById('scene').data.map((t) => t.name),"
        "[document.getElementById('image').data[2].x, document.getElementById('image').data[2].y]]"
    )
    assert names[2:] == ["true pose", "first: ransac", "second: ransac"]
    np.testing.assert_allclose(np.transpose(image), planted.points2d, atol=1e-5)
    # A click on a point picks it in both views.
    for view, curve in (("scene", 0), ("image", 2)):
        clicked = "{points: [{curveNumber: arguments[1], pointNumber: 7}]}"
        page(f"document.getElementById(arguments[0]).emit('plotly_click', {clicked})", view, curve)
        (text,) = texts(page, "#picked")
        assert text.startswith("3D point 7 at (")
        assert "2D point 7 at (" in text
        assert float(text.split("reprojection error ")[1].split(" deg")[0]) < 0.01
        x, *_ = page("return document.getElementById('image').data[4].x")
        assert x == pytest.approx(planted.points2d[7, 0], abs=1e-4)


def test_a_pair_opens_from_the_keyboard_and_arrows_go_through_the_list(browser: Any, page: Callable[..., Any]) -> None:
    from selenium.webdriver.common.keys import Keys

    button = browser.find_element("css selector", "#problem-table tbody tr:nth-child(3) button")
    name = button.text.removeprefix("◉ ")
    names = [text.removeprefix("◉ ") for text in texts(page, "#problem-table tbody th")]
    button.send_keys(Keys.ENTER)
    assert texts(page, "#problem-title") == [name]
    for key, place in ((Keys.ARROW_RIGHT, 3), (Keys.ARROW_LEFT, 2), (Keys.ARROW_LEFT, 1)):
        browser.switch_to.active_element.send_keys(key)
        assert texts(page, "#problem-title") == [names[place]]
    browser.switch_to.active_element.send_keys(Keys.ESCAPE)
    browser.execute_async_script("setTimeout(arguments[0], 100)")
    assert not page("return document.getElementById('problem').open || location.hash.includes('open=')")
    opened(browser, page("return location.href.split('#')[0]") + "#open=scene%2F0042")
    assert texts(page, "#problem-title") == ["scene/0042"]


OVERLAPS = """return [...document.querySelectorAll('.js-plotly-plot')].flatMap((chart) => {
    const texts = [...chart.querySelectorAll('.xtick text')];
    const places = texts.map((text) => [text.getBoundingClientRect(), text.textContent]);
    places.sort(([a], [b]) => a.left - b.left);
    return places.slice(1).filter(([own], k) => own.left < places[k][0].right).map(([, text]) => text);
})"""  # labels of a horizontal axis that begin before the one to the left ends

CUT = """return [...document.querySelectorAll('thead th')].filter((head) => head.scrollWidth > head.clientWidth + 1
    || getComputedStyle(head).overflowWrap != 'normal').map((head) => head.textContent)"""  # heads broken within a word


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of four runs with two estimates each."""
    folder = tmp_path_factory.mktemp("eight")
    names = ("a", "b", "c", "d")
    for seed, name in enumerate(names):
        write_run(folder / name, 20, seed)
    return write_page([folder / name for name in names], folder / "report.html")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_line_of_eight_has_the_colour_of_the_true_pose(browser: Any, eight: Path, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        opened(browser, eight.as_uri())
        press(browser.execute_script, "#problem-table button.link")
        true, *cameras = browser.execute_script(
            "return document.getElementById('scene').data.slice(2).map((trace) => [trace.name, trace.line.color])"
        )
        lines = browser.execute_script("return SERIES.map((own) => ink(own.colour))")
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert true[0] == "true pose"
    assert {colour for _, colour in cameras} < set(lines)
    assert len(set(lines)) == 8
    for colour in lines:  # far from it in red, green or blue
        apart = [abs(x - y) for x, y in zip(to_rgb(colour), to_rgb(true[1]), strict=True)]
        assert max(apart) > 0.2


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1280, "light")])
def test_nothing_sticks_out_sideways(browser: Any, page: Callable[..., Any], width: int, scheme: str) -> None:
    metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        opened(browser, page("return location.href.split('#')[0]"))
        page("dispatchEvent(new Event('beforeprint'))")
        press(page, "#problem-table button.link")
        browser.execute_async_script("setTimeout(arguments[0], 500)")
        assert page("return document.documentElement.scrollWidth") == width
        wide = "return [...document.querySelectorAll('.js-plotly-plot .main-svg')].map((e) => [e.clientWidth, "
        assert all(own <= room for own, room in page(wide + "e.closest('.js-plotly-plot').clientWidth])"))
        assert page(OVERLAPS) == []
        assert page(CUT) == []
        page("openProblem(0)")  # its name has a word that is wider than a phone
        assert page("const open = document.getElementById('problem'); return open.scrollWidth <= open.clientWidth")
        colours = page(
            "const curves = document.querySelector('#recall .chart').data.filter((t) => t.mode == 'lines');"
            "return [...new Set(curves.map((t) => t.line.color))]"
        )
        assert set(colours) == set((LIGHT if scheme == "light" else DARK)[:4])
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_problems_of_one_name_in_other_data_are_not_compared(browser: Any, tmp_path: Path) -> None:
    missing = (np.full((3, 3), np.nan), np.full(3, np.nan))
    for seed in (1, 2):
        data = {"class_path": "bpnp.datamodules.MeshDataModule", "init_args": {"seed": seed}}
        write_results(tmp_path / str(seed), rows(8, seed), settings={"data": data})
        without_pose = replace(drawn_problem(6, "scene/0006"), pose=None, estimates={"ransac": missing, "pnp": missing})
        write_points(tmp_path / str(seed), [without_pose])
    opened(browser, write_page([tmp_path / "1", tmp_path / "2"], tmp_path / "page.html").as_uri())
    for other, count in ((1, 8), (2, 0)):
        browser.execute_script("document.getElementById('b').value = arguments[0]; drawComparison()", other)
        assert f"of {count} common problems" in browser.execute_script(
            "return document.getElementById('versus-text').textContent"
        )
    browser.execute_script("openProblem(6)")
    assert len(texts(browser.execute_script, "#problem-numbers tbody tr")) == 2
    (caption,) = texts(browser.execute_script, "#image-text")
    assert "0 of 30 3D points reprojected by no pose. Dotted" in caption
    assert severe(browser) == []
