"""Gauss-Newton refinement of any pose model, in float64.

A step d of the unknowns solves (J^T W J + D) d = J^T W r: r are the residuals of the matches, J the derivatives of
their predictions and W their weights. The matches are given or wrong with some probability (`match_equations`), or
every image point has several possible ones whose probabilities depend on the pose (`SoftMatches`). The caller gives the
scales of the residuals, one of each step, decreasing where the first pose is inaccurate.

D is a fixed small fraction of the diagonal of J^T W J, or the damping of Levenberg and Marquardt: a step that does not
reduce the weighted sum of squares is not taken, and the next one is shorter.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array, Labels
from bpnp.search.pose_model import PoseModel, PoseState, Sight
from bpnp.search.possible_matches import MOST_NEIGHBOURS, facing, possible_matches
from bpnp.search.problem import Problem

RIDGE = 1e-12  # least damping, a fraction of the diagonal: unknowns that nothing fixes do not move [fraction; numerics]
DIFFERENCE_STEP = 6e-6  # step of central differences, the cube root of the machine precision [fraction; derived]
DAMPING_IF_TAKEN = 0.1  # factor on the damping after a step that is taken [factor; convention]
DAMPING_IF_NOT = 10.0  # factor on the damping after a step that is not [factor; convention]
FIRST_DAMPING = 1e-3  # first damping of Levenberg and Marquardt, a fraction of the diagonal [fraction; convention]


class Equations(NamedTuple):
    """Normal equations of a step, of one pose or of several (...)."""

    products: Array  # (..., p, p) J^T W J
    gradient: Array  # (..., p) J^T W r
    cost: NDArray[np.float64] | float  # (...) r^T W r; NaN for possible matches, whose weights change from step to step
    matched: NDArray[np.float64] | float  # (...) expected number of matches

    def step(self, damping: Array | float | int = 0) -> Array:
        """Return the step (..., p), damped by a fraction of the diagonal."""
        diagonal = np.einsum("...ii->...i", self.products)
        damped = np.where(diagonal > 0, (np.asarray(damping)[..., None] + RIDGE) * diagonal, 1.0)
        products = self.products + damped[..., None] * np.eye(diagonal.shape[-1])
        return np.asarray(np.linalg.solve(products, self.gradient[..., None])[..., 0])


Record = TypeVar("Record", PoseState, Equations)
# State and scale of the residuals -> normal equations; None if too few points match.
Linearise = Callable[[PoseState, float], Equations | None]


class Iteration(NamedTuple):
    """One step of a refinement."""

    state: PoseState  # state after the step; before it where the step was not taken
    scale: float  # of the residuals, radians or the unit of the image
    step: Array  # (..., p) step that was tried
    before: Equations  # normal equations of the step
    # (...) reduction of the cost by the step; NaN without the damping of Levenberg and Marquardt.
    gain: NDArray[np.float64] | float


class Refined(NamedTuple):
    """End of a refinement."""

    state: PoseState
    iterations: int
    converged: bool  # the steps settled before the last scale
    lost: bool  # the points of a state matched too little for another step


def steps(
    model: PoseModel,
    state: PoseState,
    linearise: Linearise,
    scales: Iterable[float],
    *,
    damping: float | int = 0,
    adaptive: bool = False,
    largest: Array | None = None,
) -> Iterator[Iteration]:
    """Yield the state after one step at each scale of the residuals, radians, of one pose or of several.

    The steps end early if the points of a state match too little. The damping is a fraction of the diagonal; if it is
    `adaptive`, that of Levenberg and Marquardt of each pose, which begins with this one. The scales should then be
    equal, so that costs compare. No unknown moves by more than `largest` (p,); None for no limit.
    """
    factor, here = np.full(state.rotation.shape[:-2], float(damping)), None
    for scale in scales:
        here = linearise(state, scale) if here is None else here
        if here is None:
            return
        step = here.step(factor)
        if largest is not None:
            step = np.clip(step, -largest, largest)
        trial = model.moved(state, step)
        if not adaptive:
            state = trial
            yield Iteration(state, scale, step, here, math.nan)
            here = None
            continue
        there = linearise(trial, scale)
        if there is None:
            return
        gain = np.asarray(here.cost) - there.cost
        before, better = here, np.asarray(gain > 0)
        state, here = _select(better, trial, state), _select(better, there, here)
        factor = factor * np.where(better, DAMPING_IF_TAKEN, DAMPING_IF_NOT)
        yield Iteration(state, scale, step, before, gain)


def refine(
    model: PoseModel,
    state: PoseState,
    linearise: Linearise,
    scales: Sequence[float],
    *,
    settled: Callable[[Iteration], bool] | None = None,
    damping: float | int = 0,
    adaptive: bool = False,
    largest: Array | None = None,
) -> Refined:
    """Refine a pose, or several, until `settled` is true of a step, at most one step a scale, radians; as for `steps`.

    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (20, 3))
    >>> model = PoseModel(points.mean(0))
    >>> true = model.state(np.eye(3), np.array([0.1, 0, 5]))
    >>> linearise = match_equations(model, model.directions(true, points), points)
    >>> start = model.state(np.eye(3), np.array([0.3, 0.2, 4]))
    >>> end = refine(model, start, linearise, [1.0] * 20, settled=lambda last: np.abs(last.step).max() < 1e-9)
    >>> end.converged, end.iterations < 8, bool(np.allclose(end.state.centroid, true.centroid))
    (True, True, True)
    """
    count, converged = 0, False
    taken = steps(model, state, linearise, scales, damping=damping, adaptive=adaptive, largest=largest)
    for last in taken:
        state, count = last.state, count + 1
        if settled is not None and settled(last):
            converged = True
            break
    return Refined(state, count, converged, not converged and count < len(scales))


def normal_equations(jacobian: Array, residual: Array, weight: Array) -> Equations:
    """Return the normal equations of measurements less predictions (..., k, d) with derivatives (..., k, d, p).

    The weights are (..., k) of each match, or (..., k, d) of each of its numbers.
    """
    per_match = weight.ndim < residual.ndim
    each = weight[..., None] if per_match else weight
    shape, size = (*residual.shape[:-2], -1), jacobian.shape[-1]
    rows = jacobian.reshape(*shape, size)
    weighted = np.swapaxes((jacobian * each[..., None]).reshape(*shape, size), -1, -2)
    return Equations(
        weighted @ rows,
        (weighted @ residual.reshape(*shape, 1))[..., 0],
        np.asarray((each * residual**2).sum((-2, -1))),
        np.asarray(weight.sum(-1) if per_match else weight.mean(-1).sum(-1)),
    )


def match_equations(model: PoseModel, bearings: Array, points: Array, weight: Array | None = None) -> Linearise:
    """Return the linearisation of given matches of one camera: bearings (k, 3), points (k, 3) and weights (..., k)."""

    def linearise(state: PoseState, _scale: float) -> Equations:
        sight = model.sight(state, points)
        given = np.ones(sight.length.shape) if weight is None else weight
        return normal_equations(model.jacobian(state, sight), bearings - sight.directions, given)

    return linearise


def image_equations(
    model: PoseModel, project: Callable[[Array], Array], points: Array, target: Array, *, lost: float | int
) -> Linearise:
    """Return the linearisation of k given matches of one given camera of any model, whose residuals are in the image.

    `project` returns the image points (k, d) of points (k, 3) in the camera's frame, NaN outside the view; `lost` is
    the residual of a point that leaves the view. The derivatives of the camera model are central differences by the
    points in the camera's frame, since there are many camera models. Those by the pose follow from them.
    """

    def linearise(state: PoseState, _scale: float) -> Equations:
        sight = model.sight(state, points)
        h = DIFFERENCE_STEP * np.maximum(np.linalg.norm(sight.camera, axis=-1), 1e-300)
        moved = sight.camera + h[:, None] * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])[:, None]
        seen = project(moved.reshape(-1, 3)).reshape(7, *target.shape)
        residual = target - seen[0]
        jacobian = model.by_pose(sight, ((seen[1:4] - seen[4:]) / (2 * h[:, None])).transpose(1, 2, 0))
        jacobian = np.nan_to_num(np.where(np.isfinite(residual)[..., None], jacobian, 0.0), nan=0.0)
        return normal_equations(jacobian, np.nan_to_num(residual, nan=lost), np.ones(len(residual)))

    return linearise


class SoftMatches(NamedTuple):
    """Possible matches of the image points of one camera under a state."""

    sight: Sight  # scene points that the camera may see
    image: Labels  # (k,) index of each match among the chosen image points
    point: Labels  # (k,) index among the points of `sight`
    probability: Array  # (k,) of each match


def soft_matches(
    model: PoseModel,
    problem: Problem,
    state: PoseState,
    scale: float,
    *,
    camera: int = 0,
    chosen: Labels | None = None,
    most: int = MOST_NEIGHBOURS,
) -> SoftMatches | None:
    """Return the possible matches of one camera under a state, or None if there are none.

    The scene points of an image point, at most `most`, are within a few standard deviations `scale`, radians, of it.
    The image points are `chosen` (m,), or those of `ImageStatistics.chosen`.
    """
    sight = model.sight(state, problem.points3d, camera)
    rotation = state.rotation if model.mounts is None else model.mounts[camera][0] @ state.rotation
    places = facing(problem, sight.camera, rotation)
    if sight.stretch is not None:
        places = places[np.isfinite(sight.stretch[places])]
    if not len(places):
        return None
    sight = sight.choose(places) if len(places) < len(sight.length) else sight
    chosen = problem.image.chosen if chosen is None else chosen
    i, j, density, every = possible_matches(problem, sight.directions, places, chosen, scale, most)
    return SoftMatches(sight, i, j, density / every[i]) if len(i) else None


def soft_equations(
    model: PoseModel,
    problems: Sequence[Problem],
    *,
    chosen: Labels | None = None,
    most: int = MOST_NEIGHBOURS,
    fewest: float | int = 0,
) -> Linearise:
    """Return the linearisation of the possible matches of all cameras, weighted with their probabilities.

    The matches of a scene point are added up first: they have one derivative. A prior of the focal length is added. No
    step is taken if the expected number of matches is `fewest` or less. The other arguments are those of
    `soft_matches`.
    """

    def linearise(state: PoseState, scale: float) -> Equations | None:
        products, gradient, count = np.zeros((model.size, model.size)), np.zeros(model.size), 0.0
        for k, problem in enumerate(problems):
            found = soft_matches(model, problem, state, scale, camera=k, chosen=chosen, most=most)
            if found is None:
                continue
            used = problem.image.chosen if chosen is None else chosen
            size = len(found.sight.length)
            weight = np.bincount(found.point, found.probability, size)
            matched = np.flatnonzero(weight)
            bearings = problem.bearings[used[found.image]].T
            pulled = np.stack([np.bincount(found.point, found.probability * axis, size) for axis in bearings], -1)
            sight, weight, pulled = found.sight.choose(matched), weight[matched], pulled[matched]
            jacobian = model.jacobian(state, sight, k)
            rows = jacobian.reshape(-1, model.size)
            products += rows.T @ (jacobian * weight[:, None, None]).reshape(-1, model.size)
            gradient += rows.T @ (pulled - weight[:, None] * sight.directions).ravel()
            count += float(weight.sum()) * len(problem.bearings) / len(used)
        if count <= fewest:
            return None
        information, pull = model.lens_prior(state)
        return Equations(products + scale**2 * information, gradient + scale**2 * pull, math.nan, count)

    return linearise


def _select(better: NDArray[np.bool_], new: Record, old: Record) -> Record:
    """Return the record with the values of the new one for the poses that are better."""
    if better.ndim == 0:
        return new if better else old
    rows = (
        np.where(better.reshape(better.shape + (1,) * (np.ndim(one) - better.ndim)), one, other)
        for one, other in zip(new, old, strict=True)
    )
    return type(new)(*rows)
