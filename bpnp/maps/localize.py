"""The pose of a photo from its keypoints without descriptors, near one view of a map after the other."""

import math
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from bpnp.cameras import camera_from
from bpnp.maps.views import Region
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.solving.arguments import checked_prior, source_from
from bpnp.solving.problem import problem_from
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options, solutions_of

MOST_KEYPOINTS = (
    2048  # the strongest; half of the 2,000 largest SIFT keypoints have a point, an eighth of the next 2,000
)
# The view's pose is the one to look near, not the best pose of a view that was tried in vain.
BRIEF = replace(DEFAULT, max_batches=1, beside_poses=0, anywhere=())  # one batch that is looked up
LONGER = replace(DEFAULT, max_batches=8, beside_poses=0)  # four of each kind, as many as must find a doubtful pose
PROMISING = 3  # views that are tried longer if none is confident
RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


def localize(
    regions: Iterable[Region],
    keypoints: Any,
    camera: Any,
    *,
    scores: Any = None,
    prior: PosePrior | None = None,
    solver: str | Path | nn.Module = "auto",
    seed: int = 0,
    time_limit: float | int | None = None,
) -> Solution:
    """The best pose of a photo near any of these regions of a map; arguments and answer as `SceneMap.localize`."""
    start = time.monotonic()
    if time_limit is not None and not 0 < time_limit < math.inf:
        raise ValueError(f"expected a positive `time_limit`, got {time_limit}")
    if scores is not None and np.shape(scores) != np.shape(keypoints)[:1]:
        raise ValueError(
            f"expected `scores` of shape {np.shape(keypoints)[:1]}, one a keypoint, got {np.shape(scores)}"
        )
    strongest = None if scores is None else np.sort(np.argsort(-np.asarray(scores), kind="stable")[:MOST_KEYPOINTS])
    used = keypoints if strongest is None else np.asarray(keypoints)[strongest]
    module = source_from(solver)
    best: list[tuple[Region, Solution]] = []  # the most promising first
    tries, over = 0, False
    for settings in (BRIEF, LONGER):
        for region in regions:
            remaining = None if time_limit is None else time_limit - (time.monotonic() - start)
            over = over or (bool(best) and remaining is not None and remaining <= 0)
            if over:
                break
            tries += 1
            limit = None if remaining is None else max(remaining, 1e-3)
            asks = solver == "auto" and settings is LONGER  # not of every view of the map
            options = Options(module, asks, seed=seed, time_limit=limit, settings=settings)
            solution = counted(_tried(region, used, camera, prior, options), tries)
            best = sorted([*best, (region, solution)], key=lambda item: _rank(item[1]), reverse=True)[:PROMISING]
            over = solution.verdict == "confident"
        regions = [region for region, _ in best]
    if not best:
        raise ValueError("expected a map with views that see 4 or more points, got none")
    solution = best[0][1]
    if strongest is not None:
        solution = _with_all_keypoints(solution, strongest, keypoints, camera)
    return replace(solution, seconds=time.monotonic() - start)


def _tried(region: Region, keypoints: Any, camera: Any, prior: PosePrior | None, options: Options) -> Solution:
    """The best pose of the photo among the points of one region."""
    problem = problem_from(
        keypoints,
        region.points3d,
        camera_from(camera),
        normals3d=region.cones.axes,
        cosines3d=region.cones.cosines,
        prior=checked_prior(region.prior() if prior is None else prior),
    )
    solution = solutions_of({0: problem}, options)[0]
    matches = np.column_stack([solution.matches[:, 0], region.point_ids[solution.matches[:, 1]]])
    return replace(solution, matches=matches, view=region.view.name, point_ids=region.point_ids)


def counted(solution: Solution, tries: int) -> Solution:
    """The solution with the false alarms of so many views: each is as many tests again."""
    alarms, most = solution.log10_false_alarms + math.log10(tries), DEFAULT.evidence.false_alarms
    if solution.verdict != "confident" or alarms <= most:
        return replace(solution, log10_false_alarms=alarms)
    reason = f"after {tries} views, 10^{alarms:.1f} poses are expected to fit unrelated points as well"
    return replace(solution, log10_false_alarms=alarms, verdict="ambiguous", reason=reason)


def _with_all_keypoints(solution: Solution, used: NDArray[np.int64], keypoints: Any, camera: Any) -> Solution:
    """The solution of some keypoints with its matches and points among all of them."""
    matches = np.column_stack([used[solution.matches[:, 0]], solution.matches[:, 1]])
    lens = camera_from(camera)
    return replace(solution, matches=matches, points2d=lens.normalise(np.asarray(keypoints, np.float64)))


def _rank(solution: Solution) -> tuple[int, float]:
    """Confident before ambiguous before failed; then the fewest false alarms."""
    return RANKS[solution.verdict], -solution.log10_false_alarms
