"""Pose refinement without correspondences: anneal the soft assignment from poses of which one is roughly right."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.search.annealing import Deadline, anneal_on_clusters, finish, refine_batch
from bpnp.search.candidates import Candidates, in_user_frame
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict import SearchResult, judged, no_pose


def refine_poses(
    sets: PointSets,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    *,
    outliers: float | None = None,
    seed: int = 0,
    settings: SearchSettings = DEFAULT,
) -> SearchResult:
    """The likeliest poses that annealing reaches from given ones and from poses shaken around them.

    The objective is that of `search_poses`. A start may be some 10 degrees off, and more where there are many: those
    beyond `settings.refine.direct` are first annealed on clusters, as the search does, and the likeliest go on.

    rotation (s, 3, 3), translation (s, 3): the starts; those with NaN are missing. outliers: share of the
    points without a partner to expect, in (0, 1); None for that of the settings.

    `batches` of the result is the number of starts that were annealed. Without a start, or with points that fix no
    pose, there are no candidates. Raises ValueError for `outliers` out of range.
    """
    share = settings.outliers if outliers is None else outliers
    if not 0 < share < 1:
        raise ValueError(f"expected `outliers` in (0, 1), a share of the points, got {share}")
    given = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    if not given.any() or degenerate(sets.bearings) or degenerate(sets.points3d):
        return no_pose("no start, or points that fix no pose")
    scene, never = Scene(sets, seed, settings), Deadline()
    starts = Candidates.unscored(*scene.enter(rotation[given], translation[given]))
    crowd = len(starts)
    if crowd > settings.refine.direct:
        starts = _likeliest(scene, starts, share)
    annealed = crowd + min(len(starts), settings.shaking.poses) * settings.shaking.copies
    poses = refine_batch(scene, starts, share, never) if len(starts) else starts
    if len(poses):
        poses = finish(scene, poses, share, never)
    return judged(in_user_frame(poses, scene), sets, batches=annealed, rule=settings.evidence)


def _likeliest(scene: Scene, starts: Candidates, outliers: float) -> Candidates:
    """Where the likeliest starts end when they are annealed on coarse and then on finer clusters, best first."""
    settings = scene.settings
    stages = (
        (settings.recipes[0].first_scale, replace(settings.coarse, kept=settings.refine.competitors)),
        (
            settings.coarse.last_scale,
            replace(settings.middle, kept=settings.refine.direct, apart_deg=settings.same_deg),
        ),
    )
    for first_scale, stage in stages:
        starts = anneal_on_clusters(scene, starts, stage, first_scale, outliers, Deadline())
    return starts
