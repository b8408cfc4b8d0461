"""Other focal lengths and a radial distortion with which a different pose fits better than the best one."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bpnp.arrays import Array
from bpnp.poses import rotation_angle
from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.pose_model import undistort
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.density_map import search_around
from bpnp.search.propose.lens import LensFit, fit_lens
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DensitySearch, Draws, Narrowing, Preselection
from bpnp.search.verdict.competitors import other_camera
from bpnp.search.verdict.completeness import INDEPENDENT_MATCHES
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.false_alarms import alarms_of
from bpnp.search.verdict.limits import MOST_MISSED
from bpnp.search.verdict.reasons import Objection, Unfinished, objection
from bpnp.search.verdict.rivals import SceneOf
from bpnp.search.verdict.uncertainty import (
    FOCAL_CHANCE,
    Linearised,
    Misfit,
    bends_significantly,
    linearised,
)

AT_FOCAL_STEP = DensitySearch(  # search around a pose at the next focal length [`DensitySearch`; calibration]
    Draws(2**10, 3.0, 0.04, 2**10),
    Preselection((300,), (2**5,)),
    Narrowing(0.04, 0.015, steps=3, points=600),
    annealed=3,
)
ZOOM_STEP = 1.08  # factor from one focal length to the next [factor; calibration]
WIDEST_ZOOM = 1.6  # largest factor on the given focal length; its inverse is the smallest [factor; calibration]
FEWEST_MATCHES = 24  # smallest number of matches; with fewer, a seventh unknown fits their noise [matches; calibration]
# Largest radial distortion, as a fraction of the distance of the outermost image point from the axis.
MOST_BEND = 0.5  # [fraction; convention]


def lens(case: Case, *, scene_of: SceneOf, deadline: Deadline = NEVER) -> Case:
    """Return a case, with the objection of another lens with which a different pose fits better than the best one.

    The given camera is accepted unless another lens has fewer false alarms by the factor `FOCAL_CHANCE`, with focal
    length and radial coefficient counted as unknowns. The lens is fitted from the best pose. If three matches may be
    coincidences, it is also fitted from the likeliest pose at other focal lengths. If the time limit prevents this, the
    objection reports it. The leader of the case has no objection.
    """
    return case.against(_other_lens(case, scene_of, deadline))


def _other_lens(case: Case, scene_of: SceneOf, deadline: Deadline) -> Objection | None:
    problem = case.problem
    if problem.focal is not None:
        return None
    if deadline.ended(Unfinished.focal_lengths):
        return objection("camera_untested")
    count, (rotation, translation) = case.match_count, case.pose
    linear = case.linear
    other = fitted_lens(linear, case.misfit)
    if other is not None or count < FEWEST_MATCHES:
        return other
    if case.residual < problem.image.scales[0]:
        linear = linearised(problem, rotation, translation, problem.image.scales[0])
    centre = rotation @ problem.centre3d + translation
    starts = (None, 0.0) if bends_significantly(linear, count) else (None,)

    def better(found: AtZoom) -> Objection | None:
        least = max(float(found.pose.scale[0]), found.problem.image.scales[0])
        fits = (fit_lens(found.problem, found.pose.rotation[0], found.centre3d, least, start) for start in starts)
        others = [fit._replace(zoom=found.zoom * fit.zoom) for fit in fits if fit is not None]
        alarms = [_alarms(problem, other) for other in others]
        if min(alarms, default=math.inf) >= case.log10_false_alarms + math.log10(FOCAL_CHANCE):
            return None
        return other_camera(misfit_of(rotation, centre, others[int(np.argmin(alarms))]))

    if deadline.ended(Unfinished.focal_lengths):
        return objection("camera_untested")
    leader = AtZoom(1.0, problem, case.candidates[:1])
    other = better(leader)
    if other is not None or INDEPENDENT_MATCHES * case.log10_false_alarms / count <= MOST_MISSED:
        return other
    likeliest = None if deadline.passed() else likeliest_zoom(leader, scene_of())
    if likeliest is None or deadline.passed(Unfinished.focal_lengths):
        return objection("camera_untested")
    return better(likeliest)


def fitted_lens(linear: Linearised | None, misfit: Misfit) -> Objection | None:
    """Return a focal length that the residuals of a pose support significantly, if its pose is a different one.

    The pose of the given camera is linearised at the standard deviation of its residuals.
    """
    if linear is None or misfit.zoom == 1:
        return None
    rotation, centre = linear.state.rotation, linear.state.centroid
    fit = fit_lens(linear.problem, rotation, centre, linear.scale)
    return None if fit is None else other_camera(misfit_of(rotation, centre, fit))


def misfit_of(rotation: Array, centre: Array, other: LensFit) -> Misfit:
    """Return the difference between a pose and the pose of another lens.

    `centre` (3,) is the scene centroid in the camera's frame of the pose.
    """
    shift = float(np.linalg.norm(other.centre3d - centre)) / max(float(np.linalg.norm(centre)), 1e-300)
    return Misfit(rotation_angle(rotation, other.rotation), shift, other.zoom, other.radial or 0.0)


class AtZoom(NamedTuple):
    """A hypothesis at another focal length."""

    zoom: float  # focal length over the given one
    problem: Problem  # points of the problem at this focal length
    pose: Hypotheses

    @property
    def centre3d(self) -> Array:
        """Scene centroid (3,) in the camera's frame."""
        return np.asarray(self.pose.rotation[0] @ self.problem.centre3d + self.pose.translation[0])

    @property
    def likelihood(self) -> float:
        """Mean log-likelihood of the bearings, nats, relative to an even density over the view."""
        return float(self.pose.log_likelihood[0]) + math.log(self.problem.image.solid_angle)


