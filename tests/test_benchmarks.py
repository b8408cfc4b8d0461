"""Benchmarks: their baselines are correct, their problems have the planted poses, and their commands run."""

import importlib.util
import json
import runpy
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import bench_city
import bench_completeness as completeness
import bench_focal
import bench_layers
import bench_left_out
import bench_rigs
import guard
import numpy as np
import pages
import pytest
import rebuilt_maps
import record
import reliability
import results
import roma
import shapes
import symmetric
import torch
from paper_layers import PaperPnP, PaperSinkhorn
from planted_model import plant_model
from scipy import stats
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp import SceneMap
from bpnp.cameras import camera_from
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.geometry import bearings, rotation_angle
from bpnp.layers import ransac_pnp, sinkhorn, weighted_pnp
from bpnp.maps.views import View

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True, scope="module")
def _threads() -> Iterator[None]:
    """The commands set torch's."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def problem() -> SimpleNamespace:
    """40 points in float64: the plan at its optimum and the pose from which RANSAC starts the layer."""
    batch, cost = (x.to(torch.float64) for x in bench_layers.plant(2, 40, kind="independent", level=0.9, seed=3))
    plan, _ = sinkhorn(cost, tolerance=1e-13)
    rotation, translation, _ = ransac_pnp(plan, batch.points2d, batch.points3d)
    start = torch.cat([roma.rotmat_to_rotvec(rotation), translation], -1)
    return SimpleNamespace(
        batch=batch, cost=cost, plan=plan, rays=bearings(batch.points2d), pose=(rotation, translation), start=start
    )  # fmt: skip


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_paper_sinkhorn_has_the_optimum_and_its_gradient(problem: SimpleNamespace) -> None:
    cost = problem.cost.clone().requires_grad_()
    plan = PaperSinkhorn.apply(cost, 0.1, 10_000, 1e-15)
    torch.testing.assert_close(plan, problem.plan, atol=1e-13, rtol=0)
    incoming, direction, step = noise(*plan.shape), noise(*plan.shape, seed=1), 1e-6
    moved = [sinkhorn(problem.cost + sign * step * direction, tolerance=1e-13)[0] for sign in (1, -1)]
    slope = float(((moved[0] - moved[1]) * incoming).sum() / (2 * step))
    (gradient,) = torch.autograd.grad(plan, cost, incoming)
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-6)


def test_the_papers_pose_and_its_gradient_are_those_of_the_layer(problem: SimpleNamespace) -> None:
    """Both by other means: L-BFGS and Lemma 1 with the Hessian from automatic differentiation."""
    plan, incoming = problem.plan.clone().requires_grad_(), (noise(2, 3, 3), noise(2, 3, seed=1))
    rotation, translation, stats = weighted_pnp(
        plan, problem.rays, problem.batch.points3d, *problem.pose, tolerance=1e-11
    )
    assert stats.converged.all()
    pose = PaperPnP.apply(plan, problem.rays, problem.batch.points3d, problem.start)
    papers = roma.rotvec_to_rotmat(pose[:, :3]), pose[:, 3:]
    assert rotation_angle(rotation, papers[0]).max() < 1e-5
    assert (translation - papers[1]).abs().max() < 1e-5
    ours, theirs = (torch.autograd.grad(found, plan, incoming)[0] for found in ((rotation, translation), papers))
    assert float((ours - theirs).norm() / theirs.norm()) < 1e-5  # as far as L-BFGS gets


def test_layers_command_writes_what_it_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "new" / "result.json"
    monkeypatch.setattr("sys.argv", f"layers --points 16 --rounds 1 --batch 1 --output {out}".split())
    bench_layers.main()
    record = json.loads(out.read_text())
    assert record["points"] == 16
    assert record["machine"]["threads"] == 1
    what = {row["what"].split(",")[0] for row in record["rows"]}
    assert what == {"PnP forward", "PnP backward", "Sinkhorn forward", "Sinkhorn backward"}
    monkeypatch.setattr("sys.argv", [*sys.argv, "--only", "PnP backward"])
    bench_layers.main()
    assert [row["what"] for row in json.loads(out.read_text())["rows"]] == ["PnP backward"]


def test_shapes_are_seen_where_the_pose_puts_them() -> None:
    """Without outliers each image point lies within noise of a projected scene point."""
    for _, points2d, points3d, rotation, translation in shapes.shapes(0.0, 3, 9):
        camera = points3d @ rotation.T + translation
        seen = camera[:, :2] / camera[:, 2:]
        nearest = np.linalg.norm(points2d[:, None] - seen, axis=-1).min(1)
        assert nearest.max() < 6 * shapes.NOISE
    (_, points2d, points3d, *_), *_ = shapes.shapes(0.5, 1, 9)
    assert len(points2d) == len(points3d) == 600


@pytest.mark.parametrize("matches", [7, 1000])
def test_a_true_pose_is_outside_its_bound_with_the_stated_probability(matches: int) -> None:
    """Draw errors from the stated distribution, with the scale estimated from the matches.

    One in a thousand exceeds the bound of the rotation, and one in a thousand that of the pose. The covariance is
    widened so that one sigma contains 68 %. Many matches tell the scale with the freedom of the 16 blocks that the
    jackknife leaves out.
    """
    rng, root = np.random.default_rng(0), np.diag([0.01, 0.02, 0.01, 5.0, 3.0, 40.0])
    root[3:, :3] = 30 * rng.standard_normal((3, 3))
    turn, shift = Rotation.from_euler("xyz", [50, 20, -70], degrees=True), np.array([100.0, 20, 900])
    pairs, free = np.zeros((matches, 2)), min(2 * matches - 6, 15)
    found = SimpleNamespace(rotation=turn.as_matrix(), translation=shift, covariance=root @ root.T, matches=pairs)
    beyond, one_sigma = [], stats.t(free).ppf(stats.norm.cdf(1))
    scales = np.sqrt(free / rng.chisquare(free, (4000, 1))) / one_sigma
    for error in scales * rng.standard_normal((4000, 6)) @ root.T:
        true = (Rotation.from_rotvec(error[:3]) * turn).as_matrix()
        beyond.append(record.beyond_bound(found, (true, shift + error[3:])))
    assert 1 <= sum(beyond) <= 16
    found.covariance = np.full((6, 6), np.nan)  # there is no bound
    assert record.beyond_bound(found, (found.rotation, shift))
    outcomes = [record.Outcome("", 5.0, 0.0, "confident", 1.0, outside) for outside in (True, False)]
    row = record.Row("", list, 3.0)
    assert record.summary(outcomes, row)["confident_and_wrong"] == 1
    assert record.summary(outcomes, replace(row, excused=False))["confident_and_wrong"] == 2


def test_rows_are_measured_printed_and_written(tmp_path: Path, monkeypatch, capsys) -> None:
    out = tmp_path / "new" / "rows.json"
    command = f"reliability --limit 2 --seed 9 --output {out} --only labels".split()
    monkeypatch.setattr("sys.argv", [*command, "headset, 3"])
    reliability.main()
    written = json.loads(out.read_text())
    assert written["command"].startswith("reliability --limit 2 --seed 9")
    names = {f"leds, headset, 3 lights{more}" for more in ("", ", fisheye", ", 1 px")}
    assert written["rows"].keys() == names | {f"labels, {kind}" for kind in ("none", "likeliest", "probabilities")}
    assert written["rows"]["leds, headset, 3 lights"]["right"] == 1
    assert all(row["confident_and_wrong"] == 0 for row in written["rows"].values())
    assert capsys.readouterr().out.count("problems 2, rotation q deg") == 6


def test_the_time_limit_of_the_command_holds_for_every_search(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(bench_focal, "LEDS", bench_focal.LEDS[2:])  # frames with ten LEDs of a ring are slow to draw
    options = SimpleNamespace(
        limit=1, seed=3, time_limit=4.0, data=tmp_path, scenes=["none"], factors=[0.9], peers=False, what="leds"
    )
    rows = [row for each in (reliability, bench_rigs, bench_focal) for row in each.rows(options)]
    drawn = [
        row for row in rows if not row.name.startswith(("photos", "maps", "wrong focal, one", "wrong focal, whole"))
    ]
    assert len(drawn) > 90
    for row in drawn:
        for problem in row.draw():
            assert problem.solve.keywords["time_limit"] == 4.0, row.name


@pytest.mark.parametrize(
    ("main", "options", "message"),
    [
        (reliability.main, "--only nothing", "no row has 'nothing' in its name"),
        (results.main, "--check --only nothing", "no row has 'nothing' in its name"),
        (bench_layers.main, "--points 8 --batch 1 --only nothing", "no row has 'nothing' in its name"),
        (reliability.main, "--only", "expected at least one argument"),
        (reliability.main, "--limit 0", "'0' is not a positive integer"),
        (bench_layers.main, "--limit 3", "unrecognized arguments: --limit 3"),
        (bench_city.main, "castle-P30 --photos walk_4", "photos of walk_4: not a model of this city"),
    ],
)
def test_options_that_select_nothing_are_errors(main, options: str, message: str, monkeypatch, capsys) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("sys.argv", ["benchmark", *options.split()])
    with pytest.raises(SystemExit) as error:
        main()
    assert message in str(error.value) + capsys.readouterr().err


def test_a_recorded_command_has_no_folders_of_the_machine() -> None:
    words = ["python -m benchmarks guard", "--output", "/home/me/runs/a.json", "--data=/home/me/data", "--only", "leds"]
    assert record.command(words) == "python -m benchmarks guard --output a.json --data=data --only leds"


def test_items_are_evenly_spread() -> None:
    assert record.spread(range(10), 5) == [0, 2, 4, 6, 8]
    assert record.spread(range(10), 5, first=0.5) == [1, 3, 5, 7, 9]
    assert record.spread(range(3), 5) == [0, 1, 2]
    assert record.spread([], 5) == []


def test_the_first_call_of_a_network_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock goes on by 100 seconds in the first call, which loads and compiles, and by one in the others."""
    clock = SimpleNamespace(now=0.0, step=100.0)

    class Solver(torch.nn.Module):
        def forward(self, batch):
            clock.now, clock.step = clock.now + clock.step, 1.0
            return SimpleNamespace(
                poses={"it": SimpleNamespace(rotation=batch.rotation, translation=batch.translation)}
            )

    monkeypatch.setattr(results.time, "process_time", lambda: clock.now)
    found = list(results.estimates(Solver, "it", {"num_points": 8}, 2, 5, Path()))
    assert [(outcome.rotation_deg, outcome.cpu_seconds) for outcome in found] == [(pytest.approx(0, abs=1e-4), 1.0)] * 2


