"""The pose of a photo in a map, from its keypoints without descriptors."""

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
from bpnp.maps.regions import Region, covering_regions, regions_of_views
from bpnp.maps.views import ViewedPoints
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.solving.arguments import checked_prior, source_from
from bpnp.solving.problem import problem_from
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options, solutions_of

MOST_KEYPOINTS = (
    2048  # the strongest; of the 2,000 largest SIFT keypoints half have a point, of the next 2,000 an eighth
)
# The view's pose is the one to look near, not the best pose of a view that was tried in vain.
BRIEF = replace(DEFAULT, max_batches=1, beside_poses=0, anywhere=())  # one batch that is looked up
LONGER = replace(DEFAULT, max_batches=8, beside_poses=0)  # four of each kind, as many as must find a doubtful pose
PROMISING = 3  # views that are tried longer if none is confident
RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


def localize(
    scene: ViewedPoints,
    keypoints: Any,
    camera: Any,
    *,
    views: Iterable[str] | None = None,
    scores: Any = None,
    prior: PosePrior | None = None,
    solver: str | Path | nn.Module = "auto",
    seed: int = 0,
    time_limit: float | int | None = None,
) -> Solution:
    """The pose of a photo in a map, from its keypoints alone.

    keypoints: (m, 2) pixels. camera: as for `bpnp.solve`.
    views: names of views of the map that may show the same place, best first, from any image retrieval (`read_pairs`
        reads hloc's): the points that any of them sees are used near each; None to try the points of one view of the
        whole map after the other, those first that together see most of it.
    scores: (m,) strength of the keypoints; the strongest are used first.
    prior: what is known of the photo's pose; None to expect it near that of the view that is tried.
    solver: as for `bpnp.solve`; a network that expects the points in the camera of a view gets them in that of the view
        that is tried, or of the prior.
    time_limit: seconds for all views together, after which no search begins; None for no limit.

    Poses near each view are tried briefly until one is confident, then the most promising ones longer; else the pose
    with the fewest false alarms is returned. `solution.view` is the view near which it was found.
    `solution.matches` (k, 2): place of a keypoint, and id of a point in the map's COLMAP model; `solution.points3d`
    with the ids `solution.point_ids` are the points that were tried.
    Raises ValueError for unknown views and for input that `bpnp.solve` refuses.
    """
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
    regions = covering_regions(scene) if views is None else regions_of_views(scene, views)
    found: list[tuple[Region, Solution]] = []
    chosen, tries, over = regions, 0, False
    for settings in (BRIEF, LONGER):
        for region in chosen:
            left = None if time_limit is None else time_limit - (time.monotonic() - start)
            over = over or (bool(found) and left is not None and left <= 0)
            if over:
                break
            tries += 1
            limit = None if left is None else max(left, 1e-3)
            asks = solver == "auto" and settings is LONGER  # not of every view of the map
            options = Options(module, asks, seed=seed, time_limit=limit, settings=settings)
            found.append((region, counted(_tried(scene, region, used, camera, prior, options), tries)))
            over = found[-1][1].verdict == "confident"
        found.sort(key=lambda item: _rank(item[1]), reverse=True)
        chosen = [region for region, _ in found[:PROMISING]]
    if not found:
        raise ValueError("expected a map with views that see 4 or more points, got none")
    best = found[0][1]
    if strongest is not None:
        best = _with_all_keypoints(best, strongest, keypoints, camera)
    return replace(best, seconds=time.monotonic() - start)


def _tried(
    scene: ViewedPoints, region: Region, keypoints: Any, camera: Any, prior: PosePrior | None, options: Options
) -> Solution:
    """The best pose of the photo among the points of one region."""
    known = checked_prior(region.prior(scene) if prior is None else prior)
    problem = problem_from(
        keypoints, scene.points3d[region.points], camera_from(camera), normals3d=scene.cones.axes[region.points],
        cosines3d=scene.cones.cosines[region.points], prior=known,
    )  # fmt: skip
    found = solutions_of({0: problem}, options)[0]
    ids = scene.point_ids[region.points]
    matches = np.column_stack([found.matches[:, 0], ids[found.matches[:, 1]]])
    return replace(found, matches=matches, view=region.view.name, point_ids=ids)


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
