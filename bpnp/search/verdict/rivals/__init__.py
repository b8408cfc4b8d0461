"""Rivals of the best pose: each file proposes competing poses, or objects to it, in one way."""

from collections.abc import Callable

import numpy as np

from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.search_frame import SearchFrame
from bpnp.search.verdict.competitors import Partners, partners
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.false_alarms import directions_of

SceneOf = Callable[[], SearchFrame]
Rival = Callable[[Case], Case]  # the case with competing poses or an objection; the same one if there is none


def explained(case: Case) -> Partners:
    """Return the scene points that the leader shows at the image points, within the match radius."""
    problem = case.problem
    scale = max(case.residual, problem.match_radius / MATCH_REACH)
    return partners(MATCH_REACH, problem, *case.pose, scale)


def left_by(case: Case) -> tuple[int, int]:
    """Return the numbers of image points, and of scene points that face the camera, that the leader leaves."""
    seen, problem = explained(case), case.problem
    facing = np.isfinite(directions_of(problem, *case.pose)[:, 0])
    facing[seen.points[seen.near]] = False
    return len(problem.image.chosen) - int(seen.near.sum()), int(facing.sum())
