"""Photos under the points, undistorted."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from planted_model import HEIGHT, WIDTH, plant_model
from report_data import drawn_problem, inflated, write_run

from bpnp.cli import main
from bpnp.datamodules.colmap.scenes import photo_finder
from bpnp.report import plot_problem, write_page
from bpnp.report.photos import Box, picture_box
from bpnp.report.points import write_points


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
    own = drawn_problem(0, "castle/photo 0.jpg")
    write_points(tmp_path / "run" / "test", [own, drawn_problem(1, "castle/none.jpg")])
    plain = write_page([tmp_path / "run"], tmp_path / "plain.html").stat().st_size
    scenes = str(tmp_path / "scenes")
    main(["report", str(tmp_path / "run"), "--html", str(tmp_path / "r.html"), "--photos", scenes])
    text = (tmp_path / "r.html").read_text()
    data = json.loads(inflated(text.split('id="data">')[1].split("<")[0]))
    assert list(data["photos"]) == [own.id]
    assert len(text) > plain + 3000
    figure = plot_problem(own, photo=np.zeros((4, 4, 3), np.uint8))
    (shown,) = figure.axes[1].images
    box = picture_box(own.points2d)
    assert shown.get_extent() == [box.left, box.right, box.bottom, box.top]
