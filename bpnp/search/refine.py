"""Pose refinement without correspondences: anneal the soft assignment from poses of which one is roughly right."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.loops.parallel import Deadline, one_blas_thread
from bpnp.search.annealing import anneal_on_clusters, anneal_on_points, finish
from bpnp.search.candidates import Candidates, in_user_frame, merged
from bpnp.search.kernels.sides import FORWARD
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.sources.raster import around_each
from bpnp.search.verdict import SearchResult, judged, no_pose


@one_blas_thread
def refine_poses(
    sets: PointSets,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    *,
    seed: int = 0,
    settings: SearchSettings = DEFAULT,
) -> SearchResult:
    """The likeliest poses that annealing reaches from given ones and from poses around them.

    The objective is that of `search_poses`. A start may be some 10 degrees off, and more where there are many: those
    beyond `settings.refined_directly` are first annealed on clusters, as the search does, and the likeliest go on.

    rotation (s, 3, 3), translation (s, 3): the starts; those with NaN are missing.

    `batches` of the result is the number of starts that were annealed. Without a start, or with points that fix no
    pose, there are no candidates.
    """
    scene = Scene(sets, seed, settings)
    starts = _entered(scene, rotation, translation)
    if not len(starts) or degenerate(sets.bearings) or degenerate(sets.points3d):
        return no_pose("no start, or points that fix no pose")
    crowd = len(starts)
    if crowd > settings.refined_directly:
        starts = anneal_on_clusters(scene, starts, (*settings.coarse, *settings.middle), settings.starts)
    around = Candidates.concatenated([starts, around_each(scene, starts[: settings.copied])])
    first_scale = settings.middle[-1].last_scale * scene.spread
    clustered = anneal_on_clusters(scene, around, settings.middle, settings.starts)
    clustered = anneal_on_points(scene, clustered, first_scale)
    # A start that is right already needs no clusters, which would only shake it.
    direct = anneal_on_points(scene, starts, first_scale)
    poses = finish(scene, merged([clustered, direct], scene))
    annealed = crowd + len(around) - len(starts)
    return judged(in_user_frame(poses, scene), sets, batches=annealed, rule=settings.evidence)


@one_blas_thread
def score_poses(
    sets: PointSets, rotation: NDArray[np.float64], translation: NDArray[np.float64], deadline: Deadline
) -> SearchResult:
    """Poses (c, 3, 3), (c, 3) annealed a little and scored as those of a search; NaN for a missing one.

    Their residuals are taken to be the median distance of a point to the nearest bearing. They have no hits, since no
    other starts were tried: only overwhelming evidence makes the best of them certain.
    """
    scene = Scene(sets, 0, DEFAULT, deadline)
    starts = _entered(scene, rotation, translation)
    if not len(starts):
        return no_pose("the module found no pose")
    camera = scene.points3d @ starts.rotation.transpose(0, 2, 1) + starts.translation[:, None]
    length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12)
    distance, _ = cKDTree(scene.offsets + FORWARD).query(camera / length)
    scale = np.asarray(np.maximum(np.median(distance, -1), scene.smallest_scale), np.float32)
    poses = finish(scene, replace(starts, scale=scale))
    return judged(in_user_frame(poses, scene), sets, batches=len(starts))


def _entered(scene: Scene, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Candidates:
    """Those of the user's poses in the frame of a scene that are not missing."""
    known = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    return Candidates.unscored(*scene.enter(rotation[known], translation[known]))
