"""The pose that fits its one-to-one matches best."""

import math
from collections.abc import Callable

import numpy as np

from bpnp.arrays import Array
from bpnp.matching import mutual_nearest
from bpnp.poses import MIN_POINTS
from bpnp.runtime import Deadline
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem
from bpnp.search.refine.gauss_newton import FIRST_DAMPING, Iteration, image_equations, refine
from bpnp.search.verdict.covariance import FAR_SQUARED
from bpnp.search.verdict.reasons import Unfinished

FIT_ROUNDS = 5  # rounds of the last fit, each with new matches [rounds; not tuned]
MOST_STEPS = 50  # largest number of steps of Levenberg and Marquardt [steps; numerics]
EXACT_CHANGE = 1e-12  # relative change of a pose, and of the sum of squares, that ends the steps [ratio; numerics]


def fit_to_matches(
    problem: Problem, rotation: Array, translation: Array, threshold: float, deadline: Deadline
) -> tuple[Array, Array]:
    """Fit the pose to mutual nearest neighbours by least squares; keep the search's pose unless the fit is better.

    The difference must be significant. The search weights all matches by their probability. This is the better estimate
    unless its float32 steps were too coarse for the data. At an optimum of the same precision n log(S / S_min), S the
    sum of n squared residuals, is distributed as chi-squared with 6 degrees of freedom.
    """
    image = problem.measured.points
    for _ in range(FIT_ROUNDS):
        if deadline.ended(Unfinished.refinement):
            break
        projected = problem.project_scene(rotation, translation)
        i, j = mutual_nearest(image, projected, threshold, problem.may_match, deadline).T
        if len(i) < MIN_POINTS:
            break
        target, points = image[i], problem.points3d[j]
        trial = fit_pose(problem.measured.project, points, target, rotation, translation, scale=threshold)
        after = problem.measured.project(points @ trial[0].T + trial[1])
        squares = [float(((each - target) ** 2).sum()) for each in (projected[j], after)]
        if not squares[0] > squares[1] * math.exp(FAR_SQUARED / target.size):
            break
        rotation, translation = trial
    return rotation, translation


def fit_pose(
    project: Callable[[Array], Array],
    points: Array,
    target: Array,
    rotation: Array,
    translation: Array,
    *,
    scale: float,
) -> tuple[Array, Array]:
    """Fit a pose to matches of points (k, 3) and image points (k, d) by Levenberg-Marquardt steps from a pose nearby.

    Residuals are those of the image, so that any camera model can be used: `project` maps points (k, 3) in the camera's
    frame to the image. A point that leaves the view has a residual of a thousand times their scale.
    """
    model = PoseModel(points.mean(0))
    state = model.state(rotation, translation)
    relative = np.r_[np.ones(3), np.full(3, max(float(np.linalg.norm(state.centroid)), 1e-12))]

    def settled(last: Iteration) -> bool:
        return bool(
            (np.abs(last.step) <= EXACT_CHANGE * relative).all()
            or np.abs(last.gain) <= EXACT_CHANGE * np.asarray(last.before.cost)
        )

    linearise = image_equations(model, project, points, target, lost=1e3 * scale)
    end = refine(model, state, linearise, [scale] * MOST_STEPS, settled=settled, damping=FIRST_DAMPING, adaptive=True)
    return model.pose(end.state)