def test_errors_are_those_to_the_nearest_true_pose() -> None:
    """Each of the poses is correct; the centroid is twice as far away, and the camera centre is moved by as much."""
    turn, half, shift = np.eye(3), np.diag([-1.0, -1, 1]), np.array([0.0, 0, 4])
    problem = record.Problem("", Mock(), [(half, shift), (turn, shift)], np.full((5, 3), [0, 0, 1.0]), distance=2.0)
    assert record.nearest(problem, turn, shift + [0, 0, 5])[:3] == (0, 2.5, 1)
    assert record.nearest(replace(problem, poses=[]), turn, shift)[0] == record.NO_POSE_DEG


def test_the_list_has_every_benchmark_and_a_sentence_for_each(monkeypatch, capsys) -> None:
    start = runpy.run_path(str(ROOT / "benchmarks" / "__main__.py"))["main"]
    monkeypatch.setattr("sys.argv", ["benchmarks"])
    start()
    lines = dict(line.strip().split(maxsplit=1) for line in capsys.readouterr().out.splitlines()[2:])
    programs = [file.stem for file in (ROOT / "benchmarks").glob("*.py") if "\ndef main(" in file.read_text("utf-8")]
    assert set(lines) == {name.removeprefix("bench_") for name in programs} - {"__main__"}
    assert {"results", "table1", "rigs"} <= set(lines)
    assert all(sentence.endswith((".", ":")) or "`" in sentence for sentence in lines.values())
    for name, code in (("serch", "'serch' is not in this list"), ("rigs", 0)):
        monkeypatch.setattr("sys.argv", ["benchmarks", name, "--help"])
        with pytest.raises(SystemExit, match=str(code)):
            start()
    assert "usage: python -m benchmarks rigs" in capsys.readouterr().out


