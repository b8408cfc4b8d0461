"""Rank of views: planted locations with clumped points, and photos near one of them."""

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import SceneMap
from bpnp.arrays import Array
from bpnp.cameras import camera_from
from bpnp.maps.views import View, places_first, scores_of_views

PLACES, POINTS = 60, 900


def city(seed: int) -> SceneMap:
    """Each place a view, in the middle of clumps of points that reach beyond its image."""
    rng, points, views = np.random.default_rng(seed), [], []
    for k in range(PLACES):
        clumps = rng.uniform((-6, -6, 4), (6, 6, 8), (80, 3))
        camera = clumps[rng.integers(80, size=POINTS)] + 0.15 * rng.standard_normal((POINTS, 3))
        turn, centre = Rotation.random(rng=rng).as_matrix(), 100 * rng.standard_normal(3)
        points.append(camera @ turn + centre)
        seen = k * POINTS + np.flatnonzero(in_image(camera[:, :2] / camera[:, 2:]))
        views.append(View(f"{k}", camera_from(np.eye(3)), turn, -turn @ centre, seen.astype(np.int32)))
    every = np.concatenate(points)
    return SceneMap(every, np.arange(len(every)), np.ones(len(every), np.int32), tuple(views))


def in_image(points2d: Array) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points2d) < 0.6).all(-1))


def photo(scene: SceneMap, k: int, seed: int, turned_deg: float = 6.0) -> Array:
    """Return the keypoints of a photo near view k: half of the points there, and as many outliers."""
    rng, view = np.random.default_rng([seed, k]), scene.views[k]
    camera = scene.points3d[k * POINTS : (k + 1) * POINTS] @ view.rotation.T + view.translation
    turn = Rotation.from_rotvec(np.radians(turned_deg) * rng.standard_normal(3)).as_matrix()
    camera = camera[rng.random(POINTS) < 0.5] @ turn.T + turned_deg / 20 * rng.standard_normal(3)
    seen = camera[:, :2] / camera[:, 2:]
    seen = seen[in_image(seen)]
    return np.concatenate([seen, rng.uniform(-0.6, 0.6, seen.shape)])


def test_a_view_without_points_has_no_distance_and_gives_no_warning() -> None:
    scene = city(0)
    empty = replace(scene.views[0], points=scene.views[0].points[:0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(scene.region(empty).distance)


def test_the_nearest_view_of_a_photo_is_among_the_first() -> None:
    scene = city(0)
    ranks = []
    for k in range(0, PLACES, 5):
        scores = scores_of_views(photo(scene, k, 1), scene.pictures)
        ranks.append(int((scores > scores[k]).sum()))
    assert np.median(ranks) < PLACES / 12  # half by chance
    assert max(ranks) < PLACES / 4


def test_views_of_one_place_come_after_all_other_places() -> None:
    scene = city(0)
    twice = (*scene.views, *scene.views[:10])
    scores = np.linspace(1, 0, len(twice), dtype=np.float32)
    order = list(places_first(twice, scores, len(scene.points3d)))
    assert order == list(range(len(twice)))
    best_last = list(places_first(twice, scores[::-1].copy(), len(scene.points3d)))
    assert best_last[:10] == list(range(len(twice) - 1, len(twice) - 11, -1))
    assert sorted(best_last[-10:]) == list(range(10))
