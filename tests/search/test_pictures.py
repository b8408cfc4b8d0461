"""A solution drawn, in a notebook, as a file that is drawn, and as a COLMAP model that pycolmap reads again."""

import base64
import io
import json
import pickle
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from planted import plant

import bpnp
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.examples import load
from bpnp.report.figure_files import save_figure
from bpnp.search.inputs import problem_from
from bpnp.search.solvers import without_pose

EXAMPLE = load("mesh")
PLANTED = plant(1, 40, seed=2)
LENS = ("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05))
MATRIX = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])
OPENCV = ("OPENCV", (800.0, 810.0, 640.0, 480.0, -0.1, 0.02, 0.001, -0.001))


@pytest.fixture(scope="module")
def solved() -> bpnp.Solution:
    return bpnp.solve(EXAMPLE.points2d, EXAMPLE.points3d, EXAMPLE.camera)


@pytest.mark.parametrize("camera", [EXAMPLE.camera, OPENCV, None])
def test_pycolmap_reads_a_complete_model(camera: Any, solved: bpnp.Solution, tmp_path: Path) -> None:
    points2d = EXAMPLE.points2d
    if camera is OPENCV:
        lens = pycolmap.Camera(model="OPENCV", params=list(OPENCV[1]))
        rays = np.c_[points2d, np.ones(len(points2d))] @ np.linalg.inv(EXAMPLE.camera).T
        points2d = np.asarray(lens.img_from_cam(rays))
    solution = bpnp.solve(points2d, EXAMPLE.points3d, camera) if camera is OPENCV else solved
    folder = solution.to_colmap(tmp_path / "model", camera=camera, name="photo.jpg", size=(1280, 960))
    model = pycolmap.Reconstruction(str(folder))
    (image,) = model.images.values()
    np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], solution.rotation, atol=1e-12)
    np.testing.assert_allclose(image.cam_from_world().translation, solution.translation, atol=1e-12)
    assert (image.name, image.num_points3D, model.num_points3D()) == ("photo.jpg", solution.inlier_count, 200)
    matched = {(i, image.points2D[i].point3D_id - 1) for i in range(200) if image.points2D[i].has_point3D()}
    assert matched == set(map(tuple, solution.matches.tolist()))
    if camera is not None:
        np.testing.assert_allclose([p.xy for p in image.points2D], points2d, atol=1e-3)
    for i, j in solution.matches.tolist():
        seen = model.cameras[1].img_from_cam(image.cam_from_world() * model.points3D[j + 1].xyz)
        error = np.linalg.norm(seen - image.points2D[i].xy)
        assert model.points3D[j + 1].error == pytest.approx(error, abs=1e-6)
        assert [(e.image_id, e.point2D_idx) for e in model.points3D[j + 1].track.elements] == [(1, i)]
    again = tmp_path / "binary"
    again.mkdir()
    model.write_binary(str(again))
    assert pycolmap.Reconstruction(str(again)).num_points3D() == 200


