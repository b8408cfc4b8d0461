"""Camera model of a pose: the focal length and the radial distortion that fit its points best.

The camera model is COLMAP's SIMPLE_RADIAL with the principal point at the origin, as in `bpnp.search.pose_model`.
"""

import math
from typing import NamedTuple

import numpy as np

from bpnp.arrays import Array
from bpnp.search.pose_model import PoseModel, PoseState
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.refine.gauss_newton import refine, soft_equations

CORRESPONDENCES = 2  # number of scene points that may correspond to each image point [points; not tuned]
MOST_ZOOM_STEP = 0.2  # largest step of the logarithm of the scale factor [nats; not tuned]
MOST_BEND_STEP = 0.1  # largest step of the relative shift of the outermost point [fraction; not tuned]
SAME_ZOOM = 0.01  # change of the log scale factor below which no other round of steps is taken [nats; not tuned]
MOST_ROUNDS = 4  # largest number of rounds [rounds; not tuned]
SETTLED_ZOOM = 2e-5  # change of the log scale factor that ends the last steps, with all points [nats; numerics]
MOST_LAST_STEPS = 40  # largest number of last steps [steps; numerics]
FIRST_WIDTHS = (4.0,)  # scales of the steps before the first round [scales of the residuals; not tuned]
ROUND_WIDTHS = (4.0, 2.0, 2.0, 1.0, 1.0)  # scales of the steps of each round [scales of the residuals; not tuned]
LENS_DAMPING = 1e-6  # damping, a fraction of the diagonal of the normal equations [fraction; numerics]
FITTED_BEARINGS = 400  # largest number of bearings that most steps are fitted to [bearings; cost]


class LensFit(NamedTuple):
    """Pose and camera model."""

    rotation: Array  # (3, 3)
    centre3d: Array  # (3,) centroid of the scene in the camera's frame
    zoom: float  # scale factor: focal length over that of the bearings
    radial: float | None  # radial coefficient k; None if only the focal length is fitted


def lens_model(problem: Problem, *, bends: bool) -> PoseModel:
    """Return the model of a pose and its focal length, with the prior of a problem without distortion.

    If it `bends`, a radial coefficient is unknown too; it has no prior.
    """
    lens = UnknownFocal(0.0) if problem.focal is None else problem.focal
    return PoseModel(problem.centre3d, lens._replace(radial=0.0, radial_sigma=math.inf if bends else 0.0))


def fit_lens(
    problem: Problem, rotation: Array, centre3d: Array, scale: float, radial: float | None = None
) -> LensFit | None:
    """Fit pose, focal length and optionally the radial coefficient to soft matches by Gauss-Newton steps.

    The pose is given by rotation and centroid of the scene in the camera's frame, the residuals have the scale of
    `scale` radians, and `radial` is None to fit no distortion; the bearings are those of a camera without one. The
    first steps use some of the image points and matches of wider scales. The last ones use all points, until the focal
    length has converged. None if no points match.

    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (80, 3)) + [0, 0, 3]
    >>> x = points[:, :2] / points[:, 2:]
    >>> seen = np.c_[1.05 * (1 - 0.1 * (x**2).sum(1, keepdims=True)) * x, np.ones(80)]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> fit = fit_lens(problem, np.eye(3), problem.centre3d, 1e-3, radial=0.0)
    >>> round(fit.zoom, 3), round(fit.radial, 3)
    (1.05, -0.1)
    """
    model = lens_model(problem, bends=radial is not None)
    zoom = model.columns["log_focal"].start
    largest = np.full(model.size, math.inf)
    largest[zoom] = MOST_ZOOM_STEP
    if radial is not None:
        outermost = float(((problem.bearings[:, :2] / problem.bearings[:, 2:]) ** 2).sum(-1).max())
        largest[model.columns["radial"]] = MOST_BEND_STEP / outermost
    chosen = problem.image.chosen
    some = chosen[:: max(math.ceil(len(chosen) / FITTED_BEARINGS), 1)]
    linearise = soft_equations(model, [problem], chosen=some, most=CORRESPONDENCES)
    state = PoseState(rotation, centre3d, radial=radial or 0.0)
    for widths in (FIRST_WIDTHS + ROUND_WIDTHS, *[ROUND_WIDTHS] * (MOST_ROUNDS - 1)):
        scales = [width * scale for width in widths]
        end = refine(model, state, linearise, scales, damping=LENS_DAMPING, largest=largest)
        if end.lost:
            return None
        moved = math.log(end.state.zoom / state.zoom)
        state = end.state
        if abs(moved) < SAME_ZOOM:
            break
    end = refine(
        model,
        state,
        soft_equations(model, [problem], most=CORRESPONDENCES),
        [scale] * MOST_LAST_STEPS,
        settled=lambda last: bool(abs(last.step[zoom]) < SETTLED_ZOOM),
        damping=LENS_DAMPING,
        largest=largest,
    )
    if end.lost:
        return None
    state = end.state
    return LensFit(state.rotation, state.centroid, float(state.zoom), None if radial is None else float(state.radial))
