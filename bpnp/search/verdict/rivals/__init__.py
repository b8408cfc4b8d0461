"""Rivals of the best pose: each file proposes competing poses, or objects to it, in one way."""

from collections.abc import Callable

import numpy as np

from bpnp.search.search_frame import SearchFrame
from bpnp.search.verdict.decide import Case

SceneOf = Callable[[], SearchFrame]
Rival = Callable[[Case], Case]  # the case with competing poses or an objection; the same one if there is none


def left_by(case: Case) -> tuple[int, int]:
    """Return the numbers of image points, and of scene points that face the camera, that the leader leaves."""
    seen = case.explained
    facing = np.isfinite(case.directions[:, 0])
    facing[seen.points[seen.near]] = False
    return len(case.problem.image.chosen) - int(seen.near.sum()), int(facing.sum())
