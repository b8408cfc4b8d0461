"""Normals, labels and scores in the large search: what they weigh, and planted poses that only they make findable."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

from bpnp.search.annealing import anneal_on_points
from bpnp.search.candidates import Candidates
from bpnp.search.kernels.sides import visible_weights
from bpnp.search.point_sets import PointSets, faces
from bpnp.search.scene import Scene
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT

Array = NDArray[np.float64]
TRANSLATION = np.array([0.1, -0.1, 5.0])
NOISE = 1e-3


def rays(image: Array) -> Array:
    homogeneous = np.column_stack([image, np.ones(len(image))])
    return np.asarray(directions(homogeneous))


def wall(seed: int, side: int = 250, seen: int = 120, background: int = 200) -> tuple[PointSets, Array]:
    """A wall with normals and other points on either face, of which the camera sees one; its rotation."""
    rng = np.random.default_rng(seed)
    rotation, facing = Rotation.random(rng=rng).as_matrix(), np.repeat([-1.0, 1.0], side)
    points = np.column_stack([rng.uniform(-1, 1, (2 * side, 2)), facing * rng.uniform(0.1, 0.3, 2 * side)])
    normals = np.column_stack([np.zeros((2 * side, 2)), facing])
    visible = np.flatnonzero(faces(normals, None, points @ rotation.T + TRANSLATION, rotation))
    camera = points[visible[:seen]] @ rotation.T + TRANSLATION
    image = camera[:, :2] / camera[:, 2:] + NOISE * rng.normal(size=(seen, 2))
    image = np.r_[image, rng.uniform(image.min(0), image.max(0), (background, 2))]
    return PointSets(rays(rng.permutation(image)), points, normals3d=normals), rotation


def cluttered(seed: int, outliers: int, shared: int = 100) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Bearings and points, of which the first `shared` are pairs, the rotation, and the number of each point."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    points = rng.normal(size=(shared + outliers, 3)) * [0.8, 0.8, 0.3]
    camera = points[:shared] @ rotation.T + TRANSLATION
    image = camera[:, :2] / camera[:, 2:] + NOISE * rng.normal(size=(shared, 2))
    image = np.r_[image, image.std() * rng.normal(size=(outliers, 2))]
    return rays(image), points, rotation, np.arange(shared + outliers)


def labelled(seed: int) -> tuple[PointSets, Array]:
    """100 pairs of two labels; an eighth of the 400 outliers a side has one of these, the rest one of its own."""
    bearings, points, rotation, number = cluttered(seed, 400)
    outlier = number >= 100
    labels2d = np.where(outlier, np.where(number % 8 == 0, 0, 3), number % 2)
    labels3d = np.where(outlier, np.where(number % 8 == 0, 0, 2), number % 2)
    return PointSets(bearings, points, labels2d=labels2d, labels3d=labels3d), rotation


def scored(seed: int) -> tuple[PointSets, Array]:
    """100 pairs among 300 outliers a side; four fifths of the pairs' points and a tenth of the others are strong."""
    bearings, points, rotation, number = cluttered(seed, 300)
    rng = np.random.default_rng(seed + 100)
    scores2d, scores3d = (np.where(rng.random(400) < np.where(number < 100, 0.8, 0.1), 0.8, 0.1) for _ in range(2))
    return PointSets(bearings, points, scores2d=scores2d, scores3d=scores3d), rotation


@pytest.mark.parametrize(("known", "seed"), [(wall, 1), (labelled, 0), (scored, 0)])
def test_what_is_known_of_the_points_finds_a_pose_that_the_points_alone_do_not(known, seed: int) -> None:
    """In as many batches of starts, before any other source is asked."""
    sets, rotation = known(seed)
    informed = search_poses(sets, settings=DEFAULT.limited(9))
    assert degrees_between(informed.best[0], rotation) < 0.5
    assert search_poses(sets).verdict == "confident"
    blind = search_poses(PointSets(sets.bearings, sets.points3d), settings=DEFAULT.limited(9))
    assert degrees_between(blind.best[0], rotation) > 5
    assert blind.verdict == "failed"


