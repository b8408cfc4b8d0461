"""Synthetic maps: exact geometry under the true pose, laws of sight and triangulation, and pure functions."""

from pathlib import Path

import numpy as np
import pytest
import torch
from jsonargparse import ArgumentParser
from scipy.spatial.transform import Rotation

from bpnp.datamodules import Outliers, Problem, SyntheticMapDataModule
from bpnp.datamodules.synthetic_maps.maps import KINDS, MOST_ERROR_PX, Frame, MapOptions, draw_map_problem

pytestmark = pytest.mark.slow


def problems(count: int, **options: object) -> list[Problem]:
    rngs = (np.random.default_rng([0, 0, 0, i]) for i in range(count))
    return [draw_map_problem(f"map/{i}", MapOptions(**options), rng) for i, rng in enumerate(rngs)]


def shown(problem: Problem) -> np.ndarray:
    """Image points of all 3D points, NaN behind the camera."""
    x, y, z = (problem.points3d @ problem.rotation.T + problem.translation).T
    return np.stack([x, y], 1) / np.where(z > 0, z, np.nan)[:, None]


def errors_px(problem: Problem) -> np.ndarray:
    """Return the error of each coordinate of the matched keypoints, in pixels."""
    return (shown(problem)[: problem.matched] - problem.points2d[: problem.matched]).ravel() * problem.focal


