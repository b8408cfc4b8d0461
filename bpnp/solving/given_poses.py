"""Results that did not come out of one search: of the poses of a module, and of two searches together."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from bpnp.search.annealing import Deadline, finish
from bpnp.search.candidates import Candidates, in_user_frame, merged
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import SearchResult, judged, no_pose
from bpnp.solving.problem import Array, Problem


def scored(problem: Problem, rotation: Array, translation: Array, deadline: Deadline) -> SearchResult:
    """Poses (c, 3, 3), (c, 3) annealed a little and scored as those of a search; NaN for a missing one.

    They have no hits, since no other starts were tried: only overwhelming evidence makes the best of them certain.
    """
    found = np.isfinite(rotation).all((-2, -1)) & np.isfinite(translation).all(-1)
    if not found.any():
        return no_pose("the module found no pose")
    scene = Scene(problem.sets, 0, DEFAULT)
    starts = Candidates.unscored(*scene.enter(rotation[found], translation[found]))
    # Each starts at the scale of its own residuals: the median distance of a point to the nearest bearing.
    tree = cKDTree(problem.bearings)
    distance = np.zeros(len(starts), np.float32)
    for i, (r, t) in enumerate(zip(rotation[found], translation[found], strict=True)):
        camera = problem.local3d @ r.T + t
        length = np.maximum(np.linalg.norm(camera, axis=-1, keepdims=True), 1e-12 * scene.size)
        distance[i] = np.median(tree.query(camera / length)[0])
    starts = replace(starts, scale=np.maximum(distance, scene.smallest_scale))
    poses = finish(scene, starts, DEFAULT.outliers, deadline)
    return judged(in_user_frame(poses, scene), problem.sets, batches=len(starts))


def joined(problem: Problem, around: SearchResult, anywhere: SearchResult) -> SearchResult:
    """The distinct poses of two searches, best first; a pose has the hits of both."""
    scene = Scene(problem.sets, 0, DEFAULT)
    parts = []
    for result in (around, anywhere):
        unknown = np.full(len(result.candidates), math.nan)  # what a prior adds to them holds no longer
        rotation, translation = scene.enter(result.candidates.rotation, result.candidates.translation)
        parts.append(replace(result.candidates, rotation=rotation, translation=translation, log10_false_alarms=unknown))
    poses = in_user_frame(merged(parts, scene), scene)
    return judged(poses, problem.sets, batches=around.batches + anywhere.batches)
