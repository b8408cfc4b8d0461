"""Scenes with a repeated structure: a pose that sees one of several equal things is never called confident."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import solve

Array = NDArray[np.float64]
CAMERA = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
NOISE = 0.5  # pixels


def lattice(columns: int, rows: int) -> Array:
    return np.array([[0.3 * i, 0.3 * j, 0] for i in range(columns) for j in range(rows)])


def stairs(rng: np.random.Generator) -> Array:
    """Eight points across, the same on each of twelve steps."""
    across = rng.uniform(-1, 1, 8)
    return np.array([[x, 0.2 * k, 0.25 * k] for k in range(12) for x in across])


def wallpaper(rng: np.random.Generator) -> Array:
    """A motif of five points in relief, eight times five of it."""
    motif = rng.uniform(0, 0.5, (5, 3)) * (1, 1, 0.3)
    return np.concatenate([motif + (0.5 * i, 0.5 * j, 0) for i in range(8) for j in range(5)])


def part_of(scene: Array, distance: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels of the points in a view of the middle of the scene, and the rotation of the camera."""
    rotation = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix()
    camera = (scene - scene.mean(0)) @ rotation.T + (0, 0, distance)
    seen = camera @ CAMERA.T
    pixels = seen[:, :2] / seen[:, 2:] + NOISE * rng.standard_normal((len(scene), 2))
    inside = (camera[:, 2] > 0) & (pixels > 0).all(1) & (pixels < (640, 480)).all(1)
    return rng.permutation(pixels[inside]), rotation


@pytest.mark.parametrize("kind", ["lattice", "stairs", "wallpaper"])
def test_one_of_many_equal_parts_is_not_called_confident(kind: str) -> None:
    """A view that ends within the structure: shifted by a period the scene looks the same."""
    rng = np.random.default_rng(3)
    for _ in range(4):
        scene = {"lattice": lambda _: lattice(14, 10), "stairs": stairs, "wallpaper": wallpaper}[kind](rng)
        pixels, _ = part_of(scene, 1.8, rng)
        assert solve(pixels, scene, CAMERA, time_limit=1.5).verdict != "confident"


def test_a_facade_with_a_door_in_view_stays_confident() -> None:
    """Its windows repeat, and the corners of the door tell where it is seen."""
    rng = np.random.default_rng(4)
    window = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.8, 0], [0, 0.8, 0.1]])
    scene = np.concatenate(
        [window + (i, 1.5 * j, 0) for i in range(6) for j in range(2)]
        + [rng.uniform((0, -1, 0), (5, -0.3, 0.5), (8, 3))]
    )
    pixels, rotation = part_of(scene, 7.0, rng)
    found = solve(pixels, scene, CAMERA)
    assert found.verdict == "confident"
    assert np.degrees(Rotation.from_matrix(found.rotation.T @ rotation).magnitude()) < 1


def test_a_facade_whose_map_ends_early_is_not_called_confident() -> None:
    """The image shows the columns 4 to 9 and the map has 1 to 6: shifted by three they agree, and so do all others."""
    rng = np.random.default_rng(6)
    window = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.8, 0], [0, 0.8, 0], [0.25, 0.9, 0.15]])
    column = np.repeat(np.arange(9), 10)
    for _ in range(4):
        scene = np.concatenate([window + (i, 1.5 * j, 0) for i in range(9) for j in range(2)])
        scene += 0.002 * rng.standard_normal(scene.shape)
        pixels, _ = part_of(scene[column >= 3], 7.0, rng)
        assert solve(pixels, scene[column < 6], CAMERA).verdict != "confident"