def likeliest_zoom(start: AtZoom, scene: SearchFrame) -> AtZoom:
    """Return the likeliest pose at other focal lengths.

    One step is tried to either side. The likelier side is followed while the likelihood grows.
    """
    steps = [(step, search_at_zoom(start, step, scene)) for step in (1 / ZOOM_STEP, ZOOM_STEP)]
    step, best = max(steps, key=lambda one: one[1].likelihood)
    while 1 / WIDEST_ZOOM < best.zoom * step < WIDEST_ZOOM:
        further = search_at_zoom(best, step, scene)
        if further.likelihood <= best.likelihood:
            break
        best = further
    return best


def search_at_zoom(found: AtZoom, zoom: float, scene: SearchFrame) -> AtZoom:
    """Return the likeliest pose at `zoom` times the focal length of a given one, or the given one after the deadline.

    The search starts from the pose that shows the scene at the same size.
    """
    if scene.deadline.passed():
        return found
    problem = at_focal_length(found.problem, zoom)
    there = SearchFrame(problem, 0, scene.settings, scene.deadline)
    shift = found.centre3d * (1, 1, zoom) - found.pose.rotation[0] @ problem.centre3d
    start = Hypotheses.from_poses(*there.enter(found.pose.rotation, shift[None]))
    poses = to_problem_frame(search_around(there, start, AT_FOCAL_STEP)[:1], there)
    return AtZoom(zoom * found.zoom, problem, poses) if len(poses) else found


def _alarms(problem: Problem, other: LensFit) -> float:
    """Return log10 NFA of a pose with its lens counted as unknown."""
    focal = UnknownFocal(2 * math.log(WIDEST_ZOOM))
    rescaled = replace(at_focal_length(problem, other.zoom), focal=focal)
    if other.radial is not None:
        bearings = undistort(problem.bearings, other.zoom, other.radial)
        outermost = float(((bearings[:, :2] / bearings[:, 2:]) ** 2).sum(-1).max())
        focal = focal._replace(radial_sigma=math.inf, radial_range=2 * MOST_BEND / outermost)
        rescaled = replace(problem, bearings=bearings, focal=focal)
    translation = other.centre3d - other.rotation @ problem.centre3d
    return float(alarms_of(rescaled, other.rotation[None], translation[None]).own[0])


def at_focal_length(problem: Problem, zoom: float) -> Problem:
    """Return the problem with its image points at `zoom` times the focal length."""
    bearings = problem.bearings * (1 / zoom, 1 / zoom, 1)
    return replace(problem, bearings=bearings / np.linalg.norm(bearings, axis=-1, keepdims=True))
