"""What a verdict asks for beside few false alarms: residuals that carry the evidence, a lead, a pose that is fixed."""

import math

import numpy as np
from numpy.typing import NDArray
from planted import directions

from bpnp.search.candidates import Candidates
from bpnp.search.point_sets import PointSets
from bpnp.search.verdict import SearchResult, judged

Array = NDArray[np.float64]
SHIFT = np.array([0.0, 0.0, 6.0])


def verdict_on(sets: PointSets, rotations: Array, translations: Array, scale: float, matched: float) -> SearchResult:
    c = len(rotations)
    nan = np.full(c, math.nan)
    return judged(
        Candidates(
            rotations, translations, -np.arange(float(c)), np.full(c, matched), np.full(c, scale),
            np.zeros(c, np.int64), nan, nan,
        ),
        sets, batches=0, exhaustive=True,
    )  # fmt: skip


def test_a_few_exact_matches_do_not_make_a_rough_alignment_precise() -> None:
    """14 of 80 points fit at 3e-4 rad, the rest only at 4e-3: no false alarm, but not where the matches say."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (80, 3))
    noise = np.where(np.arange(80) < 14, 3e-4, 4e-3)[:, None]
    exact = directions(points + SHIFT)
    for spread, scale, verdict in ((noise, 3e-4, "ambiguous"), (noise, 4e-3, "confident"), (3e-4, 3e-4, "confident")):
        rays = directions(exact + spread * rng.standard_normal((80, 3)))
        found = verdict_on(PointSets(rays, points), np.eye(3)[None], SHIFT[None], scale, 0.2)
        assert found.log10_false_alarms < -2
        assert found.verdict == verdict
        assert ("residuals far larger" in found.reason) == (verdict == "ambiguous")


def test_a_pose_that_its_points_leave_loose_is_ambiguous() -> None:
    """40 points that fill 1 / 600 rad: their tilt has an error of about a degree for a noise of 1e-4 rad."""
    rng = np.random.default_rng(1)
    points, shift = rng.uniform(-1, 1, (40, 3)), np.array([0, 0, 600.0])
    for noise, verdict in ((1e-5, "confident"), (1e-4, "ambiguous")):
        rays = directions(directions(points + shift) + noise * rng.standard_normal((40, 3)))
        found = verdict_on(PointSets(rays, points), np.eye(3)[None], shift[None], noise, 1.0)
        assert found.log10_false_alarms < -2
        assert found.verdict == verdict
        assert ("loose" in found.reason) == (verdict == "ambiguous")


def test_a_different_pose_that_fits_as_well_leaves_a_doubt() -> None:
    angle = 2 * np.pi * np.arange(8) / 8
    points = np.column_stack([np.cos(angle), np.sin(angle), np.tile([0.0, 0.5], 4)])
    sets = PointSets(directions(points + SHIFT), points)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    alone = verdict_on(sets, np.eye(3)[None], SHIFT[None], 1e-4, 1.0)
    both = verdict_on(sets, np.stack([np.eye(3), quarter]), np.stack([SHIFT, SHIFT]), 1e-4, 1.0)
    assert alone.verdict == "confident"
    assert both.verdict == "ambiguous"
    assert "90 deg away" in both.reason
