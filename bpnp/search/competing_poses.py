"""Competing poses of a confident pose: those of a repeated structure, and those of other lenses.

They are proposed from the leader and from the scene, refined and scored like any other pose, and the verdict is then
computed again with them among the candidates (`judge_with_competitors`).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import rotation_angle
from bpnp.runtime import NEVER, Deadline
from bpnp.search.config import Evidence, OtherFocal
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.pose_model import undistort
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.density_map import search_around
from bpnp.search.propose.lens import LensFit, fit_lens
from bpnp.search.propose.repetitions import repeated_poses, repetition_margins
from bpnp.search.refine.annealing import anneal_to_end
from bpnp.search.search_frame import Scene
from bpnp.search.verdict.competitors import other_camera
from bpnp.search.verdict.decide import SearchResult, add_false_alarms, is_symmetric, judge, match_count
from bpnp.search.verdict.false_alarms import alarms_of, likeliest_scale
from bpnp.search.verdict.reasons import Objection, Unfinished, objection
from bpnp.search.verdict.uncertainty import Linearised, Misfit, bends_significantly, linearised, systematic_misfit

Array = NDArray[np.float64]
SceneOf = Callable[[], Scene]


def judge_with_competitors(
    result: SearchResult,
    problem: Problem,
    scene_of: SceneOf,
    settings: Evidence,
    *,
    local_searches: float | int = 0,
    exhaustive: bool = False,
    enumerated: bool = False,
    deadline: Deadline = NEVER,
) -> SearchResult:
    """Judge a confident pose again with its competing poses among the candidates.

    A better pose of a repeated structure becomes the best one, and its competing poses are proposed in turn. If the
    deadline of the scene passes before all of them are refined, the verdict is "ambiguous" at best. The given
    camera is accepted unless another lens, whose parameters count as unknowns, has fewer false alarms by the factor
    `settings.focal_chance`.

    Args:
        result: Verdict; returned unchanged unless it is confident.
        problem: Points of the problem.
        scene_of: Function that returns the scene for refinements; it is called only if one is needed.
        settings: Constants of the verdict.
        local_searches: Number of local searches around the best pose that found no better one.
        exhaustive: True if every pose was tried.
        enumerated: True if the competing poses of a repeated structure are among the candidates already.
        deadline: Deadline of the scene, after whose end nothing more is tested.

    Returns:
        The verdict, with the competing poses among its candidates.
    """
    untested = False
    while result.verdict == "confident":
        if deadline.ended(Unfinished.competing_poses):
            untested = True
            break
        competitors = repeated_competitors(
            result, problem, scene_of, settings, enumerated=enumerated, deadline=deadline
        )
        if not len(competitors):
            untested = Unfinished.competing_poses in deadline.unfinished
            break
        # Then not all of them were refined.
        untested = not enumerated and deadline.passed(Unfinished.competing_poses)
        candidates, leader = Hypotheses.concatenate([result.candidates, competitors]), result.best[1]
        result = judge(
            candidates,
            problem,
            batches=result.batches,
            local_searches=local_searches,
            exhaustive=exhaustive,
            settings=settings,
        )
        if np.array_equal(result.best[1], leader):
            break
    if untested and result.verdict == "confident":
        return result.add_objection(objection("untested"))
    other = other_lens(result, problem, scene_of, settings, deadline) if result.verdict == "confident" else None
    return result if other is None else result.add_objection(other)


def repeated_competitors(
    result: SearchResult,
    problem: Problem,
    scene_of: SceneOf,
    settings: Evidence,
    *,
    enumerated: bool = False,
    deadline: Deadline = NEVER,
) -> Hypotheses:
    """Return the competing poses of a repeated structure, refined, with their NFA.

    Their NFA is at most that of the leader times the factor by which they explain the image points worse
    (`repetition_margins`). Poses that were enumerated are refined already, but for those that a prior excluded. They
    are scored again under the assumption that the map may end anywhere, which makes them likelier.

    Args:
        result: Confident verdict.
        problem: Points of the problem.
        scene_of: Function that returns the scene for the refinement.
        settings: Constants of the verdict.
        enumerated: True if they are among the candidates already.
        deadline: Deadline, after whose end none is proposed.

    Returns:
        Competing poses; none if the verdict does not depend on them.
    """
    if enumerated and not is_symmetric(result.candidates, problem, settings):
        return Hypotheses.empty()
    best = result.best
    # The scale at which the annealing ended may be coarser than that of the residuals.
    scale = result.residual if enumerated else min(result.residual, likeliest_scale(problem, *best))
    scale = max(scale, problem.image.scales[0])
    least = settings.repetitions.symmetric if enumerated else 0.0
    repeated, sizes, motions = repeated_poses(problem, *best, scale, settings, least=least, deadline=deadline)
    if not len(repeated) or deadline.ended(Unfinished.competing_poses):
        return repeated[:0]
    poses, limits, rigid = (repeated.rotation, repeated.translation), settings.repetitions, sizes == 1
    if enumerated:
        limits = replace(limits, most_missing=1e-12)
    if enumerated and problem.prior is None:
        refined = repeated
    else:
        refined = add_false_alarms(anneal_to_end(scene_of(), *poses, scale), problem)
    others, fraction = (refined.rotation, refined.translation), float(motions.fraction.min(initial=1.0))
    shifted = poses[0][rigid], poses[1][rigid]
    behind = repetition_margins(problem, best, shifted, others, scale, limits, fraction=fraction)
    # If the pose is wrong, a motion maps nearly all of its matches; of a lattice it may not be among these.
    behind = np.maximum(behind, 0) if motions.left_out < limits.hiding else np.zeros(len(refined))
    if enumerated and (behind >= settings.margin).all():
        return Hypotheses.empty()
    alarms = np.minimum(refined.log10_false_alarms, result.log10_false_alarms + behind)
    return replace(refined, log10_false_alarms=alarms)


def other_lens(
    result: SearchResult, problem: Problem, scene_of: SceneOf, settings: Evidence, deadline: Deadline = NEVER
) -> Objection | None:
    """Return another lens with which a different pose fits better than the best one, or None.

    Better means fewer false alarms by the factor `focal_chance`, with focal length and radial coefficient counted as
    unknowns. The lens is fitted from the best pose. If three matches may be coincidences, it is also fitted from the
    likeliest pose at other focal lengths. If the time limit prevents this, the result reports it.

    Args:
        result: Confident verdict on the best pose.
        problem: Points of the problem.
        scene_of: Function that returns the scene, whose settings and deadline are used.
        settings: Constants of the verdict.
        deadline: Deadline of the scene.
    """
    if problem.focal is not None:
        return None
    if deadline.ended(Unfinished.focal_lengths):
        return objection("camera_untested")
    count, (rotation, translation) = match_count(result.candidates), result.best
    linear = linearised(problem, rotation, translation, result.residual)
    other = fitted_lens(linear, count, settings)
    if other is not None or count < settings.other_focal.fewest:
        return other
    if result.residual < problem.image.scales[0]:
        linear = linearised(problem, rotation, translation, problem.image.scales[0])
    centre = rotation @ problem.centre3d + translation
    starts = (None, 0.0) if bends_significantly(linear, count, settings) else (None,)

    def better(found: AtZoom) -> Objection | None:
        least = max(float(found.pose.scale[0]), found.problem.image.scales[0])
        fits = (fit_lens(found.problem, found.pose.rotation[0], found.centre3d, least, start) for start in starts)
        others = [fit._replace(zoom=found.zoom * fit.zoom) for fit in fits if fit is not None]
        alarms = [_alarms(problem, other, settings) for other in others]
        if min(alarms, default=math.inf) >= result.log10_false_alarms + math.log10(settings.focal_chance):
            return None
        return other_camera(misfit_of(rotation, centre, others[int(np.argmin(alarms))]), settings)

    if deadline.ended(Unfinished.focal_lengths):
        return objection("camera_untested")
    leader = AtZoom(1.0, problem, result.candidates[:1])
    other = better(leader)
    if other is not None or settings.independent * result.log10_false_alarms / count <= settings.missed:
        return other
    likeliest = None if deadline.passed() else likeliest_zoom(leader, scene_of(), settings.other_focal)
    if likeliest is None or deadline.passed(Unfinished.focal_lengths):
        return objection("camera_untested")
    return better(likeliest)


def fitted_lens(linear: Linearised | None, count: float, settings: Evidence) -> Objection | None:
    """Return a focal length that the residuals of a pose support significantly, if its pose is a different one.

    Args:
        linear: Pose of a given camera from `linearised`, at the standard deviation of its residuals; or None.
        count: Number of its matches.
        settings: Constants of the verdict.
    """
    if linear is None or systematic_misfit(linear, count, settings).zoom == 1:
        return None
    rotation, centre = linear.state.rotation, linear.state.centroid
    fit = fit_lens(linear.problem, rotation, centre, linear.scale)
    return None if fit is None else other_camera(misfit_of(rotation, centre, fit), settings)


def misfit_of(rotation: Array, centre: Array, other: LensFit) -> Misfit:
    """Return the difference between a pose and the pose of another lens.

    Args:
        rotation: (3, 3) of the pose.
        centre: (3,) scene centroid in its camera's frame.
        other: Fitted lens with its pose.
    """
    shift = float(np.linalg.norm(other.centre3d - centre)) / max(float(np.linalg.norm(centre)), 1e-300)
    return Misfit(rotation_angle(rotation, other.rotation), shift, other.zoom, other.radial or 0.0)


class AtZoom(NamedTuple):
    """A hypothesis at another focal length.

    Attributes:
        zoom: Focal length over the given one.
        problem: Points of the problem at this focal length.
        pose: One hypothesis.
    """

    zoom: float
    problem: Problem
    pose: Hypotheses

    @property
    def centre3d(self) -> Array:
        """Scene centroid (3,) in the camera's frame."""
        return np.asarray(self.pose.rotation[0] @ self.problem.centre3d + self.pose.translation[0])

    @property
    def likelihood(self) -> float:
        """Mean log-likelihood of the bearings, nats, relative to an even density over the view."""
        return float(self.pose.log_likelihood[0]) + math.log(self.problem.image.solid_angle)


