"""The evidence for a pose: what holds for unrelated points by law, and what a planted pose must show."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.search.false_alarms import log10_false_alarms

Array = NDArray[np.float64]
SHIFT = np.array([0.1, -0.2, 6.0])


def rays_of(camera: Array) -> Array:
    return camera / np.linalg.norm(camera, axis=1, keepdims=True)


def planted(rng: np.random.Generator, count: int, noise: float = 4e-4) -> tuple[Array, Array, Array]:
    """Bearings of `count` points with noise in radians, the points, and the rotation; the translation is SHIFT."""
    points = rng.uniform(-1, 1, (count, 3))
    rotation = Rotation.random(random_state=rng).as_matrix()
    rays = rays_of(points @ rotation.T + SHIFT)
    return rays_of(rays + noise * rng.standard_normal(rays.shape)), points, rotation


def scattered(rng: np.random.Generator, count: int, width: float) -> Array:
    return rays_of(np.column_stack([rng.uniform(-width, width, (count, 2)), np.ones(count)]))


@pytest.mark.parametrize(("count", "least"), [(7, -3), (12, -10), (100, -150)])
def test_a_planted_pose_is_no_coincidence(count: int, least: float) -> None:
    rng = np.random.default_rng(count)
    for _ in range(10):
        rays, points, rotation = planted(rng, count)
        assert log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4) < least


def test_four_points_prove_nothing() -> None:
    """Three of them fix the pose, and there are 2 * 24 * 24 / 6 ways to choose these: one more is to be expected."""
    rng = np.random.default_rng(0)
    values = [log10_false_alarms(*planted(rng, 4, 2e-3), SHIFT, floor=1e-3) for _ in range(20)]
    assert min(values) > -1


@pytest.mark.parametrize("count", [5, 20, 200])
def test_the_bound_of_markov_holds_for_unrelated_points(count: int) -> None:
    """A pose that was not chosen by the points has a product above b in at most one of b cases."""
    rng = np.random.default_rng(count)
    log10_tests = math.log10(2 * math.comb(count, 3) ** 2 * 6)
    products = []
    for _ in range(400):
        seen = scattered(rng, count, 0.4) * rng.uniform(4, 8, (count, 1))
        turn = Rotation.random(random_state=rng).as_matrix()
        product = log10_tests - log10_false_alarms(scattered(rng, count, 0.25), seen @ turn, turn, np.zeros(3))
        products.append(product)
    for bound in (0.5, 1, 2):
        assert np.mean(np.array(products) > bound) <= 10**-bound


def test_it_does_not_depend_on_the_frame_or_unit_of_the_scene() -> None:
    rng = np.random.default_rng(1)
    rays, points, rotation = planted(rng, 30)
    turn, shift, scale = Rotation.random(random_state=rng).as_matrix(), np.array([5.0, -3, 2]), 40.0
    moved = scale * (points @ turn.T + shift)
    other = rotation @ turn.T
    value = log10_false_alarms(rays, moved, other, scale * (SHIFT - other @ shift))
    assert value == pytest.approx(log10_false_alarms(rays, points, rotation, SHIFT), abs=1e-6)


def test_keypoints_in_one_place_are_one_observation() -> None:
    rng = np.random.default_rng(2)
    rays, points, rotation = planted(rng, 10)
    once = log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4)
    copies = log10_false_alarms(np.tile(rays, (5, 1)), points, rotation, SHIFT, floor=2e-4)
    assert copies > once - 1


def test_labels_and_normals_exclude_partners() -> None:
    rng = np.random.default_rng(3)
    rays, points, rotation = planted(rng, 12)
    free = log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4)
    own = np.arange(12) % 3
    right = log10_false_alarms(rays, points, rotation, SHIFT, labels2d=own, labels3d=own, floor=2e-4)
    wrong = log10_false_alarms(rays, points, rotation, SHIFT, labels2d=own, labels3d=(own + 1) % 3, floor=2e-4)
    assert right < free < 0 < wrong
    anything = np.full(12, -1)
    same = log10_false_alarms(rays, points, rotation, SHIFT, labels2d=anything, labels3d=own, floor=2e-4)
    assert same == pytest.approx(free)
    away = rays_of(points @ rotation.T + SHIFT) @ rotation
    facing = log10_false_alarms(rays, points, rotation, SHIFT, normals3d=-away, floor=2e-4)
    assert facing == pytest.approx(free)
    assert log10_false_alarms(rays, points, rotation, SHIFT, normals3d=away, floor=2e-4) > 0


def test_less_that_is_tried_leaves_less_to_chance() -> None:
    rng = np.random.default_rng(4)
    rays, points, rotation = planted(rng, 6)
    free = log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4)
    assert log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4, log10_share=-2.0) == pytest.approx(free - 2)
    assert log10_false_alarms(rays, points, rotation, SHIFT, floor=2e-4, fixing_pairs=2) < free - 1
    assert log10_false_alarms(rays, points, rotation, SHIFT, floor=5e-3) > free + 1
