"""Camera model of a pose: the focal length and the radial distortion that fit its points best.

The camera model is COLMAP's SIMPLE_RADIAL with the principal point at the origin. A point (X, Y, Z) in the camera's
frame, x = (X, Y) / Z, is seen at z (1 + k |x|^2) x. z is the scale factor over the focal length of the bearings, and k
the radial coefficient. Everything here is a pure function of arrays.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.search.config import OtherFocal
from bpnp.search.evidence.partners import facing, partners
from bpnp.search.pose_model import LEAST_SLOPE, across
from bpnp.search.problem import Problem

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
FEW_PARTNERS = 2  # scene points that may correspond to each image point
MOST_ZOOM, MOST_BEND = 0.2, 0.1  # largest step of the log scale factor, and relative shift of the outermost point
SAME_ZOOM = 0.01  # change of the log scale factor below which no other round of steps is taken
MOST_ROUNDS = 4
SETTLED_ZOOM, MOST_STEPS = 2e-5, 40  # the same for the last steps, with all points; steps at most
WIDTHS = (4.0, 2.0, 2.0, 1.0, 1.0)  # scales of the residuals, of the Gauss-Newton steps of a round


class LensFit(NamedTuple):
    """Pose and camera model, with the normal equations of the next Gauss-Newton step.

    Attributes:
        rotation: (3, 3).
        middle: (3,) centroid of the scene in the camera's frame.
        zoom: Scale factor: focal length over that of the bearings.
        radial: Radial coefficient k; None if only the focal length is fitted.
        products: (7, 7) J^T J of rotation, shift and log scale factor; (8, 8) with k.
        gradient: (7,) or (8,) J^T r.
    """

    rotation: Array
    middle: Array
    zoom: float
    radial: float | None
    products: Array
    gradient: Array


def fit_lens(
    problem: Problem, rotation: Array, middle: Array, scale: float, radial: float | None = None
) -> LensFit | None:
    """Fit pose, focal length and optionally the radial coefficient to soft matches by Gauss-Newton steps.

    The first steps use some of the image points and matches of wider scales. The last ones use all points, until the
    focal length has converged.

    Args:
        problem: Points; the bearings are those of a camera without distortion.
        rotation: (3, 3) initial rotation.
        middle: (3,) initial centroid of the scene in the camera's frame.
        scale: Scale of the residuals, radians.
        radial: Initial radial coefficient; None to fit no distortion.

    Returns:
        The fit, or None if no points match.

    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (80, 3)) + [0, 0, 3]
    >>> x = points[:, :2] / points[:, 2:]
    >>> seen = np.c_[1.05 * (1 - 0.1 * (x**2).sum(1, keepdims=True)) * x, np.ones(80)]
    >>> problem = Problem(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> fit = fit_lens(problem, np.eye(3), problem.middle, 1e-3, radial=0.0)
    >>> round(fit.zoom, 3), round(fit.radial, 3)
    (1.05, -0.1)
    """
    chosen = problem.image.chosen
    some = chosen[:: max(len(chosen) // OtherFocal.bearings, 1)]
    start = LensFit(rotation, middle, 1.0, radial, np.empty((0, 0)), np.empty(0))
    step = _linearise(problem, some, WIDTHS[0] * scale, start)
    for _ in range(MOST_ROUNDS):
        before = 0.0 if step is None else math.log(step.zoom)
        for width in WIDTHS:
            step = None if step is None else _take_step(problem, some, width * scale, step)
        if step is None or abs(math.log(step.zoom) - before) < SAME_ZOOM:
            break
    for _ in range(MOST_STEPS):
        last, step = step, None if step is None else _take_step(problem, chosen, scale, step)
        if last is None or step is None or abs(math.log(step.zoom / last.zoom)) < SETTLED_ZOOM:
            break
    return step


def _linearise(problem: Problem, chosen: Labels, scale: float, at: LensFit) -> LensFit | None:
    """Return the pose and camera model with their normal equations, or None without a match."""
    turned = (problem.points3d - problem.middle) @ at.rotation.T
    places = facing(problem, turned + at.middle, at.rotation)
    camera = turned[places] + at.middle
    x, squared = np.zeros((len(camera), 2)), np.zeros(len(camera))
    if at.radial is not None:
        x = camera[:, :2] / np.where(camera[:, 2:] > 0, camera[:, 2:], np.inf)
        squared = (x**2).sum(-1)
        visible = (camera[:, 2] > 0) & (1 + 3 * at.radial * squared > LEAST_SLOPE)
        places, camera, x, squared = places[visible], camera[visible], x[visible], squared[visible]
    stretch = at.zoom * (1 + (at.radial or 0.0) * squared)
    seen = camera * np.column_stack([stretch, stretch, np.ones(len(camera))])
    length = np.linalg.norm(seen, axis=-1)
    seen /= length[:, None]
    i, j, density, every = partners(problem, seen, places, chosen, scale, FEW_PARTNERS)
    if not len(i):
        return None
    probability = density / every[i]
    weights = np.bincount(j, probability, len(seen))
    used = np.flatnonzero(weights)
    seen_as = np.stack([np.bincount(j, probability * axis, len(seen)) for axis in problem.bearings[chosen[i]].T], -1)
    u, weights, camera, stretch, squared = seen[used], weights[used], camera[used], stretch[used], squared[used]
    on_sphere = across(u) / length[used, None, None]
    outwards = on_sphere[:, :, :2] @ camera[:, :2, None]
    by_shift = on_sphere * np.column_stack([stretch, stretch, np.ones(len(used))])[:, None]
    if at.radial is not None:
        bend = 2 * at.zoom * at.radial * np.column_stack([x[used], -squared]) / camera[:, 2:]
        by_shift = by_shift + outwards * bend[:, None]
    by_turn = np.cross((camera - at.middle)[:, None], by_shift, axisb=2, axisc=2)
    columns = [by_turn, by_shift, outwards * stretch[:, None, None]]
    if at.radial is not None:
        columns.append(outwards * (at.zoom * squared)[:, None, None])
    jacobian = np.concatenate(columns, -1)
    products = np.tensordot(jacobian * weights[:, None, None], jacobian, ((0, 1), (0, 1)))
    gradient = np.tensordot(jacobian, seen_as[used] - weights[:, None] * u, ((0, 1), (0, 1)))
    return at._replace(products=products, gradient=gradient)


def _take_step(problem: Problem, chosen: Labels, scale: float, at: LensFit) -> LensFit | None:
    """Take a Gauss-Newton step, and linearise with matches of the given scale."""
    products, gradient, focal = at.products, at.gradient, problem.focal
    if focal is not None and math.isfinite(focal.sigma):
        products, gradient = products.copy(), gradient.copy()
        products[6, 6] += (scale / focal.sigma) ** 2
        gradient[6] -= (scale / focal.sigma) ** 2 * (focal.offset + math.log(at.zoom))
    size = np.diag(products)  # of rotation, shift and camera model, each in its own unit
    damped = products + np.diag(np.where(size > 0, 1e-6 * size, 1.0))
    step = np.linalg.solve(damped, gradient)
    zoom = at.zoom * math.exp(float(np.clip(step[6], -MOST_ZOOM, MOST_ZOOM)))
    radial = at.radial
    if radial is not None:
        outermost = float(((problem.bearings[:, :2] / problem.bearings[:, 2:]) ** 2).sum(-1).max())
        radial += float(np.clip(step[7], -MOST_BEND / outermost, MOST_BEND / outermost))
    rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ at.rotation
    return _linearise(
        problem, chosen, scale, LensFit(rotation, at.middle + step[3:6], zoom, radial, products, gradient)
    )