def test_tables_are_filled_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, here, guide, file = SimpleNamespace(seeds=[]), results, tmp_path / "guide.md", tmp_path / "results.json"

    def measure(limit: int, seed: int, _: Path) -> list[record.Outcome]:
        made.seeds.append(seed)
        return [made.outcome] * limit

    rows = [here.Row("rigs", "two rings", measure, (2, 1), 3.0, seed=506)]
    made.outcome = record.Outcome("", 0.25, 0.0, "confident", 0.5)
    monkeypatch.setattr(here, "ROWS", rows)
    monkeypatch.setattr(pages, "PAGES", (guide,))
    monkeypatch.setattr(here, "FILE", file)
    monkeypatch.setattr(record, "warm_up", lambda: None)

    def run(*arguments: str) -> None:
        monkeypatch.setattr("sys.argv", ["results", *arguments])
        here.main()

    guide.write_text("before\n<!-- results: rigs -->\nold\n<!-- end of results -->\nafter\n")
    run()
    text = guide.read_text()
    assert "| two rings | 2 | 0.25 / 0.25 / 0.25 | 100.0% (3 deg) | 100.0% | 0 | 0.5 |" in text
    assert "`python -m benchmarks results --only rigs:`, seed 506.\n<!-- end" in text
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    written = json.loads(file.read_text())
    assert written["full"]["rigs: two rings"]["seed"] == 506
    assert written["full"]["rigs: two rings"]["commit"] == written["commit"]
    assert {"cpu", "date"} <= written["full"]["rigs: two rings"].keys()
    assert written["commit"]
    run("--check")
    run("--seed", "7")
    run("--check")
    assert made.seeds == [506, 506, 7, 7], "a check draws the problems of the file"
    assert "seed 7." in guide.read_text()
    text = guide.read_text()
    made.outcome = record.Outcome("", 8.0, 0.0, "confident", 0.5)
    with pytest.raises(SystemExit, match="rigs: two rings: 2 confident and wrong, not 0"):
        run("--check")
    with pytest.raises(SystemExit, match="rigs: two rings: never measured"):
        run("--quick", "--check")
    assert made.seeds[-1] == 9
    rows[0] = replace(rows[0], problems=(2, 0))
    run("--quick", "--check")  # a row without quick problems is not measured
    other = tmp_path / "other.json"
    run("--file", str(other))
    assert json.loads(other.read_text())["full"]["rigs: two rings"]["confident_and_wrong"] == 2
    assert guide.read_text() == text, "a record of its own fills no page"
    with pytest.raises(SystemExit, match="2"):
        run("--limit", "2")  # an option of the other benchmarks


