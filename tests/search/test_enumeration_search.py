"""The enumeration as a search: how it ended, and a likelihood that compares with that of annealed poses."""

from dataclasses import replace

import numpy as np
import pytest

from bpnp.search import search
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.search import Enumerated
from bpnp.search.point_sets import PointSets
from bpnp.search.settings import DEFAULT


@pytest.mark.parametrize(("exhausted", "verdict"), [(True, "confident"), (False, "ambiguous")])
def test_hypotheses_that_were_left_out_are_not_excluded(monkeypatch, exhausted: bool, verdict: str) -> None:
    """20 matches of little weight: without all hypotheses tried, a better pose may have been missed."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (20, 3))
    rays = points + (0, 0, 6) + 0.03 * rng.standard_normal((20, 3))
    sets = PointSets(rays / np.linalg.norm(rays, axis=1, keepdims=True), points)
    pose = Candidates.unscored(np.eye(3)[None], np.array([[0, 0, 6.0]]))
    found = replace(pose, matched=np.ones(1), scale=np.full(1, 0.005))
    ended = Enumerated(found, exhausted, safe=False)
    monkeypatch.setattr(search, "search_by_enumeration", lambda *_: ended)
    result = search.search_poses(sets, settings=replace(DEFAULT, least_annealed=30))
    assert -20 < result.log10_false_alarms < -2
    assert result.verdict == verdict
    assert ("missed" in result.reason) == (not exhausted)
