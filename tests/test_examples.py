"""The problems that the package comes with are solved to their true pose, as the README shows."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bpnp
from bpnp.examples import Kind, load

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds"])
def test_a_true_pose_projects_points_onto_their_image(kind: Kind) -> None:
    example = load(kind)
    camera = example.points3d @ example.rotation.T + example.translation
    front = camera[:, 2] > 0
    pixels = camera[front, :2] / camera[front, 2:] @ example.camera[:2, :2].T + example.camera[:2, 2]
    distance = np.linalg.norm(example.points2d[:, None] - pixels, axis=-1).min(1)
    near = distance < example.camera[0, 0] / 400  # 0.14 degrees
    assert near.mean() > {"mesh": 0.99, "photo": 0.6, "leds": 0.6}[kind]


@pytest.mark.parametrize("kind", ["mesh", "photo", "leds"])
def test_every_example_is_solved(kind: Kind) -> None:
    example = load(kind)
    solution = bpnp.solve(example.points2d, example.points3d, example.camera, normals3d=example.normals3d)
    assert example.rotation_error_deg(solution.rotation) < 2
    assert (solution.matches[:, 0] == solution.matches[:, 1]).mean() < 0.1  # the order of the points tells nothing
    assert (example.points2d > 0).all()
    assert (example.points2d < 2 * example.camera[:2, 2]).all()


def test_the_error_of_a_failed_solution_is_not_a_number() -> None:
    example = load("mesh")
    failed = bpnp.solve(example.points2d, np.zeros((5, 3)) + [0, 0, 1.0], example.camera)
    assert failed.verdict == "failed"
    assert np.isnan(example.rotation_error_deg(failed.rotation))
    turned = np.diag([-1.0, -1.0, 1.0]) @ example.rotation
    assert example.rotation_error_deg(turned) == pytest.approx(180)


def test_an_unknown_example_is_refused() -> None:
    with pytest.raises(ValueError, match="there is no example 'video'; the examples are mesh, photo, leds"):
        load("video")


def test_drawing_a_map_leaves_the_handler_of_sigterm(tmp_path: Path) -> None:
    """pycolmap replaces it by one that prints a stack trace."""
    code = (
        "import os, signal, bpnp.examples\n"
        f"bpnp.examples.draw_map({str(tmp_path / 'map')!r})\n"
        "os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")
