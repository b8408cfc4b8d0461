"""Normals, labels and scores in the large search: what they weigh, and planted poses that only they make findable."""

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between, directions, seen
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.search.find import search_poses
from bpnp.search.kernels.sides import kernel_sides, side_of
from bpnp.search.problem import Problem, faces
from bpnp.search.settings import DEFAULT

TRANSLATION = np.array([0.1, -0.1, 5.0])
NOISE = 1e-3


def rays(image: Array) -> Array:
    homogeneous = np.column_stack([image, np.ones(len(image))])
    return np.asarray(directions(homogeneous))


def wall(seed: int, side: int = 250, matches: int = 120, background: int = 200) -> tuple[Problem, Array]:
    """Return a wall with normals and points on both faces, one of them visible, and its rotation."""
    rng = np.random.default_rng(seed)
    rotation, facing = Rotation.random(rng=rng).as_matrix(), np.repeat([-1.0, 1.0], side)
    points = np.column_stack([rng.uniform(-1, 1, (2 * side, 2)), facing * rng.uniform(0.1, 0.3, 2 * side)])
    normals = np.column_stack([np.zeros((2 * side, 2)), facing])
    visible = np.flatnonzero(faces(normals, None, points @ rotation.T + TRANSLATION, rotation))
    image = seen(points[visible[:matches]], rotation, TRANSLATION) + NOISE * rng.normal(size=(matches, 2))
    image = np.r_[image, rng.uniform(image.min(0), image.max(0), (background, 2))]
    return Problem.of(rays(rng.permutation(image)), points, normals3d=normals), rotation


def cluttered(seed: int, outliers: int, shared: int = 100) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return bearings and points, the first `shared` of them pairs, the rotation, and the index of each point."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    points = rng.normal(size=(shared + outliers, 3)) * [0.8, 0.8, 0.3]
    image = seen(points[:shared], rotation, TRANSLATION) + NOISE * rng.normal(size=(shared, 2))
    image = np.r_[image, image.std() * rng.normal(size=(outliers, 2))]
    return rays(image), points, rotation, np.arange(shared + outliers)


def labelled(seed: int) -> tuple[Problem, Array]:
    """100 pairs of two labels; an eighth of the 400 outliers a side has one of these, the rest one of its own."""
    bearings, points, rotation, number = cluttered(seed, 400)
    outlier = number >= 100
    labels2d = np.where(outlier, np.where(number % 8 == 0, 0, 3), number % 2)
    labels3d = np.where(outlier, np.where(number % 8 == 0, 0, 2), number % 2)
    return Problem.of(bearings, points, labels2d=labels2d, labels3d=labels3d), rotation


def scored(seed: int) -> tuple[Problem, Array]:
    """100 pairs among 300 outliers a side; four fifths of the pairs' points and a tenth of the others are strong."""
    bearings, points, rotation, number = cluttered(seed, 300)
    rng = np.random.default_rng(seed + 100)
    scores2d, scores3d = (np.where(rng.random(400) < np.where(number < 100, 0.8, 0.1), 0.8, 0.1) for _ in range(2))
    return Problem.of(bearings, points, scores2d=scores2d, scores3d=scores3d), rotation


@pytest.mark.slow
@pytest.mark.parametrize(("known", "seed"), [(wall, 1), (labelled, 0), (scored, 0)])
def test_annotations_of_the_points_find_a_pose_that_the_points_alone_do_not(known, seed: int) -> None:
    """In as many batches of starts, before any other source is asked."""
    problem, rotation = known(seed)
    informed = search_poses(problem, settings=DEFAULT.limited(9))
    assert degrees_between(informed.best[0], rotation) < 0.5
    assert search_poses(problem).verdict == "confident"
    blind = search_poses(Problem.of(problem.bearings, problem.points3d), settings=DEFAULT.limited(9))
    assert degrees_between(blind.best[0], rotation) > 5
    assert blind.verdict == "failed"


@pytest.mark.parametrize("likely", [0, 12, 300])
def test_clusters_keep_the_weight_of_few_likely_points_among_many_impossible_ones(likely: int) -> None:
    """A score below the smallest float32 number is a weight of 0."""
    rng = np.random.default_rng(likely)
    count, points = 20_000, rng.uniform(-1, 1, (20_000, 3)).astype(np.float32)
    scores = np.where(np.arange(count) < likely, 1.0, 1e-50)
    side = side_of(points, scores, np.zeros(count, np.int64), None, np.arange(count))
    clusters = side.clustered(64, rng)
    assert clusters.weights.sum() == likely
    if likely:
        mean = clusters.weights @ clusters.points / likely
        np.testing.assert_allclose(mean, points[:likely].mean(0), atol=0.01)
    bearings = side.at(slice(0, 40))._replace(weights=np.ones(40, np.float32))
    seen, scene = kernel_sides(bearings, clusters)
    assert scene.b.sum() == likely
    assert np.isfinite(seen.odds).all()
