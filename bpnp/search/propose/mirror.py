"""Mirror image of a scene: coordinates of the wrong handedness have no pose, but their mirror image has one."""

from dataclasses import replace

import numpy as np

from bpnp.runtime import Deadline
from bpnp.search.few_points.enumeration import enumerate_poses, is_enumerable
from bpnp.search.problem import Problem
from bpnp.search.verdict.false_alarms import alarms_of

# Number of hypotheses of a mirrored scene, some 10 ms: a correct pose of clean points is among the first thousands.
MIRRORED_HYPOTHESES = 20_000  # [hypotheses; cost]

MIRROR = np.array([1.0, 1.0, -1.0])


def mirrored_scene(problem: Problem) -> Problem:
    """Return the problem of the mirror image of its scene: a mirrored photo has a pose of it."""
    normals = None if problem.normals3d is None or problem.cosines3d is not None else problem.normals3d * MIRROR
    return replace(problem, points3d=problem.points3d * MIRROR, normals3d=normals, cosines3d=None)


def mirrored_alarms(problem: Problem, deadline: Deadline) -> float:
    """Return log10 of the false alarms of the mirror image of a scene without a significant pose.

    It is that of the best pose of a short enumeration; infinite where the points are too many to be enumerated, where a
    prior of the pose is given, or where no pose was found.

    >>> points = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    >>> seen = points * MIRROR + [0, 0, 6]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> mirrored_alarms(problem, Deadline()) < -5
    True
    """
    if problem.prior is not None or not is_enumerable(problem) or deadline.passed():
        return np.inf
    mirrored = mirrored_scene(problem)
    found = enumerate_poses(mirrored, deadline=deadline.at, most=MIRRORED_HYPOTHESES).poses
    if not len(found):
        return np.inf
    return float(alarms_of(mirrored, found.rotation[:1], found.translation[:1]).own[0])
