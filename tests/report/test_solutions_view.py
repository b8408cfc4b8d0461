"""Views of solutions: of the object, and of the file; and photos under the points, undistorted."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from planted_model import HEIGHT, WIDTH, plant_model
from report_data import inflated, view, write_run

from bpnp.cli import main
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.report import plot_pair, write_page
from bpnp.report.photos import Box, box_of
from bpnp.report.samples import write_views
from bpnp.report.solutions import read_solution, solution_view


@dataclass
class Solved:
    points2d: np.ndarray
    points3d: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    matches: np.ndarray
    verdict: str = "safe"
    inlier_ratio: float = 0.5


def solved() -> Solved:
    planted = view(3, "x", 12)
    assert planted.pose is not None
    return Solved(planted.points2d, planted.points3d, *planted.pose, np.array([[3, 3], [5, 5]]))


def test_a_solution_is_drawn_with_its_matches_on_its_points() -> None:
    figure = plot_pair(solved())
    assert figure.get_suptitle() == "solution: safe, 50 % inliers"
    lines = figure.axes[1].lines
    drawn = [line.get_xydata() for line in lines if len(line.get_xydata()) == 2]
    assert len(drawn) == 2  # one a match, from the image point to the reprojected 3D point
    assert all(np.allclose(a, b, atol=1e-5) for a, b in drawn)


def test_the_file_of_a_solution_is_drawn_and_broken_ones_are_named(tmp_path: Path) -> None:
    content = {name: np.asarray(value).tolist() for name, value in vars(solved()).items()}
    path = tmp_path / "castle.json"
    path.write_text(json.dumps(content))
    main(["view", str(path)])
    assert (tmp_path / "views" / "castle.png").stat().st_size > 5000
    assert solution_view(Solved(**(vars(solved()) | {"rotation": None}))).estimates["solution"][0].shape == (3, 3)
    for change, message in (
        ({"points2d": [[1, 2, 3]]}, r"castle.json: expected `points2d` of shape \(k, 2\), got \(1, 3\)"),
        ({"translation": ["x", 1, 2]}, "castle.json: expected numbers in `translation`"),
        ({"matches": [[0, 99]]}, "castle.json: expected `matches` of 12 2D and 12 3D points"),
        ({"points3d": []}, "castle.json: expected `points3d` of shape"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(ValueError, match=message):
            read_solution(path)
    for text, message in (
        ("", "JSON of a solution"),
        ("[]", "no points2d"),
        ('{"images": []}', "its pictures are in"),
        ('{"rotation": 1}', "no points2d"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_solution(path)


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
