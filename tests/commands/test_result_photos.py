"""Photos under the points of tested problems: drawn photos with a bright spot at each keypoint of a planted model."""

import base64
import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from planted_model import HEIGHT, OPENCV, WIDTH, plant_model
from report_data import inflated

from bpnp import Pose, Prediction, SolveStats
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.commands.photo_files import ColmapPhotos, ModelImage, find_photos
from bpnp.datamodules import ColmapDataModule
from bpnp.report import dashboards, figures, page, read_points, read_results, write_results
from bpnp.report.photos import undistort_photo
from bpnp.report.points import points_from, write_points
from bpnp.report.results import rows_from

LENS = camera_from((OPENCV[0], WIDTH, HEIGHT, OPENCV[1]))


def spots(points2d: np.ndarray) -> np.ndarray:
    """A dark photo at half size with a spot of 5 x 5 pixels at each point."""
    photo = np.full((HEIGHT // 2, WIDTH // 2, 3), 30, np.uint8)
    for x, y in LENS.project(np.column_stack([points2d, np.ones(len(points2d))])) / 2 - 0.5:
        column, row = round(x), round(y)
        photo[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = 250
    return photo


def brightness(pixels: np.ndarray, extent: list[float], points2d: np.ndarray) -> np.ndarray:
    """The values of a photo at normalised points."""
    left, top, right, bottom = extent
    at = (points2d - [left, top]) / [right - left, bottom - top] * pixels.shape[1::-1]
    columns, rows = np.clip(at.astype(int), 0, np.array(pixels.shape[1::-1]) - 1).T
    return pixels[rows, columns].mean(-1)


@pytest.fixture
def tested(tmp_path: Path) -> Path:
    """Results of two tests of a COLMAP scene, whose photos are next to its model."""
    truth = plant_model(tmp_path / "castle" / "sparse" / "0", camera=OPENCV, clutter=0)
    (tmp_path / "castle" / "images").mkdir()
    for i, points2d in enumerate(truth.points2d):
        Image.fromarray(spots(points2d)).save(tmp_path / "castle" / "images" / f"photo {i}.jpg", quality=95)
    data = ColmapDataModule(str(tmp_path / "castle"), test_fraction=1.0, batch_size=3)
    data.setup("test")
    (batch,) = data.test_dataloader()
    stats = SolveStats.of(torch.ones(3, dtype=torch.bool))
    settings = {"data": {"class_path": "bpnp.datamodules.ColmapDataModule", "init_args": {"root": str(data.root)}}}
    for name, estimates in (("search", ["search"]), ("net", ["ransac", "pnp"])):
        pose = Pose(batch.rotation, batch.translation, stats)
        prediction = Prediction(poses=dict.fromkeys(estimates, pose))
        write_results(tmp_path / "table" / name, rows_from(prediction, batch, 1.0), settings=settings)
        write_points(tmp_path / "table" / name, points_from(prediction, batch))
    return tmp_path


def test_an_undistorted_photo_has_each_spot_at_its_normalised_point() -> None:
    points2d = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 2))
    found = undistort_photo(spots(points2d), LENS, points2d)
    assert max(found.pixels.shape) == 480
    values = brightness(found.pixels, list(found.extent), points2d)
    assert values.min() > 150
    assert np.median(found.pixels) < 60
    low, high = points2d.min(0), points2d.max(0)
    np.testing.assert_allclose(found.extent, [*low - 0.15 * (high - low), *high + 0.15 * (high - low)], atol=0.01)
    with pytest.raises(ValueError, match="another aspect ratio"):
        undistort_photo(np.zeros((300, 300, 3), np.uint8), LENS, points2d)
    with pytest.raises(ValueError, match="outside the photo"):
        undistort_photo(spots(points2d), LENS, points2d + 9)


def page_lines(path: Path) -> list[dict[str, Any]]:
    (text,) = re.findall(r'<script type="text/plain" id="points">(.*?)</script>', path.read_text(), re.DOTALL)
    return [json.loads(line) for line in inflated(text).split("\n")[1:]]


def test_the_page_has_the_photos_of_a_scene_up_to_a_limit(tested: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tested / "report.html"
    main(["report", str(tested / "table" / "search"), "--html", str(output)])
    lines = page_lines(output)
    assert len(lines) == 3
    for line in lines:
        photo = np.array(Image.open(io.BytesIO(base64.b64decode(line["photo"]["jpeg"]))))
        values = brightness(photo, line["photo"]["extent"], np.array(line["points2d"]))
        assert np.median(values) > 150  # spots of neighbours in JPEG are blurred
        assert np.median(photo) < 60
    monkeypatch.setattr(page, "PHOTO_BYTES", 1)
    main(["report", str(tested / "table" / "search"), "--html", str(output)])
    assert sum("photo" in line for line in page_lines(output)) == 1


def test_photos_of_another_folder_are_found_or_missed_with_a_message(tested: Path, fails: Callable[..., str]) -> None:
    (tested / "castle" / "images").rename(tested / "elsewhere")
    output, arguments = tested / "report.html", ["report", str(tested / "table" / "search"), "--html"]
    main([*arguments, str(output)])
    assert not any("photo" in line for line in page_lines(output))
    main([*arguments, str(output), "--photos", str(tested / "elsewhere")])
    assert all("photo" in line for line in page_lines(output))
    shown = fails(*arguments, str(output), "--photos", str(tested / "table"))
    assert "has no photo of the problems, such as castle/photo 0.jpg" in shown
    results = read_results(tested / "table" / "search")
    results.settings["data"]["class_path"] = "bpnp.datamodules.MeshDataModule"
    assert find_photos(results, None) is None
    with pytest.raises(ValueError, match="Leave out --photos"):
        find_photos(results, tested)


def set_root(store: Path, results: Path) -> None:
    """Let results be those of a test on a store."""
    summary = json.loads((results / "summary.json").read_text())
    summary["settings"]["data"]["init_args"]["root"] = str(store)
    (results / "summary.json").write_text(json.dumps(summary))


def test_a_store_shows_photos_without_its_models(tested: Path) -> None:
    """The cameras are those of the models: each spot of a photo is at the normalised point of its keypoint."""
    main(["prepare", "megadepth", str(tested / "castle"), "--output", str(tested / "store"), "--processes", "1"])
    shutil.rmtree(tested / "castle" / "sparse")
    results, output = tested / "table" / "search", tested / "report.html"
    set_root(tested / "store", results)
    main(["report", str(results), "--html", str(output)])
    (tested / "castle" / "images").rename(tested / "elsewhere")
    main(["report", str(results), "--html", str(tested / "other.html"), "--photos", str(tested / "elsewhere")])
    for page_file in (output, tested / "other.html"):
        lines = page_lines(page_file)
        assert len(lines) == 3
        for line in lines:
            photo = np.array(Image.open(io.BytesIO(base64.b64decode(line["photo"]["jpeg"]))))
            assert np.median(brightness(photo, line["photo"]["extent"], np.array(line["points2d"]))) > 150


def test_missing_photos_are_counted_once(tested: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tested / "castle" / "images" / "photo 1.jpg").unlink()
    main(["report", str(tested / "table"), "--html", str(tested / "report.html")])
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.count("1 of 3 problems have no photo in the folder images next to sparse") == 1
    assert "such as castle/photo 1.jpg; give their folder with --photos" in shown
    assert sum("photo" in line for line in page_lines(tested / "report.html")) == 2
    (tested / "castle").rename(tested / "moved")
    main(["report", str(tested / "table"), "--html", str(tested / "report.html")])
    shown = " ".join(capsys.readouterr().out.split())
    assert f"the COLMAP models of the test are no longer in {tested / 'castle'}" in shown


@pytest.mark.nightly
def test_pictures_for_wandb_have_the_photo(tested: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    drawn: list[str] = []
    real = dashboards.plot_photo
    monkeypatch.setattr(
        dashboards, "plot_photo", lambda problem, photo, **options: drawn.append(problem.id) or real(problem, photo)
    )
    main(["wandb", str(tested / "table" / "search"), "--directory", str(tested)])
    assert sorted(drawn) == [f"castle/photo {i}.jpg" for i in range(3)]


def test_the_poses_of_several_tests_are_drawn_over_one_photo(
    tested: Path, monkeypatch: pytest.MonkeyPatch, fails: Callable[..., str]
) -> None:
    """As in Fig. 4 of the paper: the crosses of each pose, all of them true, meet the rings."""
    drawn: list[Any] = []
    real = figures.plot_photo
    monkeypatch.setattr(
        figures, "plot_photo", lambda *given, **options: drawn.append(real(*given, **options)) or drawn[-1]
    )
    output = tested / "view.png"
    main(
        [
            "view",
            str(tested / "table"),
            "photo 1",
            "--photos",
            str(tested / "castle" / "images"),
            "--output",
            str(output),
        ]
    )
    assert output.stat().st_size > 5000
    (figure,) = drawn
    assert [axes.get_title().split(": ")[:-1] for axes in figure.axes] == [
        ["net", "ransac"],
        ["net", "pnp"],
        ["search"],
    ]
    (problem,) = (each for each in read_points(tested / "table" / "net") if each.id == "castle/photo 1.jpg")
    for axes in figure.axes:
        rings, crosses = (next(line for line in axes.lines if line.get_marker() == marker) for marker in "ox")
        np.testing.assert_allclose(rings.get_xydata()[problem.match3d], crosses.get_xydata(), atol=0.1)
    assert "leave out --photo and --camera" in fails(
        "view", str(tested / "table"), "--photos", "x", "--photo", "y.png", "--camera", "K.txt"
    )


@pytest.mark.parametrize("name", ["../secret.jpg", "{folder}/secret.jpg"])
def test_the_name_of_an_image_does_not_lead_out_of_the_folder_of_photos(name: str, tmp_path: Path) -> None:
    name = name.format(folder=tmp_path)
    plant_model(tmp_path / "castle" / "sparse" / "0", camera=OPENCV, clutter=0)
    (tmp_path / "castle" / "images").mkdir()
    for folder in (tmp_path, tmp_path / "castle"):
        Image.new("L", (WIDTH, HEIGHT)).save(folder / "secret.jpg")
    image = ModelImage(name, "castle", tmp_path / "castle" / "sparse" / "0", lambda: LENS)
    for photos in (None, tmp_path / "castle" / "images"):
        source = ColmapPhotos(lambda _: iter([image]), photos)
        assert not source.has_file(f"castle/{name}")
    inside = ColmapPhotos(lambda _: iter([image._replace(name="secret.jpg")]), tmp_path)
    assert inside.has_file("castle/secret.jpg")
