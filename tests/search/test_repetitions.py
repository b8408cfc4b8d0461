"""Motions of the matched points of a pose, against fractions counted point by point."""

from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from planted import directions
from scipy.optimize import nnls

from bpnp.arrays import Array
from bpnp.search.image_statistics import Outline
from bpnp.search.problem import Problem
from bpnp.search.propose import repetitions
from bpnp.search.propose.repetitions import registered
from bpnp.search.propose.symmetries import Motions, matching_tolerance

TRANSLATION = np.array([0.0, 0.0, 9.0])
GRID = np.stack(np.meshgrid(np.arange(10.0), np.arange(5.0), [0.0], indexing="ij"), -1).reshape(-1, 3) - [4.5, 2, 0]
LEFT = GRID[:, 0] < -1


def motions_of(problem: Problem, **constants: float) -> Motions:
    """Return the motions that are registered with other values of the constants."""
    with patch.multiple(repetitions, **({"MAPPED": repetitions.MAPPED} | constants)):
        return registered(problem, np.eye(3), TRANSLATION, 1e-4)


def counted(motions: Motions, fits: NDArray[np.bool_], normals: Array | None = None) -> list[float]:
    """Return the fraction of the grid that each motion maps onto points that fit (n, n)."""
    fractions = []
    for rotation, shift, scale in zip(motions.rotation, motions.shift, motions.scale, strict=True):
        away = np.linalg.norm((scale * GRID @ rotation.T + shift)[:, None] - GRID, axis=-1)
        mapped = fits & (away < min(scale, 1) * matching_tolerance(GRID, np.arange(len(GRID)), 1e-3))
        if normals is not None:
            mapped &= normals @ rotation.T @ normals.T > 0.5
        fractions.append(mapped.any(1).mean())
    return fractions


def test_points_of_other_labels_are_not_mapped() -> None:
    """The left 20 of 50 points have one label, the others one each: no motion maps more than the 20, and the 6 others
    that lie on its axis."""
    labels = np.where(LEFT, 0, 1 + np.arange(len(GRID)))
    motions = motions_of(Problem(directions(GRID + TRANSLATION), GRID, labels2d=labels, labels3d=labels))
    assert len(motions.fraction)
    assert motions.fraction.max() <= 26 / 50
    np.testing.assert_allclose(motions.fraction, counted(motions, labels[:, None] == labels))


def test_points_with_other_normals_are_not_mapped() -> None:
    """The left 20 points face the other way than the rest."""
    normals = np.where(LEFT, 1.0, -1.0)[:, None] * [0.0, 0.0, 1.0]
    motions = motions_of(Problem(directions(GRID + TRANSLATION), GRID, normals3d=normals))
    everything = np.ones((len(GRID), len(GRID)), bool)
    np.testing.assert_allclose(motions.fraction, counted(motions, everything, normals))
    assert np.abs(motions.fraction - counted(motions, everything)).max() > 0.05


def test_the_registration_of_a_scene_follows_its_constants() -> None:
    """Two copies of 16 points and 18 others: a motion maps 16 of 50, and only a base within a copy shows it."""
    few = many = none = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        part = rng.uniform(-1, 1, (16, 3))
        points = np.concatenate([part, part + [3, 0, 0], rng.uniform(-1, 4, (18, 3)) * [1, 0.5, 0.5]])
        problem = Problem(directions(points + TRANSLATION), points)
        many += len(motions_of(problem, MAPPED=0.2).fraction) > 0
        few += len(motions_of(problem, MAPPED=0.2, BASES_OF_SCENE=1).fraction) > 0
        none += len(motions_of(problem, MAPPED=0.2, MAPPED_OF_SCENE=0.5).fraction) > 0
    assert many >= 9
    assert few <= 7
    assert none == 0


def test_image_points_among_the_projected_points_are_in_the_cone_of_their_directions() -> None:
    rng = np.random.default_rng(0)
    bearings = rng.normal(size=(60, 3))
    bearings[:45, 2] = np.abs(bearings[:45, 2])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    problem = Problem(bearings, 5 * bearings)
    seen = bearings[bearings @ problem.image.centre > 0.1] + rng.normal(0, 0.01, 3)
    inside = [nnls(seen.T, one)[1] < 1e-9 for one in bearings[problem.image.chosen]]
    assert 5 < sum(inside) < 55
    np.testing.assert_array_equal(Outline(problem.image, seen).contains(bearings[problem.image.chosen]), inside)
