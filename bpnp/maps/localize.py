"""The pose of a photo in a map, from its keypoints without descriptors."""

import math
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from bpnp.maps.regions import Region, covering_regions, regions_of_views
from bpnp.maps.views import ViewedPoints
from bpnp.search.starts import PosePrior
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve

RANKS = {"failed": 0, "ambiguous": 1, "confident": 2}


def localize(
    scene: ViewedPoints,
    keypoints: Any,
    camera: Any,
    *,
    views: Iterable[str] | None = None,
    scores: Any = None,
    prior: PosePrior | None = None,
    seed: int = 0,
    time_limit: float | int | None = None,
) -> Solution:
    """The pose of a photo in a map, from its keypoints alone.

    keypoints: (m, 2) pixels. camera: as for `bpnp.solve`.
    views: names of views of the map that may show the same place, best first, from any image retrieval (`read_pairs`
        reads hloc's); None to try views of the whole map, those first that together see most of it.
    scores: (m,) strength of the keypoints; the strongest are used first.
    prior: what is known of the photo's pose; None to expect it near that of the view that is tried.
    time_limit: seconds for all views together, after which no search begins; None for no limit.

    Each view's points are tried until a pose is confident; else the likeliest of all is returned. `solution.view` is
    the view whose points gave the pose. `solution.matches` (k, 2): place of a keypoint, and id of a point in the map's
    COLMAP model; `solution.points3d` with the ids `solution.point_ids` are the points that were tried.
    Raises ValueError for unknown views and for input that `bpnp.solve` refuses.
    """
    start = time.monotonic()
    if time_limit is not None and not 0 < time_limit < math.inf:
        raise ValueError(f"expected a positive `time_limit`, got {time_limit}")
    if scores is not None and np.shape(scores) != np.shape(keypoints)[:1]:
        raise ValueError(
            f"expected `scores` of shape {np.shape(keypoints)[:1]}, one a keypoint, got {np.shape(scores)}"
        )
    regions = covering_regions(scene) if views is None else regions_of_views(scene, views)
    best: Solution | None = None
    for region in regions:
        left = None if time_limit is None else time_limit - (time.monotonic() - start)
        if best is not None and left is not None and left <= 0:
            break
        found = _tried(scene, region, keypoints, camera, prior, seed, None if left is None else max(left, 1e-3))
        best = found if best is None else max(best, found, key=_rank)
        if best.verdict == "confident":
            break
    if best is None:
        raise ValueError("expected a map with views that see 4 or more points, got none")
    return replace(best, seconds=time.monotonic() - start)


def _tried(
    scene: ViewedPoints,
    region: Region,
    keypoints: Any,
    camera: Any,
    prior: PosePrior | None,
    seed: int,
    left: float | None,
) -> Solution:
    """The best pose of the photo among the points of one region."""
    known = region.prior(scene) if prior is None else prior
    found = solve(keypoints, scene.points3d[region.points], camera, prior=known, seed=seed, time_limit=left)
    ids = scene.point_ids[region.points]
    matches = np.column_stack([found.matches[:, 0], ids[found.matches[:, 1]]])
    return replace(found, matches=matches, view=region.view.name, point_ids=ids)


def _rank(solution: Solution) -> tuple[int, float]:
    """Confident before ambiguous before failed; then the likelihood of the keypoints, the same ones in every region."""
    score = solution.candidates[0].score if solution.candidates else -math.inf
    return RANKS[solution.verdict], score