def likeliest_zoom(start: AtZoom, scene: Scene, settings: OtherFocal) -> AtZoom:
    """Return the likeliest pose at other focal lengths.

    One step is tried to either side. The likelier side is followed while the likelihood grows.

    Args:
        start: Pose at the given focal length.
        scene: Scene whose settings and deadline are used.
        settings: Constants of the steps.
    """
    steps = [(step, search_at_zoom(start, step, scene)) for step in (1 / settings.step, settings.step)]
    step, best = max(steps, key=lambda one: one[1].likelihood)
    while 1 / settings.widest < best.zoom * step < settings.widest:
        further = search_at_zoom(best, step, scene)
        if further.likelihood <= best.likelihood:
            break
        best = further
    return best


def search_at_zoom(found: AtZoom, zoom: float, scene: Scene) -> AtZoom:
    """Return the likeliest pose at `zoom` times the focal length of a given one, or the given one after the deadline.

    The search starts from the pose that shows the scene at the same size.

    Args:
        found: Pose at its focal length.
        zoom: Factor on this focal length.
        scene: Scene whose settings and deadline are used.
    """
    if scene.deadline.passed():
        return found
    problem = at_focal_length(found.problem, zoom)
    there = Scene(problem, 0, scene.settings, scene.deadline)
    shift = found.centre3d * (1, 1, zoom) - found.pose.rotation[0] @ problem.centre3d
    start = Hypotheses.from_poses(*there.enter(found.pose.rotation, shift[None]))
    poses = to_problem_frame(search_around(there, start, scene.settings.focal_step)[:1], there)
    return AtZoom(zoom * found.zoom, problem, poses) if len(poses) else found


def _alarms(problem: Problem, other: LensFit, settings: Evidence) -> float:
    """Return log10 NFA of a pose with its lens counted as unknown."""
    lens = UnknownFocal(2 * math.log(settings.other_focal.widest))
    rescaled = replace(at_focal_length(problem, other.zoom), focal=lens)
    if other.radial is not None:
        bearings = undistort(problem.bearings, other.zoom, other.radial)
        outermost = float(((bearings[:, :2] / bearings[:, 2:]) ** 2).sum(-1).max())
        lens = lens._replace(radial_sigma=math.inf, radial_range=2 * settings.other_focal.bend / outermost)
        rescaled = replace(problem, bearings=bearings, focal=lens)
    translation = other.centre3d - other.rotation @ problem.centre3d
    return float(alarms_of(rescaled, other.rotation[None], translation[None]).own[0])


def at_focal_length(problem: Problem, zoom: float) -> Problem:
    """Return the problem with its image points at `zoom` times the focal length."""
    bearings = problem.bearings * (1 / zoom, 1 / zoom, 1)
    return replace(problem, bearings=bearings / np.linalg.norm(bearings, axis=-1, keepdims=True))