@pytest.mark.parametrize("kind", KINDS)
def test_matches_reproject_within_the_noise(kind: str) -> None:
    for problem in problems(4, num_points=100, kinds={kind: 1.0}, noise_px=0.0):
        assert np.abs(errors_px(problem)).max() < 0.1  # float32
        np.testing.assert_allclose(problem.rotation @ problem.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(problem.rotation) == pytest.approx(1)
    noise = np.concatenate(
        [errors_px(problem) for problem in problems(12, num_points=200, kinds={kind: 1.0}, noise_px=0.8)]
    )
    assert 0.75 < np.median(np.abs(noise)) / (0.8 * 0.6745) < 2.0  # the keypoint's, and more from the triangulation
    assert np.abs(noise).max() < MOST_ERROR_PX


@pytest.mark.parametrize("limit", [0.0, 0.5, 0.8])
def test_at_most_the_fraction_of_outliers_has_no_match_on_either_side(limit: float) -> None:
    for problem in problems(15, num_points=120, outliers=limit):
        for count in (len(problem.points2d), len(problem.points3d)):
            assert 16 <= problem.matched <= count <= 120
            assert 1 - problem.matched / count <= limit + 1 / problem.matched
    everything = problems(15, num_points=120, outliers=1.0)
    without = [1 - problem.matched / len(problem.points2d) for problem in everything]
    assert np.median(without) > 0.6  # most keypoints of a photo are in no other photo, or not in the view's


def test_points_lie_in_the_image_and_the_frame_is_arbitrary() -> None:
    plenty = problems(60, num_points=40, noise_px=0.0)
    for problem in plenty:
        half = 600 / problem.focal
        assert 24 <= 2 * np.degrees(np.arctan(half)) <= 115
        assert np.abs(problem.points2d).max() <= half * (1 + 1e-6)
        assert np.abs(problem.points2d).max(0).min() <= half * 0.75 * (1 + 1e-6)
    for frame in ("any", "upright", "y_down", "view"):
        kinds = {"facades": 1.0}
        data = SyntheticMapDataModule(num_points=40, test_problems=60, eval_batch_size=60, frame=frame, kinds=kinds)
        data.setup("test")
        (batch,) = data.test_dataloader()
        if frame == "any":
            assert batch.rotation.mean(0).abs().max() < 0.35
        elif frame == "view":  # another photo near by, which looks almost the same way
            angles = np.degrees(Rotation.from_matrix(batch.rotation.numpy()).magnitude())
            assert 3 < np.median(angles) < 30
            real = batch.points3d[batch.mask3d]  # its camera sees most of them
            assert (real[:, 2] > 0).float().mean() > 0.95
            assert (real[:, :2].norm(dim=1) < 1.6 * real[:, 2]).float().mean() > 0.9
        else:
            vertical, upwards, horizontal = (2, 1, [0, 1]) if frame == "upright" else (1, -1, [0, 2])
            assert (upwards * batch.rotation[:, 1, vertical]).quantile(0.75) < -0.8  # that axis is upwards in the image
            assert batch.rotation[:, 2, horizontal].mean(0).norm() < 0.35  # and any horizontal direction is ahead
            assert torch.linalg.det(batch.rotation).min() > 0.999
    extents = [np.median(np.ptp(problem.points3d, axis=0)) for problem in plenty]
    assert max(extents) / min(extents) > 20


@pytest.mark.parametrize(("frame", "vertical"), [("upright", 2), ("y_down", 1)])
def test_an_upright_frame_is_tilted_by_so_many_degrees(frame: Frame, vertical: int) -> None:
    options = {"num_points": 60, "noise_px": 0.0, "kinds": {"facades": 1.0}, "frame": frame}
    level, tilted = (problems(60, **options, tilt_deg=tilt) for tilt in (0.0, 10.0))
    angles = []
    for straight, turned in zip(level, tilted, strict=True):
        turn = turned.rotation.T @ straight.rotation
        angles.append(np.degrees(np.arccos(turn[vertical, vertical])))
        assert np.abs(errors_px(turned)).max() < 0.1
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(10 * 2**0.5, rel=0.2)


@pytest.mark.parametrize(("frame", "ahead"), [("upright", [0, 1]), ("y_down", [0, 2])])
def test_headings_vary_by_so_many_degrees_about_that_of_a_view(frame: Frame, ahead: list[int]) -> None:
    """Each problem is the same but for the heading, whose change is normal; the photo looks almost as the view does."""
    options = {"num_points": 60, "noise_px": 0.0, "kinds": {"facades": 1.0}, "frame": frame}
    view, spread = (problems(60, **options, heading_deg=degrees) for degrees in (0.0, 30.0))
    headings = [np.degrees(np.arctan2(*problem.rotation[2, ahead])) for problem in view]
    assert np.median(np.abs(headings)) < 25
    changes = []
    for before, after in zip(view, spread, strict=True):
        angles = (np.arctan2(*problem.rotation[2, ahead]) for problem in (before, after))
        changes.append((np.degrees(np.diff(list(angles)))[0] + 180) % 360 - 180)
        assert np.abs(errors_px(after)).max() < 0.1
    assert np.sqrt(np.mean(np.square(changes))) == pytest.approx(30, rel=0.2)


def test_scale_field_of_view_and_number_of_photos_are_those_of_the_options() -> None:
    options = {"num_points": 60, "kinds": {"facades": 1.0}, "field_of_view": 60.0}
    one, two = (problems(3, **options, scale_range=(scale, scale)) for scale in (1.0, 2.0))
    for small, large in zip(one, two, strict=True):
        np.testing.assert_allclose(large.points3d, 2 * small.points3d, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(large.translation, 2 * small.translation, atol=1e-6)
        assert small.focal == pytest.approx(600 / np.tan(np.radians(30)))
    fewer, more = (problems(12, **options, outliers=1.0, views=(count, count)) for count in (1, 5))
    ratios = [np.median([len(each.points3d) / len(each.points2d) for each in some]) for some in (fewer, more)]
    assert ratios[1] > 1.3 * ratios[0]  # more photos have more points of the map


def test_the_module_is_configured_by_yaml(tmp_path: Path) -> None:
    (tmp_path / "data.yaml").write_text(
        "{num_points: 48, outliers: [0, 0.5], views: [1, 2], kinds: {statue: 1, street: 2}, noise_px: 1,"
        " train_problems: 8, val_problems: 3, test_problems: 3, batch_size: 4, train_outliers: {ratio: [0, 1]}}"
    )
    parser = ArgumentParser()
    parser.add_class_arguments(SyntheticMapDataModule, "data")
    data = parser.instantiate_classes(parser.parse_args([f"--data={tmp_path / 'data.yaml'}"])).data
    with pytest.raises(ValueError, match=r"the train loader needs `setup\(\)` first"):
        data.train_dataloader()
    data.setup()
    assert data.options.outliers == (0.0, 0.5)
    assert data.options.kinds == {"statue": 1, "street": 2}
    assert data.outliers["train"] == Outliers(ratio=(0.0, 1.0))
    batches = list(data.train_dataloader())
    assert sorted(i for batch in batches for i in batch.index.tolist()) == list(range(8))
    assert max(batch.points3d.shape[1] for batch in batches) <= data.datasets["train"].sizes[0]
    assert sum(len(batch) for batch in data.test_dataloader()) == 3


WRONG: list[tuple[str, object]] = [
    ("min_points", 3), ("min_points", 400), ("outliers", -0.1), ("outliers", (1.0, 0.5)), ("field_of_view", 170.0),
    ("noise_px", (0.0, np.inf)), ("scale_range", (0.0, 1.0)), ("views", (0, 2)), ("tilt_deg", -1.0),
    ("heading_deg", -1.0),
    ("kinds", {"caves": 1.0}), ("kinds", {"statue": 0.0}), ("train_problems", 0),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_wrong_options_are_named(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SyntheticMapDataModule(**{name: value}).setup("fit")  # type: ignore[arg-type]
