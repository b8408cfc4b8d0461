"""Pose refinement without correspondences: anneal the soft assignment from poses of which one is roughly right."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.loops.parallel import NEVER, Deadline, one_blas_thread
from bpnp.search.annealing import anneal_on_clusters, anneal_on_points, finish, shaken
from bpnp.search.candidates import Candidates, in_user_frame, merged
from bpnp.search.kernels.sides import FORWARD
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings, Stages
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
    """The likeliest poses that annealing reaches from given ones and from poses shaken around them.

    The objective is that of `search_poses`. A start may be some 10 degrees off, and more where there are many: those
    beyond `settings.refined_directly` are first annealed on clusters, as the search does, and the likeliest go on.

    rotation (s, 3, 3), translation (s, 3): the starts; those with NaN are missing.

    `batches` of the result is the number of starts that were annealed. Without a start, or with points that fix no
    pose, there are no candidates.
    """
    scene, starts = _entered(sets, rotation, translation, seed, settings)
    if not len(starts) or degenerate(sets.bearings) or degenerate(sets.points3d):
        return no_pose("no start, or points that fix no pose")
    crowd = len(starts)
    if crowd > settings.refined_directly:
        starts = _on_clusters(scene, starts, (*settings.coarse, *settings.middle))
    around = Candidates.concatenated([starts, shaken(scene, starts)])
    first_scale = settings.middle[-1].last_scale * scene.spread
    clustered = anneal_on_points(scene, _on_clusters(scene, around, settings.middle), first_scale)
    # A start that is right already needs no clusters, which would only shake it.
    direct = anneal_on_points(scene, starts, first_scale)
    poses = finish(scene, merged([clustered, direct], scene))
    annealed = crowd + len(around) - len(starts)
    return judged(in_user_frame(poses, scene), sets, batches=annealed, rule=settings.evidence)


def _on_clusters(scene: Scene, poses: Candidates, stages: Stages) -> Candidates:
    sides = scene.clusters([stage.clusters for stage in stages])
    return anneal_on_clusters(scene, poses, stages, sides, scene.settings.starts)


@one_blas_thread
def score_poses(
    sets: PointSets, rotation: NDArray[np.float64], translation: NDArray[np.float64], deadline: Deadline,
    scale: float | None = None,
) -> SearchResult:  # fmt: skip
    """Poses (c, 3, 3), (c, 3) annealed a little and scored as those of a search; NaN for a missing one.

    scale: of their residuals, radians; by default the median distance of a point to the nearest bearing.

    They have no hits, since no other starts were tried: only overwhelming evidence makes the best of them certain.
    """
    scene, starts = _entered(sets, rotation, translation, 0, DEFAULT, deadline)
    if not len(starts):
        return no_pose("the module found no pose")
    poses = finish(scene, replace(starts, scale=_own_scales(scene, starts, scale)))
    return judged(in_user_frame(poses, scene), sets, batches=len(starts))


def _own_scales(scene: Scene, starts: Candidates, known: float | None) -> NDArray[np.float32]:
    """Scales (c,) of the residuals of poses of a scene, radians."""
    if known is not None:
        return np.full(len(starts), max(known, scene.smallest_scale), np.float32)
    camera = scene.points3d @ starts.rotation.transpose(0, 2, 1) + starts.translation[:, None]
    length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12)
    distance, _ = cKDTree(scene.offsets + FORWARD).query(camera / length)
    return np.asarray(np.maximum(np.median(distance, -1), scene.smallest_scale), np.float32)


def _entered(
    sets: PointSets, rotation: NDArray[np.float64], translation: NDArray[np.float64], seed: int,
    settings: SearchSettings, deadline: Deadline = NEVER,
) -> tuple[Scene, Candidates]:  # fmt: skip
    """The scene, and those of the user's poses in its frame that are not missing."""
    scene = Scene(sets, seed, settings, deadline)
    given = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    return scene, Candidates.unscored(*scene.enter(rotation[given], translation[given]))
