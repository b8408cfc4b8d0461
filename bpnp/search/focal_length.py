"""Joint estimation of the pose and the focal length of a camera.

The search tries a sweep of focal lengths. With many points it still ends near the pose if the focal length is a quarter
off. From there, Gauss-Newton steps of pose and focal length alternate with annealing of the pose. The search then runs
again at the optimum. Its NFA counts the focal length as a seventh unknown (`bpnp.search.verdict.false_alarms`), and a
confident pose needs a well-determined focal length (`FOCAL_BOUND`). The solutions of the other focal lengths of the
sweep are competing poses.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.cameras import (
    Camera,
    Lens,
    camera_from,
    camera_to_json,
    check_centre,
    is_pinhole,
    scale_focal_length,
    with_radial_distortion,
)
from bpnp.poses import SAME, close_poses, polar_coordinates, rotation_angle
from bpnp.runtime import NEVER, Clock, Deadline, one_blas_thread
from bpnp.search.arguments import checked_size
from bpnp.search.assemble import Solved, with_unfinished
from bpnp.search.few_points.enumeration import is_enumerable
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.propose.lens import fit_lens
from bpnp.search.refine.annealing import anneal_to_end
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.solution import FOCAL_LENGTH, ROTATION_PARAMETERS, Solution
from bpnp.search.solvers import Options, solve_problems
from bpnp.search.verdict.competitors import FAR_TOLERANCES
from bpnp.search.verdict.decide import match_count, rank_poses
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import TESTS, Objection, Unfinished, objection, undecided
from bpnp.search.verdict.rivals.lens import FEWEST_MATCHES, MOST_BEND, ZOOM_STEP
from bpnp.search.verdict.uncertainty import FOCAL_CHANCE, is_within

ProblemAt = Callable[[Camera, UnknownFocal], Problem]
RADIAL_PLACES = {"SIMPLE_RADIAL": 3, "OPENCV": 4}  # index of the radial coefficient in the parameters of a camera model
AROUND = (1.0, ZOOM_STEP, 1 / ZOOM_STEP)  # focal lengths around one that has converged [factors; derived]
# Lengths in the image are relative to the larger image side, distortions to the distance from the principal point.
SMALLEST_FOCAL = 0.5  # least focal length that is tried: a field of view of 90 degrees [image sides; convention]
LARGEST_FOCAL = 3.0  # largest focal length that is tried: a field of view of 19 degrees [image sides; convention]
USUAL_FOCAL = 1.0  # focal length that is tried first [image sides; convention]
# Four steps lead from the smallest to the largest.
FOCAL_STEP = 1.57  # factor between successive focal lengths, for many points [factor; not tuned]
FOCAL_STEP_FEW = 1.25  # factor between focal lengths, for few points and for photos in maps [factor; not tuned]
FOCAL_SIGMAS = 3.0  # half width of the range of an approximate focal length [standard deviations; convention]
FIRST_ITERATIONS = 8  # iterations of the first search with each focal length [iterations; not tuned]
ALTERNATIONS = 3  # largest number of alternations of search and refinement from each focal length [rounds; not tuned]
PROMISING_ALARMS = -math.inf  # largest log10 NFA of a failed search whose poses are refined [decades; not tuned]
REFINEMENT_ITERATIONS = 12  # largest number of iterations of a refinement [iterations; numerics]
SAME_FOCAL_NATS = 5e-4  # change of the logarithm of the focal length below which a refinement stops [nats; numerics]
# Radial displacements at the image corner from which a fit of the distortion also starts. Started at zero distortion,
# too few points match to reach a large one.
BENDS = (-0.2, 0.2)  # [fractions; not tuned]
# Standard deviation of the radial displacement at the image corner by an unknown distortion.
BEND_SIGMA = 0.05  # [fraction; not tuned]
# Standard deviation of the principal point, as a fraction of the distance to the image corner: about a quarter of a per
# cent of the larger image side.
CENTRE_SIGMA = 0.004  # [fraction; not tuned]
# Standard deviation of the displacement at the image corner by a tangential coefficient, as a fraction of the distance
# to the corner. It was chosen on statue_of_liberty, whose map has one camera for photos of many.
TANGENTIAL_SIGMA = 0.002  # [fraction; calibration]
# Standard deviation of the displacement at the image corner by the second radial coefficient, as a fraction of the
# distance to the corner.
QUARTIC_SIGMA = 0.01  # [fraction; not tuned]
LEAST_REACH = 1e-3  # smallest distance from the principal point to the image corner [focal lengths; numerics]


class UnknownCamera(NamedTuple):
    """A camera with an unknown focal length, and an unknown distortion if the reference has none."""

    reference: Camera  # camera that the others are variants of
    smallest: float  # least focal length, over that of the reference
    largest: float  # largest focal length, over that of the reference
    usual: float  # focal length to try first, over that of the reference
    sigma: float = math.inf  # standard deviation of the logarithm of the focal length; infinite without a prior
    bends: bool = False  # fit a radial distortion as an alternative. The reference is then a pinhole camera
    distorted: bool = False  # fit a radial coefficient even if it is not significantly better
    radial: float | None = None  # radial coefficient to start with; None to start without distortion
    alone: bool = False  # start with the usual focal length only
    # Distance from the principal point to the image corner, in focal lengths of the reference. Without an image size it
    # is that of the outermost image point.
    reach: float = 0.0

    def at(self, zoom: float, radial: float | None = None) -> Camera:
        """Return the camera with `zoom` times the focal length of the reference and a radial coefficient."""
        camera = scale_focal_length(self.reference, zoom)
        return camera if radial is None else with_radial_distortion(camera, radial)

    def parts(self, camera: Camera) -> tuple[float, float | None]:
        """Return the zoom and the radial coefficient of one of these cameras; None without distortion."""
        zoom = camera.focal / self.reference.focal
        if not self.bends or is_pinhole(camera) or not isinstance(camera, Lens):
            return zoom, None
        return zoom, float(camera.camera.params[RADIAL_PLACES[camera.camera.model.name]])

    def outermost(self, zoom: float) -> float:
        """Return the reach in focal lengths of the camera with `zoom` times that of the reference."""
        return max(self.reach / zoom, LEAST_REACH)

    def focal(self, camera: Camera) -> UnknownFocal:
        """Return the prior of the focal length and distortion of one of these cameras."""
        zoom, radial = self.parts(camera)
        sigma = math.inf if radial is not None else BEND_SIGMA if self.bends else 0.0
        return UnknownFocal(
            math.log(self.largest / self.smallest),
            self.sigma,
            math.log(zoom),
            radial or 0.0,
            radial_sigma=sigma / self.outermost(zoom) ** 2,
            radial_range=0.0 if radial is None else 2 * MOST_BEND / self.outermost(zoom) ** 2,
            centre_sigma=CENTRE_SIGMA * self.outermost(zoom),
            tangential_sigma=TANGENTIAL_SIGMA / self.outermost(zoom),
            quartic_sigma=QUARTIC_SIGMA / self.outermost(zoom) ** 4,
        )

    def focal_steps(self, step: float) -> list[Camera]:
        """Return cameras with focal lengths at most a factor `step` apart that cover the range, the usual one first."""
        below, above = (math.log(end / self.usual) / math.log(step) for end in (self.smallest, self.largest))
        steps = [0] if self.alone else sorted(range(math.ceil(below - 0.51), math.floor(above + 0.51) + 1), key=abs)
        return [self.at(self.usual * step**k, self.radial) for k in steps]

    def near(self, camera: Camera) -> "UnknownCamera":
        """Return a copy that starts with one of these cameras only."""
        zoom, radial = self.parts(camera)
        return self._replace(usual=zoom, radial=radial, alone=True)

    def seen_by(self, problem: Problem) -> "UnknownCamera":
        """Return a copy with the reach of the image points of a problem whose camera is the reference."""
        outermost = float(np.linalg.norm(problem.measured.plane[problem.measured.indices], axis=-1).max())
        return self._replace(reach=max(self.reach, outermost))


def unknown_camera(
    camera: Any, image_size: Any, focal_error: float | int | None, distortion: bool = False
) -> UnknownCamera:
    """Return the unknown camera of images of a size in pixels, or one with about the focal length of a camera.

    The relative standard deviation `focal_error` of this focal length is between 0 and 1. Radial distortion is unknown
    too, unless the camera has a model with distortion; with `distortion` a coefficient is always fitted. ValueError if
    the size is invalid, for both a camera and a size, an error without a camera, or `distortion` for a known lens.
    """
    if distortion and image_size is None and focal_error is None:
        raise ValueError(
            "`distortion=True` needs an `image_size`, or a `focal_error` with the `camera`; a given camera already "
            "has its distortion"
        )
    if image_size is not None:
        if camera is not None:
            check_centre(camera_from(camera), checked_size(image_size))
            raise ValueError(
                "`camera` and `image_size` exclude each other: `image_size` is for an unknown focal length. For one "
                "that is known to a tenth give `camera` and focal_error=0.1"
            )
        if focal_error is not None:
            raise ValueError(
                "`focal_error` needs a `camera` and has no meaning with `image_size`; leave one of them out"
            )
        width, height = checked_size(image_size)
        reference = camera_from(("SIMPLE_PINHOLE", width, height, (max(width, height), width / 2, height / 2)))
        return UnknownCamera(
            reference,
            SMALLEST_FOCAL,
            LARGEST_FOCAL,
            USUAL_FOCAL,
            bends=True,
            distorted=bool(distortion),
            reach=math.hypot(width, height) / 2 / max(width, height),
        )
    if camera is None:
        raise ValueError(
            "`focal_error` needs the `camera` whose focal length it is about; without one give `image_size`"
        )
    if focal_error is None or not 0 < focal_error < 1:
        raise ValueError(f"`focal_error` is {focal_error}; it is a fraction of the focal length, above 0 and below 1")
    widest, lens = math.exp(FOCAL_SIGMAS * focal_error), camera_from(camera)
    if distortion and not is_pinhole(lens):
        raise ValueError(
            f"`distortion=True` needs a pinhole `camera`; the distortion of {camera_to_json(lens)} is known"
        )
    bends = is_pinhole(lens)
    return UnknownCamera(lens, 1 / widest, widest, 1.0, focal_error, bends=bends, distorted=bool(distortion))


@one_blas_thread
def solve_with_focal_length(problem_at: ProblemAt, unknown: UnknownCamera, options: Options) -> Solved:
    """Return the solution with the fewest false alarms over pose and focal length."""
    problem = problem_at(unknown.reference, unknown.focal(unknown.reference))
    if problem.degenerate is not None:
        return solve_problems({0: problem}, options)[0]
    return _OneCamera(unknown.seen_by(problem), options, problem_at=problem_at).sweep(few=is_enumerable(problem))


@dataclass
class FocalSweep(ABC):
    """Searches with several focal lengths.

    Attributes:
        unknown: Camera with an unknown focal length.
        options: Options of the searches.
        deadline: Deadline of the sweep; none before it.
        ends: Final solution of each focal length so far.
    """

    unknown: UnknownCamera
    options: Options
    deadline: Deadline = NEVER
    ends: list[Solved] = field(default_factory=list)

    @abstractmethod
    def solve_with(self, camera: Camera, options: Options) -> Solved:
        """Return the solution with a given camera."""

    @abstractmethod
    def refine(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> Camera:
        """Return the camera that fits best near a pose, from some factors of the focal length of a camera."""

    def preselect(self, camera: Camera) -> Camera:
        """Return the camera to search with at a focal length of the sweep, by default this one."""
        return camera

    def sweep(self, *, few: bool = False) -> Solved:
        """Return the solution with the fewest false alarms; `few` is True for points that are enumerated."""
        most, begun = self.options.settings.iterations, Clock.now()
        self.deadline = self.options.limit()
        for camera in (focal_steps := self.unknown.focal_steps(FOCAL_STEP_FEW if few else FOCAL_STEP)):
            self.search_from(self.preselect(camera), min(FIRST_ITERATIONS, most), len(focal_steps))
            if self.best.case.objection is None and not few:
                break
            if len(self.ends) < len(focal_steps) and self.deadline.passed(Unfinished.focal_lengths):
                break
        if (
            self.best.case.objection is not None
            and not few
            and most > FIRST_ITERATIONS
            and self.best.solution.camera is not None
            and not self.deadline.passed(Unfinished.focal_lengths)
        ):
            self.search_from(self.best.solution.camera, most, 1)
        best = self.best
        if best.case.objection is None:
            best = best.against(self.other_focal_length())
        if best.case.objection is None and few and Unfinished.focal_lengths in self.deadline.unfinished:
            best = best.against(objection("camera_untested"))
        unfinished = self.deadline.unfinished & {Unfinished.search, *TESTS}
        solution = replace(with_unfinished(best.solution, self.deadline), seconds=Clock.now() - begun)
        is_open = best.case.objection is not None and bool(unfinished)
        if is_open and not self.options.is_part and self.options.time_limit is not None:
            solution = replace(solution, reason=undecided(solution.reason, self.options.time_limit))
        return Solved(best.case, solution)

    @property
    def best(self) -> Solved:
        return min(self.ends, key=lambda end: end.solution.log10_false_alarms)

    def search_from(self, camera: Camera, iterations: int, steps: int) -> None:
        """Search with a camera, then with cameras that fit the found poses better."""
        found = self._search(camera, iterations, steps)
        for _ in range(ALTERNATIONS):
            solution = found.solution
            if solution.verdict == "failed" and solution.log10_false_alarms > PROMISING_ALARMS:
                break
            better, settled = self._refined(solution, camera)
            if settled:  # a better optimum may lie at a slightly different focal length
                better, settled = self._refined(solution, camera, AROUND)
            if self.deadline.passed(Unfinished.focal_lengths):
                found = found.against(objection("camera_untested")) if found.case.objection is None else found
                break
            if settled:
                break
            again = self._search(better, iterations, steps)
            if again.solution.log10_false_alarms >= solution.log10_false_alarms:
                break
            found, camera = again, better
        self.ends.append(found)

    def _search(self, camera: Camera, iterations: int, steps: int) -> Solved:
        """Search with a camera, in an equal part of the time that is left for the focal lengths."""
        waiting = max(steps - len(self.ends), 1)
        settings = self.options.settings.limited(iterations)
        return self.solve_with(camera, self.options._replace(settings=settings, until=self.deadline.share(1 / waiting)))

    def _refined(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> tuple[Camera, bool]:
        """Return the camera that fits best near a pose, and True if it equals the given one."""
        if self.deadline.passed(Unfinished.focal_lengths):
            return camera, False
        fitted = self.refine(solution, camera, zooms)
        (zoom, radial), (before, old) = self.unknown.parts(fitted), self.unknown.parts(camera)
        bend = abs((radial or 0.0) - (old or 0.0)) * self.unknown.outermost(zoom) ** 2
        return fitted, max(abs(math.log(zoom / before)), bend) < SAME_FOCAL_NATS

    def other_focal_length(self) -> Objection | None:
        """Return another focal length with a different pose that fits about as well as the best solution, or None.

        A pose within the uncertainty of the best solution does not count as different.
        """
        best = self.best.solution
        centre = np.median(best.points3d, 0)
        for end in (each.solution for each in self.ends):
            for other in end.candidates if end is not best else ():
                behind = other.log10_false_alarms - best.log10_false_alarms
                rotations = np.stack([best.rotation, other.rotation])
                scales = np.array([[best.scale], [other.scale]])  # to the unit of the translations
                moved = scales * (rotations @ centre) + np.stack([best.translation, other.translation])
                zoom = end.focal_length / best.focal_length
                if (
                    behind < LEAST_MARGIN
                    and not close_poses(rotations, polar_coordinates(moved), 0, *SAME)[1]
                    and not is_within_bound(best, other.rotation, zoom)
                ):
                    away = math.degrees(rotation_angle(best.rotation, other.rotation))
                    return objection("other_focal_length", behind, zoom=zoom, degrees=away)
        return None


@dataclass
class _OneCamera(FocalSweep):
    """Focal lengths of one camera."""

    problem_at: ProblemAt = field(kw_only=True)

    def solve_with(self, camera: Camera, options: Options) -> Solved:
        return solve_problems({0: self.problem_at(camera, self.unknown.focal(camera))}, options)[0]

    def refine(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> Camera:
        pose, scale = (solution.rotation, solution.translation), solution.stats.residual
        fit = partial(fit_camera, self.problem_at, self.unknown, camera, pose, scale, self.options.seed, zooms)
        return fit(deadline=self.deadline).camera


def is_within_bound(solution: Solution, rotation: Array, zoom: float) -> bool:
    """Return True if a rotation and `zoom` times the focal length are within the 99.9 % bound of a solution.

    A rotation difference of more than `FAR_TOLERANCES` times the limit of the same pose is outside, whatever the bound.
    """
    turn = Rotation.from_matrix(rotation @ solution.rotation.T).as_rotvec()
    if math.degrees(float(np.linalg.norm(turn))) > FAR_TOLERANCES * SAME.degrees:
        return False
    chosen = [solution.parameters.index(name) for name in (*ROTATION_PARAMETERS, FOCAL_LENGTH)]
    unit = np.array([1.0, 1.0, 1.0, 1 / solution.focal_length])  # covariance of the logarithm of the focal length
    covariance = solution.covariance[np.ix_(chosen, chosen)] * np.outer(unit, unit)
    return is_within(np.r_[turn, math.log(zoom)], covariance, 2 * len(solution.matches) - len(solution.parameters))


class FittedCamera(NamedTuple):
    """A camera fitted to a pose, its problem, and the pose (1,) in the frame of the problem."""

    camera: Camera
    problem: Problem
    poses: Hypotheses

    @property
    def log10_false_alarms(self) -> float:
        return float(self.poses.log10_false_alarms[0])


def fit_camera(
    problem_at: ProblemAt,
    unknown: UnknownCamera,
    camera: Camera,
    pose: tuple[Array, Array],
    scale: float,
    seed: int,
    zooms: Sequence[float] = (1.0,),
    *,
    deadline: Deadline = NEVER,
) -> FittedCamera:
    """Fit focal length, distortion and pose to the points, starting from a pose in the user's frame and a camera.

    The residuals have the scale `scale`, radians. Of several factors of the focal length and of the distance to start
    from, `zooms`, the fit with the fewest false alarms is used. The camera with radial distortion competes with the one
    without. It is used if its NFA, which counts the additional unknown, is smaller by the factor `FOCAL_CHANCE`. After
    the deadline no fit begins and no step is taken.
    """
    zoom, radial = unknown.parts(camera)

    def fit(starts: list[tuple[float, float | None]]) -> FittedCamera:
        fits = list[FittedCamera]()
        for z, k in starts:
            if fits and deadline.passed(Unfinished.focal_lengths):
                break
            fits.append(_fit_track(problem_at, unknown, (zoom * z, k), pose, scale, seed, z, deadline))
        return min(fits, key=lambda one: one.log10_false_alarms)

    plain = fit([(each, None) for each in zooms])
    few = min(len(plain.problem.bearings), len(plain.problem.points3d)) < FEWEST_MATCHES
    if unknown.bends and not few and not deadline.passed(Unfinished.focal_lengths):
        others = [] if radial is not None else [each / unknown.outermost(zoom) ** 2 for each in BENDS]
        bent = fit([*((each, radial or 0.0) for each in zooms), *((1.0, each) for each in others)])
        matches = match_count(bent.poses)
        lead = math.inf if unknown.distorted else math.log10(FOCAL_CHANCE)
        if matches >= FEWEST_MATCHES and bent.log10_false_alarms < plain.log10_false_alarms + lead:
            return bent
    return plain


def _fit_track(
    problem_at: ProblemAt,
    unknown: UnknownCamera,
    start: tuple[float, float | None],
    pose: tuple[Array, Array],
    scale: float,
    seed: int,
    farther: float,
    deadline: Deadline,
) -> FittedCamera:
    """Alternate fits of the lens and annealing of the pose, from a zoom and a radial coefficient.

    None for no distortion. The scene is `farther` times as far away as in the pose, which is in the user's frame with
    residuals of `scale` radians.
    """
    first, radial = start
    zoom, camera = first, unknown.at(*start)
    problem = problem_at(camera, unknown.focal(camera))
    rotation, translation = problem.from_user(*pose)
    centre = (rotation @ problem.centre3d + translation) * (1, 1, farther)
    translation = centre - rotation @ problem.centre3d
    end = _anneal_pose(problem, rotation, translation, scale, seed, deadline)
    for _ in range(REFINEMENT_ITERATIONS):
        if deadline.passed(Unfinished.focal_lengths):
            break
        pinhole = unknown.at(zoom)
        flat = problem if radial is None else problem_at(pinhole, unknown.focal(pinhole))
        centre = rotation @ flat.centre3d + translation
        fitted = fit_lens(flat, rotation, centre, scale, radial)
        if fitted is None or not 1 / FOCAL_STEP < zoom * fitted.zoom / first < FOCAL_STEP:
            break
        bend = abs((fitted.radial or 0.0) - (radial or 0.0)) * unknown.outermost(zoom) ** 2
        if bend > MOST_BEND:
            break
        zoom, radial, camera = zoom * fitted.zoom, fitted.radial, unknown.at(zoom * fitted.zoom, fitted.radial)
        problem = problem_at(camera, unknown.focal(camera))
        rotation = fitted.rotation
        end = _anneal_pose(problem, rotation, fitted.centre3d - rotation @ problem.centre3d, scale, seed, deadline)
        rotation, scale = end.rotation[0], min(scale, float(end.scale[0]))
        translation = end.translation[0]
        if max(abs(math.log(fitted.zoom)), bend) < SAME_FOCAL_NATS:
            break
    return FittedCamera(camera, problem, end)


def _anneal_pose(
    problem: Problem, rotation: Array, translation: Array, scale: float, seed: int, deadline: Deadline
) -> Hypotheses:
    scene = SearchFrame(problem, seed, DEFAULT, deadline)
    return rank_poses(anneal_to_end(scene, rotation[None], translation[None], scale), problem)[:1]
