"""Photos that are stored on their side: the orientation of their EXIF data says which views of a map are turned."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from planted import degrees_between
from planted_model import HEIGHT, PINHOLE, WIDTH
from scipy.spatial.transform import Rotation

from bpnp import SceneMap
from bpnp.cameras import camera_from
from bpnp.maps.photos import UP_OF_ORIENTATION, up_from_exif
from bpnp.maps.upright import count_quarter_turns, rotate_view
from bpnp.maps.views import View
from bpnp.poses import common_up

TURNED = camera_from(("PINHOLE", HEIGHT, WIDTH, [520.0, 520.0, HEIGHT / 2, WIDTH / 2]))  # of a photo on its side


def street(views: int = 4, seed: int = 0) -> tuple[SceneMap, np.ndarray]:
    """A map of upright views that look along z at 300 points, and its points; y is down."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-4, -2, 8), (4, 2, 12), (300, 3))
    made = []
    for k in range(views):
        rotation = Rotation.from_euler("yxz", rng.normal(0, 5, 3), degrees=True).as_matrix()
        centre = np.array([rng.uniform(-2, 2), rng.uniform(-0.5, 0.5), rng.uniform(-1, 1)])
        seen = np.sort(rng.choice(300, 220, replace=False)).astype(np.int32)
        made.append(
            View(f"{k}.jpg", camera_from((PINHOLE[0], WIDTH, HEIGHT, PINHOLE[1])), rotation, -rotation @ centre, seen)
        )
    return SceneMap(points, np.arange(300), np.zeros(300, np.int32), tuple(made)).seen_by(2), points


def photo_on_its_side(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of a photo that is stored turned by a quarter: up is to the left (orientation 6); and its rotation."""
    rng = np.random.default_rng(5)
    upright = Rotation.from_euler("yx", [4, -3], degrees=True).as_matrix()
    rotation = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ upright  # what was up, -y, is at -x
    seen = points[rng.permutation(300)[:200]] @ rotation.T + [0.3, -0.2, 0.5]
    keypoints = TURNED.project(seen) + rng.normal(0, 0.5, (200, 2))
    return np.concatenate([keypoints, rng.uniform((0, 0), (HEIGHT, WIDTH), (60, 2))]), rotation


@pytest.mark.parametrize("orientation", range(1, 9))
def test_up_is_the_side_that_pillow_rotates_to_the_top(orientation: int, tmp_path: Path) -> None:
    photo = Image.new("L", (40, 30))
    exif = photo.getexif()
    exif[0x0112] = orientation
    photo.save(tmp_path / "a.jpg", exif=exif)
    up = up_from_exif(tmp_path / "a.jpg")
    assert (up is None) == (orientation in (2, 4, 5, 7))  # mirrored
    if up is not None:
        marked = Image.new("L", (41, 31))
        x, y = round(20 + 20 * up[0]), round(15 + 15 * up[1])
        marked.putpixel((x, y), 255)
        marked.getexif()[0x0112] = orientation
        upright = np.asarray(ImageOps.exif_transpose(marked))
        assert upright[0].max() == 255


def test_a_photo_without_an_orientation_has_no_hint(tmp_path: Path) -> None:
    Image.new("L", (40, 30)).save(tmp_path / "a.jpg")
    assert up_from_exif(tmp_path / "a.jpg") is None


def test_up_is_what_most_views_agree_on() -> None:
    """One of five views is stored on its side, and is the only one to be turned for an upright photo."""
    scene, _ = street(5)
    views = [*scene.views[:4], rotate_view(scene.views[4], 1)]
    up = common_up(np.array([view.rotation for view in views]))
    assert up is not None
    np.testing.assert_allclose(up, [0, -1, 0], atol=0.2)
    assert count_quarter_turns(views, np.array(UP_OF_ORIENTATION[1])).tolist() == [0, 0, 0, 0, 3]
    for orientation, turns in ((6, 3), (3, 2), (8, 1)):
        found = count_quarter_turns(views, np.array(UP_OF_ORIENTATION[orientation]))
        assert found.tolist() == [turns] * 4 + [(turns + 3) % 4]
        seen = rotate_view(views[0], turns).rotation @ up
        assert seen @ UP_OF_ORIENTATION[orientation] > 0.9
    np.testing.assert_allclose(rotate_view(views[0], 1).centre, views[0].centre, atol=1e-12)


def test_views_without_a_common_up_direction_are_not_rotated() -> None:
    scene, _ = street(4)
    views = [rotate_view(view, k) for k, view in enumerate(scene.views)]
    assert common_up(np.array([view.rotation for view in views])) is None
    assert not count_quarter_turns(views, np.array([1.0, 0, 0])).any()


def test_a_photo_on_its_side_is_found_with_its_orientation() -> None:
    """Few looks are made near each view; without the hint they are made a quarter turn away."""
    scene, points = street()
    keypoints, rotation = photo_on_its_side(points)
    solution = scene.localize(keypoints, TURNED, up_camera=UP_OF_ORIENTATION[6])
    assert solution.verdict == "confident"
    assert degrees_between(solution.rotation, rotation) < 0.5


@pytest.mark.nightly
@pytest.mark.parametrize("orientation", [1, 8])
def test_a_wrong_orientation_does_not_lose_a_photo(orientation: int) -> None:
    scene, points = street()
    rng = np.random.default_rng(1)
    view = scene.views[1]
    keypoints = view.camera.project(points[rng.permutation(300)[:200]] @ view.rotation.T + view.translation)
    plain = scene.localize(keypoints, view.camera)
    solution = scene.localize(keypoints, view.camera, up_camera=UP_OF_ORIENTATION[orientation])
    assert (plain.verdict, solution.verdict) == ("confident", "confident")
    assert degrees_between(solution.rotation, view.rotation) < 0.5
    if orientation == 1:  # no view is turned, and nothing changes
        np.testing.assert_array_equal(solution.rotation, plain.rotation)


def test_an_up_direction_without_three_numbers_is_refused() -> None:
    scene, points = street()
    with pytest.raises(ValueError, match=r"`up_camera` is \[0.0, 0.0, 0.0\]; three numbers that are not all zero"):
        scene.localize(photo_on_its_side(points)[0], TURNED, up_camera=[0, 0, 0])