@pytest.mark.parametrize("known", [wall, labelled, scored])
def test_the_order_of_the_points_does_not_matter(known) -> None:
    sets, rotation = known(2)
    rng = np.random.default_rng(0)
    i, j = rng.permutation(len(sets.bearings)), rng.permutation(len(sets.points3d))
    of_image = {name: getattr(sets, name) for name in ("labels2d", "scores2d")}
    of_scene = {name: getattr(sets, name) for name in ("normals3d", "labels3d", "scores3d")}
    mixed = PointSets(
        sets.bearings[i], sets.points3d[j],
        **{name: None if values is None else values[i] for name, values in of_image.items()},
        **{name: None if values is None else values[j] for name, values in of_scene.items()},
    )  # fmt: skip
    for found in (search_poses(sets), search_poses(mixed)):
        assert degrees_between(found.best[0], rotation) < 0.5


def test_nothing_known_is_what_equal_scores_and_one_label_say() -> None:
    bearings, points, rotation, number = cluttered(3, 40)
    one = np.zeros_like(number)
    bare = search_poses(PointSets(bearings, points))
    assert degrees_between(bare.best[0], rotation) < 0.5
    said = search_poses(
        PointSets(bearings, points, scores2d=np.ones(140), scores3d=np.ones(140), labels2d=one, labels3d=one)
    )
    np.testing.assert_allclose(said.best[0], bare.best[0], atol=1e-4)
    assert said.candidates.score[0] == pytest.approx(bare.candidates.score[0], abs=1e-3)
    assert said.candidates.matched[0] == pytest.approx(bare.candidates.matched[0], abs=1e-3)


def test_a_point_is_seen_fully_within_its_cone_and_hardly_behind_it(entry: Any) -> None:
    sets, rotation = wall(4, side=60, seen=50)
    scene = Scene(replace(sets, cosines3d=np.full(120, 0.3)), 0, DEFAULT)
    pose = scene.enter(rotation, TRANSLATION)
    weight = np.empty(120, np.float32)
    entry(visible_weights)(scene.sides()[1], *pose, weight)
    camera = sets.points3d @ rotation.T + TRANSLATION
    cosine = -((sets.normals3d @ rotation.T) * camera).sum(1) / np.linalg.norm(camera, axis=1)
    softness = DEFAULT.facing.softness
    expected = np.clip(0.5 + (cosine - 0.3) / (2 * softness), DEFAULT.facing.unseen, 1)
    np.testing.assert_allclose(np.sort(weight), np.sort(expected), atol=1e-4)
    assert weight.max() == 1
    assert weight.min() == np.float32(DEFAULT.facing.unseen)


def test_clusters_keep_labels_weights_and_the_sides_of_a_thin_wall() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (2000, 3)) * [1, 1, 1e-3]
    normals = np.where(rng.random((2000, 1)) < 0.5, 1.0, -1.0) * [0, 0, 1]
    scores, labels = rng.uniform(0.1, 1, 2000), rng.integers(-1, 3, 2000)
    sets = PointSets(
        rays(rng.uniform(-0.3, 0.3, (500, 2))), points, normals, rng.integers(-1, 3, 500), labels, None, None, scores
    )
    ((image, seen),) = Scene(sets, 0, DEFAULT).clusters([64])
    assert max(len(image.label), len(seen.label)) <= 68
    slope = 1 / (2 * DEFAULT.facing.softness)
    assert (np.abs(seen.cones[2]) > 0.99 * slope).mean() > 0.9  # hardly a cluster has points of both faces
    for label in range(-1, 3):
        total = scores[labels == label].sum()
        assert seen.b[seen.label == label].sum() == pytest.approx(total, rel=0.15)  # of a sample
    # The blocks are the pairs of one label and those of which one is free, each of them once.
    fitting = np.zeros((len(image.label), len(seen.label)), int)
    for first, last, start, stop in seen.blocks:
        fitting[first:last, start:stop] += 1
    one, other = image.label[:, None], seen.label
    np.testing.assert_array_equal(fitting, (one == other) | (one < 0) | (other < 0))


def test_a_point_of_another_label_neither_matches_nor_pulls() -> None:
    bearings, points, rotation, number = cluttered(6, 0)
    sets = PointSets(bearings, points, labels2d=number, labels3d=(number + 50) % 100)
    scene = Scene(sets, 0, DEFAULT)
    rotations, translations = (values[None] for values in scene.enter(rotation, TRANSLATION))
    right = Candidates.unscored(rotations, translations)
    found = anneal_on_points(scene, right, 0.02 * scene.spread, every=True)
    assert found.matched[0] < 0.05