def test_lines_of_reliability_and_deviations_sum_up_their_rows() -> None:
    """Numbers are sums, fractions are means over problems; standard deviations over correct poses."""
    one = {"problems": 3, "right": 1.0, "confident": 0.3333, "confident_and_wrong": 0, "sigmas": [0.6, 0.9, 1.0]}
    found = {results.key(row): one | {"seed": 5} for row in results.ROWS}
    found["reliability: devices, with normals"] |= {"problems": 1200, "right": 0.5, "confident_and_wrong": 2}
    (line,) = (line for line in results.reliability_table(found) if line[0].endswith("with normals"))
    assert line[1:] == ("1,200", "50.0%", "400", "2")
    (line,) = (line for line in results.reliability_table(found) if line[0].startswith("LEDs of rings"))
    assert line[1:] == ("54", "100.0%", "18", "0")
    (line,) = (line for line in results.reliability_table(found) if line[0].startswith("exactly symmetric"))
    assert line[1:] == ("39", "", "13", "0")
    found["search: shapes, any rotation, 0.5 outliers a match"] |= {
        "problems": 18,
        "right": 0.5,
        "sigmas": [0.2, 0.5, 0.6],
    }
    (line,) = (line for line in results.sigmas_table(found) if "shapes" in line[0])
    assert line == ("12 of shapes among outliers", "30.0%", "60.0%", "70.0%")
    assert "`python -m benchmarks results --only search: maps: leds:`, seed 5." in (
        results.table("sigmas", found) or ""
    )


@pytest.mark.parametrize("part", ["quick", "full"])
def test_the_record_has_every_row_and_no_other(part: str) -> None:
    """`results --check` would report the others as never measured."""
    recorded = json.loads(results.FILE.read_text())[part]
    rows = {results.key(row): row for row in results.ROWS if row.problems[part == "quick"]}
    assert set(recorded) == set(rows)
    seeds = {key: results.QUICK_SEED if part == "quick" else row.seed for key, row in rows.items()}
    assert {key: result["seed"] for key, result in recorded.items()} == seeds, "the default seed is that of the record"
    assert all(result["problems"] and result["commit"] for result in recorded.values())


