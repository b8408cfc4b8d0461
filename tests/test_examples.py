"""The problems that the package comes with are solved to their true pose, as the README shows."""

import numpy as np
import pytest

import bpnp
from bpnp.examples import Kind, load


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds"])
def test_a_true_pose_projects_points_onto_their_image(kind: Kind) -> None:
    example = load(kind)
    camera = example.points3d @ example.rotation.T + example.translation
    front = camera[:, 2] > 0
    pixels = camera[front, :2] / camera[front, 2:] @ example.camera[:2, :2].T + example.camera[:2, 2]
    distance = np.linalg.norm(example.points2d[:, None] - pixels, axis=-1).min(1)
    assert (distance < 3).mean() > {"mesh": 0.99, "photo": 0.6, "leds": 0.6}[kind]


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds"])
def test_every_example_is_solved(kind: Kind) -> None:
    example = load(kind)
    solution = bpnp.solve(example.points2d, example.points3d, example.camera, normals3d=example.normals3d)
    assert example.rotation_error_deg(solution.rotation) < 2


def test_other_names_are_refused() -> None:
    with pytest.raises(ValueError, match="expected an example among mesh, photo, leds, got 'video'"):
        load("video")
