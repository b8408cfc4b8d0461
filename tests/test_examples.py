"""The problems that the package comes with are solved to their true pose, as the README shows."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import bpnp
from bpnp.examples import PHOTO_CAMERA, Kind, draw_photos, load


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds", "stars"])
def test_a_true_pose_projects_points_onto_their_image(kind: Kind) -> None:
    example = load(kind)
    camera = example.points3d @ example.rotation.T + example.translation
    front = camera[:, 2] > 0
    pixels = camera[front, :2] / camera[front, 2:] @ example.camera[:2, :2].T + example.camera[:2, 2]
    distance = np.linalg.norm(example.points2d[:, None] - pixels, axis=-1).min(1)
    near = distance < example.camera[0, 0] / 400  # 0.14 degrees
    assert near.mean() > {"mesh": 0.99, "photo": 0.6, "leds": 0.6, "stars": 0.6}[kind]


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds"])
def test_every_example_is_solved(kind: Kind) -> None:
    example = load(kind)
    solution = bpnp.solve(example.points2d, example.points3d, example.camera, normals3d=example.normals3d)
    assert example.rotation_error_deg(solution.rotation) < 2
    assert (solution.matches[:, 0] == solution.matches[:, 1]).mean() < 0.1  # the order of the points tells nothing
    assert (example.points2d > 0).all()
    assert (example.points2d < 2 * example.camera[:2, 2]).all()


def test_the_camera_of_the_stars_is_found() -> None:
    example = load("stars")
    assert (len(example.points2d), example.translation.tolist()) == (60, [0, 0, 0])
    assert np.allclose(np.linalg.norm(example.points3d, axis=-1), 1)
    solution = bpnp.solve(example.points2d, example.points3d, example.camera, at_infinity=True)
    assert solution.verdict == "confident"
    assert example.rotation_error_deg(solution.rotation) < 0.05


def test_the_error_of_a_failed_solution_is_not_a_number() -> None:
    example = load("mesh")
    failed = bpnp.solve(example.points2d, np.zeros((5, 3)) + [0, 0, 1.0], example.camera)
    assert failed.verdict == "failed"
    assert np.isnan(example.rotation_error_deg(failed.rotation))
    turned = np.diag([-1.0, -1.0, 1.0]) @ example.rotation
    assert example.rotation_error_deg(turned) == pytest.approx(180)


def test_other_names_are_refused() -> None:
    with pytest.raises(ValueError, match="expected an example among mesh, photo, leds, stars, got 'video'"):
        load("video")


def test_photos_have_the_epipolar_geometry_of_their_poses(tmp_path: Path) -> None:
    """SIFT matches of two photos, triangulated by OpenCV, are points of the place that both photos see in front."""
    poses = draw_photos(tmp_path, count=8)
    assert sorted(path.name for path in tmp_path.iterdir()) == list(poses)
    fx, fy, cx, cy = PHOTO_CAMERA[3]
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    sift = cv2.SIFT.create()
    seen = [sift.detectAndCompute(cv2.imread(str(tmp_path / name)), None) for name in ("04.png", "05.png")]
    matches = cv2.BFMatcher().knnMatch(seen[0][1], seen[1][1], k=2)
    pairs = [a for a, b in matches if a.distance < 0.7 * b.distance]
    pixels = [
        np.array([keys[getattr(pair, side)].pt for pair in pairs]) + 0.5
        for (keys, _), side in zip(seen, ("queryIdx", "trainIdx"), strict=True)
    ]
    views = [np.column_stack(poses[name]) for name in ("04.png", "05.png")]
    homogeneous = cv2.triangulatePoints(*(camera @ view for view in views), *(own.T for own in pixels))
    errors = []
    for view, own in zip(views, pixels, strict=True):
        projected = camera @ view @ homogeneous
        errors.append(np.linalg.norm((projected[:2] / projected[2]).T - own, axis=-1))
    right = np.max(errors, axis=0) < 1
    assert len(pairs) > 200
    assert right.mean() > 0.9
    x, y, z = (homogeneous[:3] / homogeneous[3])[:, right]
    inside = (abs(z - 1.75) < 1.8) & (abs(x - 0.5) < 7.6) & (abs(y + 1) < 7.1)  # ground to roof, the ground's extent
    assert inside.mean() > 0.97
    assert (abs(y + 1) < 0.05).mean() > 0.1  # the wall in front
