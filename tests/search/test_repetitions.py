"""Scenes with a repeated structure: a pose that sees one of several equal things is never called confident."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import directions
from scipy.spatial.transform import Rotation

from bpnp import solve
from bpnp.loops.parallel import Deadline
from bpnp.search.candidates import Candidates
from bpnp.search.evidence.repetitions import decades_behind, repeated_poses
from bpnp.search.point_sets import PointSets
from bpnp.search.pool import against_repetitions
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT, Evidence
from bpnp.search.verdict import SearchResult

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


def test_after_the_deadline_repetitions_are_still_compared() -> None:
    """Nothing is annealed then."""
    scene = stairs(np.random.default_rng(9)) + (0, 0, 4)
    seen = scene[24:72]
    sets = PointSets(directions(seen), scene, floor=2e-4)
    found = replace(Candidates.unscored(np.eye(3)[None], np.zeros((1, 3)), hits=9), scale=np.array([1e-3]))
    scene_of = partial(Scene, sets, 0, DEFAULT, Deadline.after(0.0))
    sure = SearchResult(found, "confident", "", 9)
    assert against_repetitions(sure, sets, scene_of, Evidence()).verdict == "ambiguous"


def test_points_that_do_not_repeat_count_against_a_shift_and_those_that_do_not_where_the_map_ends() -> None:
    motif = np.random.default_rng(7).uniform(0, 1, (12, 3))
    scene = np.concatenate([motif + [2 * k, 0, 8] for k in range(3)])
    door = np.random.default_rng(8).uniform(0, 1, (6, 3)) + [2, 1.5, 8]

    def behind(points: Array) -> Array:
        sets = PointSets(directions(points), points)
        best = np.eye(3), np.zeros(3)
        shifts = np.eye(3)[None], np.array([[-2.0, 0, 0]])
        return decades_behind(sets, best, shifts, shifts, 1e-3)

    # Shifted by a period a third of the points has no partner: beyond the end of the map, where nothing is known.
    assert behind(scene) == pytest.approx([0], abs=0.5)
    assert behind(np.concatenate([scene, door]))[0] > 6


def test_only_different_poses_are_rivals() -> None:
    """A step of a fine lattice is no different pose, in the sense of the verdict; there are hundreds of longer ones."""
    points = lattice(16, 16) * (1 / 6) + (0, 0, 2)
    sets = PointSets(directions(points), points)
    (rotations, translations), compared = repeated_poses(sets, np.eye(3), np.zeros(3), 1e-3, Evidence())
    moved = np.linalg.norm(rotations @ sets.middle + translations - sets.middle, axis=-1)
    turned = Rotation.from_matrix(rotations).magnitude()
    assert not compared
    assert len(rotations)
    assert ((moved > 0.05 * np.linalg.norm(sets.middle)) | (turned > np.radians(2))).all()


def test_the_half_turn_of_a_lattice_is_found() -> None:
    points = lattice(5, 4) + (0, 0, 6)
    sets = PointSets(directions(points), points)
    (rotations, translations), _ = repeated_poses(sets, np.eye(3), np.zeros(3), 1e-3, Evidence())
    angles = np.degrees(Rotation.from_matrix(rotations).magnitude())
    best = int(np.argmax(angles))
    assert angles[best] == pytest.approx(180)
    moved = points @ rotations[best].T + translations[best]
    assert np.linalg.norm(moved[:, None] - points, axis=-1).min(1).max() < 1e-9


def test_scattered_points_have_none() -> None:
    points = np.random.default_rng(5).uniform(-1, 1, (200, 3)) + (0, 0, 6)
    sets = PointSets(directions(points), points)
    (rotations, _), compared = repeated_poses(sets, np.eye(3), np.zeros(3), 1e-3, Evidence())
    assert len(rotations) == 0
    assert compared
