"""Poses from elsewhere, such as those of a network: annealed, or only scored at the scale of their residuals."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from bpnp.arrays import Array
from bpnp.runtime import one_blas_thread
from bpnp.search.hypotheses import Hypotheses, merge_hypotheses, to_problem_frame
from bpnp.search.kernels.sides import FORWARD
from bpnp.search.propose.density_map import perturb_each
from bpnp.search.refine.annealing import COARSE, MIDDLE, STARTS, anneal_on_clusters, anneal_on_points, finish
from bpnp.search.search_frame import SearchFrame

REFINED_DIRECTLY = 8  # largest number of given poses that need no clusters [poses; cost]
COPIED_POSES = 4  # number of poses from other sources, the best first, that are also copied [poses; calibration]


@one_blas_thread
def anneal_given(scene: SearchFrame, rotation: Array, translation: Array) -> Hypotheses:
    """Anneal poses of a problem, with perturbed copies of the first few; return them in its frame, without NFA.

    The objective is that of `bpnp.search.find.search_poses`. An initial pose may be about 10 degrees off, and more if
    there are many; NaN for a missing one. If there are more than `REFINED_DIRECTLY`, all are first annealed on
    clusters, as in the search, and the likeliest go on.
    """
    starts = enter_given(scene, rotation, translation)
    if not len(starts):
        return Hypotheses.empty()
    if len(starts) > REFINED_DIRECTLY:
        starts = anneal_on_clusters(scene, starts, (*COARSE, *MIDDLE), STARTS)
    around = Hypotheses.concatenate([starts, perturb_each(scene, starts[:COPIED_POSES])])
    first_scale = MIDDLE[-1].last_scale * scene.spread
    clustered = anneal_on_clusters(scene, around, MIDDLE, STARTS)
    clustered = anneal_on_points(scene, clustered, first_scale)
    # A correct initial pose needs no clusters, which would only perturb it.
    direct = anneal_on_points(scene, starts, first_scale)
    return to_problem_frame(finish(scene, merge_hypotheses([clustered, direct], scene)), scene)


@one_blas_thread
def score_given(scene: SearchFrame, rotation: Array, translation: Array) -> Hypotheses:
    """Anneal poses of a problem a little, to score them like those of a search; return them in its frame.

    NaN is a missing pose. The residuals are assumed to have the median distance of a point to the nearest bearing.
    Basin counts are 0, since no other starts were tried: only overwhelming evidence makes the best pose confident.
    After the deadline the remaining poses are not annealed.
    """
    starts = enter_given(scene, rotation, translation)
    if not len(starts):
        return Hypotheses.empty()
    camera = scene.points3d @ starts.rotation.transpose(0, 2, 1) + starts.translation[:, None]
    length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12)
    distance, _ = cKDTree(scene.offsets + FORWARD).query(camera / length)
    scale = np.asarray(np.maximum(np.median(distance, -1), scene.smallest_scale), np.float32)
    return to_problem_frame(finish(scene, replace(starts, scale=scale)), scene)


def enter_given(scene: SearchFrame, rotation: Array, translation: Array) -> Hypotheses:
    """Return the poses of a problem that are not NaN, in the frame of a scene."""
    finite = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    return Hypotheses.from_poses(*scene.enter(rotation[finite], translation[finite]))
