"""What a solution shows of itself."""

import base64
import io
import pickle
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from PIL import Image
from planted import plant

import bpnp
from bpnp.cameras import camera_from

PLANTED = plant(1, 40, seed=2)
LENS = ("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05))
MATRIX = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])


def test_a_solution_is_drawn_with_a_cross_on_every_image_point() -> None:
    solution = bpnp.solve(PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy())
    lines = {line.get_label(): line.get_xydata() for line in solution.plot().axes[0].get_lines()}
    crosses = np.asarray(lines["3D points, matched"])
    seen = np.asarray(lines["image points"])
    distance = np.linalg.norm(seen[:, None] - crosses, axis=-1)
    assert distance.min(1).max() < 1e-6


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