def test_a_solution_without_a_pose_cannot_be_exported(tmp_path: Path) -> None:
    problem = problem_from(np.random.default_rng(0).normal(size=(8, 2)), EXAMPLE.points3d, None)
    with pytest.raises(ValueError, match="a solution without a pose cannot be exported: a reason"):
        without_pose(problem, "a reason", None).solution.to_colmap(tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_the_file_of_a_solution_is_drawn_and_broken_ones_are_named(
    solved: bpnp.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "castle.json"
    path.write_text(solved.to_json())
    main(["view", str(path)])
    assert (tmp_path / "views" / "castle.png").stat().st_size > 5000
    (tmp_path / "pictures").mkdir()
    content = json.loads(path.read_text())
    for text, message in (
        ("", "castle.json: this is not the JSON of a solution:"),
        ('{"images": []}', "the pictures of `bpnp localize` are in"),
        (json.dumps(content | {"points2d": [[1, 2, 3]]}), "castle.json: this is not the JSON of a solution:"),
        (
            json.dumps(content | {"matches": [[0, 999]]}),
            "`matches` has indices up to [0, 999], but there are [200, 200] 2D and 3D points",
        ),
    ):
        path.write_text(text)
        with pytest.raises(SystemExit):
            main(["view", str(path)])
        shown = " ".join(capsys.readouterr().err.split())
        assert message in shown
        assert "castle.json" in shown


class Page(HTMLParser):
    """The text of a page, and the attributes of its images."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text, self.images = "", list[dict[str, str | None]]()
        self.feed(page)

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += [dict(attrs)] if tag == "img" else []


def test_a_notebook_shows_the_text_and_the_picture_of_a_solution() -> None:
    solution = bpnp.solve(PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy())
    page = Page(solution._repr_html_())
    assert page.text == repr(solution)
    (image,) = page.images
    kind, content = str(image["src"]).split(",")
    assert kind == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(content))) as picture:
        assert min(picture.size) > 300
        assert len(picture.convert("RGB").getcolors(10**6)) > 100
    unsafe = replace(solution, reason="<b>1 < 2</b>", points2d=np.full((3, 2), np.nan))
    assert Page(unsafe._repr_html_()).text == repr(unsafe)
    assert Page(unsafe._repr_html_()).images == []


@pytest.mark.parametrize("camera", [LENS, MATRIX], ids=["lens", "matrix"])
def test_a_solution_of_pixels_is_drawn_in_pixels_also_from_its_file(camera: Any) -> None:
    pixels = camera_from(camera).project(np.c_[PLANTED.points2d[0].numpy(), np.ones(40)])
    solution = bpnp.solve(pixels, PLANTED.points3d[0].numpy(), camera)
    for own in (solution, bpnp.Solution.from_json(solution.to_json()), pickle.loads(pickle.dumps(solution))):
        image, close_up = own.plot().axes
        drawn = {line.get_label(): np.asarray(line.get_xydata()) for line in image.get_lines()}
        assert np.abs(drawn["image points"] - pixels).max() < 1e-2
        assert image.get_xlabel() == image.get_ylabel() == "pixels"
        assert close_up.get_title() == "residuals, pixels"
        assert np.linalg.norm(np.asarray(close_up.get_lines()[0].get_xydata()), axis=-1).mean() == pytest.approx(
            own.reprojection_error, abs=1e-3
        )


def test_a_photo_as_it_was_taken_fills_the_picture_and_is_not_faded() -> None:
    pixels = camera_from(MATRIX).project(np.c_[PLANTED.points2d[0].numpy(), np.ones(40)])
    solution = bpnp.solve(pixels, PLANTED.points3d[0].numpy(), MATRIX)
    axes = solution.plot(photo=np.zeros((480, 640, 3), np.uint8)).axes[0]
    (photo,) = axes.get_images()
    assert tuple(photo.get_extent()) == (0, 640, 480, 0)
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 640), (480, 0))
    assert photo.get_alpha() is None


LEDS = load("leds")


def drawn_lines(axes: Any) -> dict[str, np.ndarray]:
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def test_leds_have_their_numbers_and_those_that_face_away_are_not_missing() -> None:
    solution = bpnp.solve(LEDS.points2d, LEDS.points3d, LEDS.camera, normals3d=LEDS.normals3d)
    camera = LEDS.points3d @ LEDS.rotation.T + LEDS.translation
    away = (camera * (LEDS.normals3d @ LEDS.rotation.T)).sum(-1) > 0
    assert 4 < away.sum() < 13
    read = bpnp.Solution.from_json(solution.to_json())
    for one in (solution, read):
        axes = one.plot().axes[0]
        lines = drawn_lines(axes)
        assert len(lines["3D points, facing away"]) == away.sum()
        assert len(lines["3D points, matched"]) == len(solution.matches) == (~away).sum()
        assert "3D points, no match" not in lines
        places = {int(text.get_text()): text.xy for text in axes.texts}
        assert set(places) >= {*solution.matches[:, 1].tolist()}
        assert set(places) & {*np.flatnonzero(away).tolist()}
        for image, scene in solution.matches.tolist():
            np.testing.assert_allclose(places[scene], LEDS.points2d[image], atol=3)
    blind = bpnp.solve(LEDS.points2d, LEDS.points3d, LEDS.camera, time_limit=60)
    assert "3D points, facing away" not in drawn_lines(blind.plot().axes[0])


def test_an_ambiguous_solution_is_drawn_with_its_next_candidate(tmp_path: Path) -> None:
    solution = bpnp.solve(LEDS.points2d, LEDS.points3d, LEDS.camera, normals3d=LEDS.normals3d)
    assert len(solution.plot().axes) == 2
    best = solution.candidates[0]
    turned = replace(best, translation=best.translation + [0.005, 0, 0])  # metres, so 7 pixels to the right
    ambiguous = replace(solution, verdict="ambiguous", candidates=(best, turned), inlier_threshold=10.0)
    here, there, _ = ambiguous.plot().axes
    assert (here.get_title(), there.get_title()) == ("best pose", f"next candidate: {best.inlier_count} matches")
    places = [{text.get_text(): np.array(text.xy) for text in axes.texts} for axes in (here, there)]
    both = places[0].keys() & places[1].keys()
    assert len(both) > 8
    for name in both:
        np.testing.assert_allclose(places[1][name] - places[0][name], [800 * 0.005 / 0.6, 0], atol=1.5)
    joined = there.collections[0].get_segments()  # within the threshold, each point once
    assert 4 <= len(joined) == len({tuple(segment[0]) for segment in joined})
    assert max(np.linalg.norm(segment[1] - segment[0]) for segment in joined) <= 10.0
    ambiguous.plot().savefig(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
def test_a_picture_may_be_a_jpeg(suffix: str, solved: bpnp.Solution, tmp_path: Path) -> None:
    assert Image.open(save_figure(solved.plot(), tmp_path / f"a{suffix}")).format == "JPEG"
