"""Picture of a photo in a map, read back from the figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_model import PINHOLE, plant_model

from bpnp import SceneMap, Solution
from bpnp.cameras import camera_from
from bpnp.maps.localized_picture import BOUND, draw_from_above, draw_matches, localized_picture, plane_from_above
from bpnp.maps.views import View


def test_matches_have_the_colour_of_their_residual_and_the_camera_stands_where_it_was_planted(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    truth = plant_model(tmp_path, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    scene = SceneMap.from_colmap(tmp_path)
    pixels = 520 * truth.points2d[1] + [400, 300] + np.random.default_rng(0).normal(0, 0.5, truth.points2d[1].shape)
    keypoints = np.concatenate([pixels, truth.clutter_px[1]])
    solution = scene.localize(keypoints, PINHOLE, views=["photo 1.jpg"])
    assert solution.verdict == "confident"

    image, above = Figure().subplots(1, 2)
    marks = draw_matches(image, solution)
    matched = solution.matches[:, 0]
    np.testing.assert_allclose(marks.get_offsets(), keypoints[matched], atol=1e-6)
    assert float(np.mean(marks.get_array())) == pytest.approx(solution.reprojection_error, rel=1e-6)
    assert {len(line.get_xdata()) for line in image.lines} == {len(keypoints) - len(matched)}

    draw_from_above(above, scene, solution)
    views = next(line for line in above.lines if line.get_label() == "3 views").get_xydata()
    (place,) = next(line for line in above.lines if line.get_label() == "the photo").get_xydata()
    (ellipse,) = above.patches
    off = np.linalg.norm(views[1] - place)  # the photo is view 1, with other noise
    assert off < max(ellipse.width, ellipse.height) / 2 <= 1.01 * BOUND * solution.centre_std
    spaced = np.linalg.norm(views[0] - views[2])
    centres = scene.views[0].centre - scene.views[2].centre
    down = np.mean([view.rotation[1] for view in scene.views], axis=0)
    down /= np.linalg.norm(down)
    assert spaced == pytest.approx(np.linalg.norm(centres - down * (centres @ down)))


def planted(folder: Path) -> tuple[SceneMap, Solution, np.ndarray]:
    truth = plant_model(folder, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    scene, keypoints = SceneMap.from_colmap(folder), 520 * truth.points2d[1] + [400, 300]
    return scene, scene.localize(keypoints, PINHOLE, views=["photo 1.jpg"]), keypoints


def test_a_failed_photo_shows_its_keypoints_alone(tmp_path: Path) -> None:
    scene, solution, keypoints = planted(tmp_path)
    unknown = np.full((6, 6), np.nan)
    failed = replace(solution, verdict="failed", reason="No pose fits.", covariance=unknown)
    figure = localized_picture(scene, failed, title="a.jpg")
    image, above = figure.axes  # and no colour bar
    assert not image.collections
    assert {len(line.get_xdata()) for line in image.lines} == {len(keypoints)}
    assert [line.get_label() for line in above.lines if not line.get_label().startswith("_")] == ["3 views"]
    shown = [figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)]
    assert shown == ["a.jpg\nfailed: No pose fits.", f"{len(keypoints)} keypoints", "the map from above; no pose"]


def test_a_map_without_a_direction_down_is_drawn() -> None:
    """Two photos upside down to each other, and a camera that looks along the y axes."""
    view = View("a.jpg", camera_from(np.eye(3)), np.eye(3), np.zeros(3), np.arange(3, dtype=np.int32))
    turned = replace(view, rotation=np.diag([-1.0, -1, 1]))
    for views, forward in (((view, turned), [0, 0, 1]), ((view, view), [0, 1, 0]), ((view, turned), [0, -1, 0])):
        axes = plane_from_above(views, np.array(forward, float))
        np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
        np.testing.assert_allclose(axes[:, 1], 0, atol=1e-12)


def test_an_ambiguous_photo_stands_at_both_places(tmp_path: Path) -> None:
    scene, solution, _ = planted(tmp_path)
    far = replace(solution.candidates[0], translation=solution.translation - 1e6 * solution.rotation[:, 0])
    ambiguous = replace(solution, verdict="ambiguous", candidates=(solution.candidates[0], far))
    above = localized_picture(scene, ambiguous, title="a.jpg").axes[1]
    stars = {line.get_label(): line.get_xydata()[0] for line in above.lines if line.get_marker() == "*"}
    assert list(stars) == ["the photo", "or here, outside of the drawing"]
    for x, y in stars.values():
        assert above.get_xlim()[0] < x < above.get_xlim()[1]
        assert above.get_ylim()[0] < y < above.get_ylim()[1]
