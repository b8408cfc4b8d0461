"""Views of solutions: of the object, and of the file; and photos under the points, undistorted."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from planted_model import HEIGHT, WIDTH, plant_model
from report_data import inflated, view, write_run

from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.report import plot_pair, write_page
from bpnp.report.figures import plot_scene
from bpnp.report.photos import Box, box_of
from bpnp.report.pictures import plot_image, plot_residuals
from bpnp.report.samples import write_views
from bpnp.report.solutions import solution_view, view_of
from bpnp.solving.solution import Solution, SolutionStats


def solved(camera: Any = None) -> Solution:
    """Exact; of 12 points two are matched."""
    planted = view(3, "x", 12)
    assert planted.pose is not None
    return Solution(
        rotation=planted.pose[0], translation=planted.pose[1], matches=np.array([[3, 3], [5, 5]]), inlier_count=2,
        inlier_ratio=0.5, reprojection_error=0.0, unit="px", verdict="ambiguous", reason="few", camera=camera,
        stats=SolutionStats(), points2d=planted.points2d.astype(float), points3d=planted.points3d.astype(float),
    )  # fmt: skip


def test_a_solution_is_drawn_with_its_matches_in_pixels_of_its_camera() -> None:
    camera = camera_from(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    for own, unit in ((None, "normalised coordinates"), (camera, "pixels")):
        solution = solved(own)
        figure = plot_pair(solution)
        assert figure.get_suptitle() == "ambiguous: 2 matches (50 %), mean error 0 px\nfew"
        axes = figure.axes[1]
        assert axes.get_xlabel() == axes.get_ylabel() == unit
        (segments,) = axes.collections  # one a match, from the image point to the reprojected 3D point
        ends = np.stack(segments.get_segments())
        seen = solution.points2d if own is None else own.project(np.c_[solution.points2d, np.ones(12)])
        np.testing.assert_allclose(ends, np.repeat(seen[[3, 5], None], 2, 1), atol=1e-3)


def test_the_parts_of_a_picture_are_drawn_into_given_axes() -> None:
    from matplotlib.figure import Figure

    own = solution_view(solved())
    image, close_up = Figure().subplots(1, 2)
    space = Figure().add_subplot(projection="3d")
    assert (plot_image(image, own), plot_residuals(close_up, own), plot_scene(space, own)) == (image, close_up, space)
    assert np.abs(np.asarray(close_up.get_lines()[0].get_xydata())).max() < 1e-6
    assert len(space.collections[0].get_offsets()) == 12
    lost = view_of(own.points2d, own.points3d, np.full((3, 3), np.nan), np.full(3, np.nan))
    assert not plot_residuals(Figure().subplots(), lost).axison


def test_the_file_of_a_solution_is_drawn_and_broken_ones_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "castle.json"
    path.write_text(solved().to_json())
    main(["view", str(path)])
    assert (tmp_path / "views" / "castle.png").stat().st_size > 5000
    (tmp_path / "pictures").mkdir()
    content = json.loads(path.read_text())
    for text, message in (
        ("", "expected the JSON of a solution in"),
        ('{"images": []}', "the pictures of `bpnp localize` are in"),
        (json.dumps(content | {"points2d": [[1, 2, 3]]}), "expected the JSON of a solution in"),
        (json.dumps(content | {"matches": [[0, 99]]}), "expected `matches` of 12 2D and 12 3D points"),
    ):
        path.write_text(text)
        with pytest.raises(SystemExit):
            main(["view", str(path)])
        shown = " ".join(capsys.readouterr().err.split())
        assert message in shown
        assert "castle.json" in shown


def photographed(folder: Path, shrink: int = 1) -> Any:
    """A distorted camera's photos of the planted points: a red disc at each keypoint, on grey."""
    planted = plant_model(folder / "castle" / "sparse" / "0", seed=1)
    import pycolmap

    images = folder / "castle" / "images"
    images.mkdir()
    model = pycolmap.Reconstruction(folder / "castle" / "sparse" / "0")
    for image in model.images.values():
        pixels = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        for point in image.points2D:
            if point.has_point3D():
                x, y = point.xy
                pixels[np.hypot(columns - x, rows - y) < 6] = (255, 0, 0)
        small = Image.fromarray(pixels).resize((WIDTH // shrink, HEIGHT // shrink))
        small.save(images / image.name, quality=98)
    return planted


@pytest.mark.parametrize("shrink", [1, 2])
def test_the_photo_lies_under_the_normalised_points(tmp_path: Path, shrink: int) -> None:
    """Of the camera's size, or made smaller after the reconstruction."""
    planted = photographed(tmp_path, shrink)
    find = photo_finder(tmp_path)
    points = planted.points2d[0]
    box = Box(*(points.min(0) - 0.05).tolist(), *(points.max(0) + 0.05).tolist())
    photo = find("castle/photo 0.jpg", box)
    assert photo is not None
    height, width = photo.shape[:2]
    columns = (points[:, 0] - box.left) / (box.right - box.left) * width
    rows = (points[:, 1] - box.top) / (box.bottom - box.top) * height
    shown = photo[rows.astype(int), columns.astype(int)].astype(int)
    assert (shown[:, 0] - shown[:, 1] > 150).all()
    assert find("castle/photo 9.jpg", box) is None
    assert find("elsewhere/photo 0.jpg", box) is None
    (tmp_path / "castle" / "images" / "photo 1.jpg").write_bytes(b"no photo")
    assert find("castle/photo 1.jpg", box) is None


def test_the_page_and_the_figure_carry_the_photo(tmp_path: Path) -> None:
    photographed(tmp_path / "scenes")
    write_run(tmp_path / "run", 9, 0)
    own = view(0, "castle/photo 0.jpg")
    write_views(tmp_path / "run" / "test", [own, view(1, "castle/none.jpg")])
    plain = write_page([tmp_path / "run"], tmp_path / "plain.html").stat().st_size
    scenes = str(tmp_path / "scenes")
    main(["report", str(tmp_path / "run"), "--html", str(tmp_path / "r.html"), "--photos", scenes])
    text = (tmp_path / "r.html").read_text()
    data = json.loads(inflated(text.split('id="data">')[1].split("<")[0]))
    assert list(data["photos"]) == [own.id]
    assert len(text) > plain + 3000
    figure = plot_pair(own, photo=np.zeros((4, 4, 3), np.uint8))
    (shown,) = figure.axes[1].images
    box = box_of(own)
    assert shown.get_extent() == [box.left, box.right, box.bottom, box.top]