def test_basin_counts_and_trials_of_motions_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted outcomes: poses with one hypothesis are wrong for objects of three parts, and lead back elsewhere."""
    kinds = [kind for kind in symmetric.KINDS if kind.unique >= 8]
    searched = [kind for kind in kinds if kind.name != "few"]
    monkeypatch.setattr(completeness, "reached", lambda problem: {1: ", 3 parts" not in problem.name, 2: True})
    monkeypatch.setattr(completeness, "leads_back", lambda kind, problem: kind.fold != 3)
    found = completeness.measure(seed=5, limit=2, trials=3)
    assert found["settings"] == {"seed": 5, "limit": 2, "trials": 3}
    assert found["searched"] == 2 * len(searched)
    wrong = 2 * sum(kind.fold == 3 for kind in searched)
    assert found["basin_counts"]["1"] == {"poses": 2 * len(searched), "wrong": wrong}
    assert found["basin_counts"]["2"] == {"poses": 2 * len(searched), "wrong": 0}
    assert found["basin_counts"]["3"] == {"poses": 0, "wrong": 0}
    assert found["motions"] == {"trials": 3 * len(kinds), "led_back": 3 * sum(kind.fold != 3 for kind in kinds)}
    text = completeness.tables(found)["data"]
    assert f"\n| 1 | {2 * len(searched)} | {wrong} | {wrong / 2 / len(searched):.3f} | 0.500 |\n" in text
    assert text.endswith("`python -m benchmarks completeness --seed 5 --limit 2 --trials 3`.\n")


def test_models_of_the_same_views_are_aligned() -> None:
    """Another frame and unit, and views that only one of the models has."""
    rng, lens, seen = np.random.default_rng(0), camera_from(np.eye(3)), np.arange(4, dtype=np.int32)
    turn = Rotation.random(random_state=9).as_matrix()
    views = [
        View(str(k), lens, Rotation.random(random_state=k).as_matrix(), rng.normal(size=3), seen) for k in range(6)
    ]
    moved = [
        replace(v, rotation=v.rotation @ turn.T, translation=-v.rotation @ turn.T @ (0.3 * turn @ v.centre + [1, 2, 3]))
        for v in views
    ]
    here, there = (SceneMap(np.zeros((4, 3)), np.arange(4), seen, tuple(v)) for v in (views[:5], moved[1:]))
    rotation, translation = rebuilt_maps.align(here, there).pose(views[0].rotation, views[0].translation)
    np.testing.assert_allclose(rotation, moved[0].rotation, atol=1e-12)
    np.testing.assert_allclose(translation, moved[0].translation, atol=1e-12)


def test_descriptors_are_matched_to_points_seen_from_several_views() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 64))
    seen = np.concatenate([points + 0.1 * rng.normal(size=points.shape) for _ in range(3)])
    photo = np.concatenate([points[:100] + 0.1 * rng.normal(size=(100, 64)), rng.normal(size=(500, 64))])
    theirs, own = ((rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32) for rows in (seen, photo))
    ids = np.tile(np.arange(300) + 7, 3)
    keypoints, matched = bench_left_out.descriptor_matches(own, theirs, ids)
    true = keypoints < 100
    assert true.sum() == 100
    np.testing.assert_array_equal(matched[true], keypoints[true] + 7)
    assert (~true).sum() < 25


def test_a_photo_is_localised_by_descriptors_in_the_views_that_its_words_retrieve(monkeypatch) -> None:
    """Twelve views of 100 points each; the photo sees those of the first one."""
    rng, turn = np.random.default_rng(0), Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    points, rows = rng.uniform(-1, 1, (1200, 3)), rng.normal(size=(1200, 64)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    camera, pose = points[:100] @ turn.T + [0, 0, 5], (turn, np.array([0.0, 0, 5]))
    pixels, ids = 1000 * camera[:, :2] / camera[:, 2:] + 500, np.arange(1200)
    views = {f"view {k}": (pixels, rows[100 * k : 100 * k + 100]) for k in range(12)}
    images = [SimpleNamespace(name=f"view {k}", point_ids=ids[100 * k : 100 * k + 100]) for k in range(12)]
    model = SimpleNamespace(images=images, point_ids=ids, points3d=points)
    monkeypatch.setattr(bench_left_out, "read_records", lambda _: model)
    monkeypatch.setattr(bench_left_out, "features_of", lambda _: views | {"photo": views["view 0"]})
    monkeypatch.setattr(bench_left_out, "WORDS", 100)
    place = bench_left_out.DescribedMap(Path(), Path())
    assert place.retrieve("photo")[0] == "view 0"
    assert len(place.retrieve("photo")) == 10
    for named in (None, place.retrieve("photo")):
        search = partial(place.localize, "photo", (1000.0, 1000.0, 500.0, 500.0), named)
        outcome = record.solve_problem(record.Problem("", search, [pose], points))
        assert outcome.rotation_deg < 0.01
        assert outcome.verdict == "confident"


def test_photos_of_a_city_are_seen_where_their_poses_put_them(tmp_path: Path) -> None:
    """A planted model without noise: also in its repeated place; changed copies keep what their views see in view."""
    plant_model(tmp_path / "planted", camera=("PINHOLE", [520.0, 500.0, 400.0, 300.0]), images=8, points=200, seen=150)
    model = read_reconstruction(tmp_path / "planted", name="planted")
    scene, photos = bench_city.city([model], {"planted": 2}, 0, 5, twice=0.2)
    assert len(photos) == 2
    assert len(scene.views) == 12
    for photo in photos:
        for rotation, translation in photo.poses:
            seen = scene.points3d @ rotation.T + translation
            seen = seen[np.linalg.norm(seen, axis=1) < 3 * photo.distance * np.cbrt(np.linalg.det(rotation))]
            off = np.linalg.norm(photo.points2d[:, None] - seen[:, :2] / seen[:, 2:], axis=-1).min(1)
            assert (off < 1e-6).mean() > 0.6
        first, second = (-rotation.T @ translation for rotation, translation in photo.poses)
        assert np.linalg.norm(first - second) > photo.distance
    (tmp_path / "written").mkdir()
    bench_city.write_map(scene, tmp_path / "written")
    again = SceneMap.from_colmap(tmp_path / "written")
    np.testing.assert_array_equal(again.points3d, scene.points3d)
    for one, other in zip(again.views, scene.views, strict=True):
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_array_equal(one.translation, other.translation)
        np.testing.assert_array_equal(one.points, other.points)
    larger, _ = bench_city.city([model], {"planted": 2}, 40, 5)
    assert len(larger.views) == 40
    assert len({view.name for view in larger.views}) == 40
    for view in larger.views:
        camera = larger.points3d[view.points] @ view.rotation.T + view.translation
        np.testing.assert_allclose(np.linalg.det(view.rotation), 1)
        assert (np.abs(camera[:, :2] / camera[:, 2:]) < 1).all()


def test_the_guard_notices_a_lost_pose_a_wrong_one_and_slower_code() -> None:
    row, turn = record.Row("kind", list, 3.0, right_moved=0.1), np.eye(3).tolist()
    one = record.Outcome("a", 1.0, 0.0, "confident", 1.0, outside=False, rotation=turn, translation=[0.0, 0, 4])
    assert guard.compare(row, [one], [one])[1]
    for change in ({"cpu_seconds": 1.2}, {"rotation_deg": 4.0}, {"rotation_deg": 4.0, "outside": True}):
        assert not guard.compare(row, [replace(one, **change)], [one])[1]
    assert "wrong +1" in guard.compare(row, [replace(one, moved=0.2, outside=True)], [one])[0]
    assert "confident +0 -1" in guard.compare(row, [replace(one, verdict="ambiguous")], [one])[0]
    assert "1 other poses" in guard.compare(row, [replace(one, translation=[0.0, 0, 5])], [one])[0]
    failed = replace(one, rotation=np.full((3, 3), np.nan).tolist(), translation=[np.nan] * 3)
    assert "0 other poses" in guard.compare(row, [failed], [failed])[0], "neither found a pose"
    assert "1 other poses" in guard.compare(row, [failed], [one])[0]
    assert guard.compare(row, [one], []) == ("no problem in common", False)


def test_the_guard_notices_any_changed_answer_if_code_only_moves() -> None:
    row, turn = record.Row("kind", list, 3.0, right_moved=0.1), Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    one = record.Outcome("a", 1.0, 0.0, "confident", 1.0, rotation=turn.tolist(), translation=[0.0, 3, -400])
    failed = replace(one, problem="b", rotation=np.full((3, 3), np.nan).tolist(), translation=[np.nan] * 3)
    nearer = replace(one, translation=[1e-7, 3, -400])
    assert guard.compare(row, [one, failed], [nearer, failed], exact=True)[1]
    turned = Rotation.from_rotvec([0, 0, 1e-8]).as_matrix() @ turn
    changes = ({"translation": [0.0, 3, -400.001]}, {"rotation": turned.tolist()}, {"reason": "x"})
    for other in (
        replace(failed, problem="a"),
        replace(one, verdict="ambiguous"),
        *(replace(one, **change) for change in changes),
    ):
        text, held = guard.compare(row, [other], [one], exact=True)
        assert not held
        assert "1 of 1 answers changed: a" in text
        assert guard.compare(row, [replace(one, **changes[0])], [one])[1]


def test_the_guard_compares_a_file_that_it_wrote(tmp_path: Path, monkeypatch, capsys) -> None:
    """Problems of a kind have different names, as they are paired by name, and the time limit of the command."""
    options = SimpleNamespace(limit=20, seed=3, time_limit=4.0, data=tmp_path)
    kinds = [kind for kind in guard.KINDS if kind.startswith(("symmetric", "leds", "devices"))]
    for kind in [*kinds, "noise", "shapes"]:
        drawn = list(guard.KINDS[kind](options))
        assert len({problem.name for problem in drawn}) == len(drawn) == 20, kind
        assert {problem.solve.keywords["time_limit"] for problem in drawn} == {4.0}, kind
    file, again = tmp_path / "new" / "before.json", tmp_path / "after.json"
    command = f"guard --limit 2 --seed 3 --only headset --output {file}".split()
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit, match="False"):
        guard.main()
    before = guard.read_outcomes(file)
    assert [outcome.verdict for outcome in before["leds, headset"]] == ["confident"] * 2
    slower = json.loads(file.read_text())
    for outcome in slower["rows"]["leds, headset"]["outcomes"]:
        outcome["cpu_seconds"] *= 1e6
    again.write_text(json.dumps(slower))
    monkeypatch.setattr("sys.argv", [*command, "--against", str(again)])
    with pytest.raises(SystemExit, match="False"):
        guard.main()
    assert "leds, headset: CPU 0.00, right +0, wrong +0, confident +0 -0, 0 other poses" in capsys.readouterr().out
    file.write_text('{"kinds": {}}')
    for wrong in (tmp_path / "none.json", file):
        monkeypatch.setattr("sys.argv", ["guard", "--against", str(wrong)])
        with pytest.raises(SystemExit, match="2"):
            guard.main()
        assert f"{wrong.name} is no file that `guard --output` of this version wrote" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [symmetric.KINDS[1], symmetric.KINDS[20], symmetric.KINDS[-1]])
def test_symmetric_objects_have_equal_parts(kind: symmetric.Kind) -> None:
    """A turn by one part maps each part onto the next one, about the object's axis."""
    points = symmetric.points_of(kind, np.random.default_rng(0))
    assert len(points) == kind.fold * kind.each + kind.unique
    angle = 2 * np.pi / kind.fold
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(points[: kind.each] @ turn.T, points[kind.each : 2 * kind.each], atol=1e-12)


@pytest.mark.parametrize("name", ["rigs: LEDs, 2 cameras"])
def test_a_row_of_another_benchmark_has_its_problems(name: str, tmp_path: Path) -> None:
    """The number is as requested, another seed gives other problems, and the planted pose is found."""
    row = next(row for row in results.ROWS if results.key(row) == name)
    one, other = (list(row.measure(2, seed, tmp_path)) for seed in (1, 2))
    assert len(one) == len(other) == 2
    assert not np.array_equal(one[0].poses[0][0], other[0].poses[0][0])
    assert record.solve_problem(one[0]).rotation_deg < row.right_deg
