"""The enumeration as a search: how it ended, and a likelihood that compares with that of annealed poses."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between, directions
from scipy.spatial.transform import Rotation

from bpnp.loops.parallel import NEVER, Deadline
from bpnp.search import search
from bpnp.search.annealing import anneal_on_points
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.search import Enumerated, search_by_enumeration
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior

Array = NDArray[np.float64]


def scene(seed: int, seen: int = 30, background: int = 12, **known: Any) -> tuple[PointSets, Array, Array]:
    """Points on a ball, half of which face the camera; of those `seen` at most, and other directions."""
    rng = np.random.default_rng(seed)
    points = directions(rng.standard_normal((60, 3)))
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.2, -0.1, 6.0])
    camera = points @ rotation.T + translation
    facing = np.flatnonzero((camera * (points @ rotation.T)).sum(-1) < -1.5)[:seen]
    rays = directions(camera[facing]) + 3e-4 * rng.standard_normal((len(facing), 3))
    others = directions(np.column_stack([rng.uniform(-0.2, 0.2, (background, 2)), np.ones(background)]))
    return PointSets(directions(np.concatenate([rays, others])), points, **known), rotation, translation


def annotations(kind: str, sets: PointSets) -> dict[str, Any]:
    rng, m, n = np.random.default_rng(1), len(sets.bearings), len(sets.points3d)
    return {
        "bare": {},
        "normals": {"normals3d": sets.points3d},
        "labels": {"labels2d": rng.integers(-1, 2, m), "labels3d": rng.integers(-1, 2, n)},
        "scores": {"scores2d": rng.uniform(0.2, 1, m), "scores3d": rng.uniform(0.2, 1, n)},
    }[kind]


@pytest.mark.parametrize("kind", ["bare", "normals", "labels", "scores"])
def test_enumerated_and_annealed_poses_have_one_likelihood(kind: str) -> None:
    sets, _, _ = scene(0)
    sets = replace(sets, **annotations(kind, sets))
    enumerated = search_by_enumeration(sets, NEVER, DEFAULT).candidates
    entered = Scene(sets, 0, DEFAULT)
    start = Candidates.unscored(*entered.enter(enumerated.rotation[:1], enumerated.translation[:1]))
    annealed = anneal_on_points(entered, start, 3 * float(enumerated.scale[0]), every=True)
    # The annealing looks for the scale of the highest likelihood; both stand within a step of it.
    assert enumerated.score[0] == pytest.approx(annealed.score[0], abs=0.15)


def test_an_enumeration_tells_how_it_ended() -> None:
    sets, rotation, _ = scene(1)
    sure = search_by_enumeration(sets, NEVER, DEFAULT)
    assert degrees_between(sure.candidates.rotation[0], rotation) < 1
    assert (sure.exhausted, sure.safe, sure.interrupted) == (False, True, False)
    late = search_by_enumeration(replace(sets, bearings=sets.bearings[20:]), Deadline.after(0.0), DEFAULT)
    assert (late.exhausted, late.safe, late.interrupted) == (False, False, True)
    rng = np.random.default_rng(0)
    tiny = PointSets(directions(rng.normal(0, 0.1, (5, 3)) + [0, 0, 1]), rng.standard_normal((5, 3)))
    every = search_by_enumeration(tiny, NEVER, DEFAULT)
    assert (every.exhausted, every.safe, every.interrupted) == (True, False, False)
    # Sets of three of either side, in six orders; a triangle without a normal is seen from either side.
    assert every.solved == 2 * math.comb(5, 3) ** 2 * 6


def test_hypotheses_near_a_wrong_prior_count_too() -> None:
    sets, rotation, translation = scene(2)
    off = Rotation.from_rotvec([0.9, 0, 0]).as_matrix() @ rotation
    found = search_by_enumeration(replace(sets, prior=PosePrior(off, translation, 4.0, 0.3)), NEVER, DEFAULT)
    assert found.solved > 0
    assert degrees_between(found.candidates.rotation[0], rotation) < 1


@pytest.mark.parametrize(("exhausted", "verdict"), [(True, "confident"), (False, "ambiguous")])
def test_hypotheses_that_were_left_out_are_not_excluded(monkeypatch, exhausted: bool, verdict: str) -> None:
    """20 matches of little weight: without all hypotheses tried, a better pose may have been missed."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (20, 3))
    rays = points + (0, 0, 6) + 0.03 * rng.standard_normal((20, 3))
    sets = PointSets(rays / np.linalg.norm(rays, axis=1, keepdims=True), points)
    pose = Candidates.unscored(np.eye(3)[None], np.array([[0, 0, 6.0]]))
    found = replace(pose, matched=np.ones(1), scale=np.full(1, 0.005))
    ended = Enumerated(found, 50_000, exhausted, safe=False, interrupted=False)
    monkeypatch.setattr(search, "search_by_enumeration", lambda *_: ended)
    result = search.search_poses(sets, settings=replace(DEFAULT, least_annealed=30))
    assert -20 < result.log10_false_alarms < -2
    assert result.verdict == verdict
    assert ("missed" in result.reason) == (not exhausted)
