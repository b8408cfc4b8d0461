"""Merging of poses: which are kept, and in how many batches each was found."""

from dataclasses import replace

import numpy as np
import pytest
from planted import directions
from scipy.spatial.transform import Rotation

from bpnp.search.candidates import Candidates, best_distinct, merged
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (30, 2)), np.ones(30)])
    rays = directions(rays)
    return Scene(PointSets(rays, rng.normal(size=(30, 3))), 0, DEFAULT)


def poses(degrees: list[float], score: list[float], hits: list[int]) -> Candidates:
    """Poses turned about one axis, at one place."""
    rotation = Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 0, 1]).as_matrix().astype(np.float32)
    found = Candidates.unscored(rotation, np.tile(np.float32([0, 0, 5]), (len(degrees), 1)))
    return replace(found, score=np.float32(score), hits=np.array(hits))


def test_a_pose_that_a_fresh_and_a_shaken_start_reach_counts_as_found(scene: Scene) -> None:
    """The shaken start has no hits, but the better score."""
    found = best_distinct(poses([0, 1, 40], [2.0, 1.9, 1.0], [0, 1, 0]), scene, 8)
    assert found.hits.tolist() == [1, 0]
    assert found.score.tolist() == [2.0, 1.0]


def test_starts_that_end_at_one_pose_are_its_hits(scene: Scene) -> None:
    batches = [poses([0, 1], [2.0, 1.9], [1, 1]), poses([0.5, 60], [2.1, 1.0], [1, 1]), poses([1], [1.0], [3])]
    found = merged(batches, scene)
    assert found.hits.tolist() == [6, 1]
    assert found.score.tolist() == [np.float32(2.1), 1.0]


def test_a_pose_that_exceeds_chance_is_kept_before_likelier_ones(scene: Scene) -> None:
    alarms = np.array([-3.0, 5.0, -8.0, np.nan])
    found = replace(poses([0, 30, 60, 90], [1.0, 2.0, 1.5, 1.9], [1] * 4), log10_false_alarms=alarms)
    assert best_distinct(found, scene, 4).score.tolist() == [1.5, 1.0, 2.0, np.float32(1.9)]


def test_a_pose_without_a_score_is_left_out(scene: Scene) -> None:
    assert best_distinct(poses([0, 90], [-np.inf, 1.0], [1, 1]), scene, 8).score.tolist() == [1.0]
    assert len(best_distinct(Candidates.none(), scene, 8)) == 0


def test_a_narrow_view_hardly_tells_poses_at_different_distances_apart() -> None:
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-1e-3, 1e-3, (30, 2)), np.ones(30)])
    narrow = Scene(PointSets(directions(rays), rng.normal(size=(30, 3))), 0, DEFAULT)
    same = poses([0, 0], [2.0, 1.0], [1, 1])
    same.translation[:, 2] = [1000, 1001]
    assert len(best_distinct(same, narrow, 8)) == 1
    same.translation[:, 2], same.translation[1, 0] = 1000, 1
    assert len(best_distinct(same, narrow, 8)) == 2
