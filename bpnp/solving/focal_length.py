"""The pose and the focal length of a camera together.

The search tries a ladder of focal lengths: with one that is a quarter off it still ends near the pose of many points.
From there Gauss-Newton steps of the pose and the focal length, and annealing of the pose, in turns, lead to the best of
both, where the search looks again. Its verdict counts the seventh unknown (`bpnp.search.evidence.false_alarms`), wants
the focal length to be known (`Evidence.focal`), and what the other focal lengths of the ladder led to are alternatives.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bpnp.cameras import Camera, camera_from, plain_camera, zoomed_camera
from bpnp.geometry import same_pose, turned_by
from bpnp.loops.parallel import Clock, one_blas_thread
from bpnp.search.annealing import polished
from bpnp.search.enumeration.search import is_enumerable
from bpnp.search.evidence.alternatives import number
from bpnp.search.evidence.partners import with_focal_length
from bpnp.search.point_sets import UnknownFocal
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT as SEARCH
from bpnp.search.verdict import weighed
from bpnp.solving.arguments import Array, checked_size
from bpnp.solving.matches import SCALES, mutual_nearest
from bpnp.solving.problem import Problem
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options, solutions_of

LEAST_BEND = 1e-3  # change of the coefficient that makes another camera
FEWEST_BENT = 30  # matches from which a radial coefficient is looked for
SIGNIFICANT_BEND = 10.8  # chi-squared with one degree of freedom, one in a thousand


@dataclass(frozen=True)
class FocalSettings:
    """Constants of the search for a focal length.

    smallest, largest: that are tried, in larger sides of the image: fields of view of 90 and 19 degrees across it.
    usual: that is tried first. step, step_few: factor from one that is tried to the next, of many points and of few.
    sigmas: of the error of a rough focal length within which it is looked for.
    turns: of the first search with each. alternations: searches and refinements, in turns, from each. rounds: of a
    refinement, until the logarithm moves by less than `same`.
    """

    smallest: float = 0.5
    largest: float = 3.0
    usual: float = 1.0
    step: float = 1.57
    step_few: float = 1.25
    sigmas: float = 3.0
    turns: int = 8
    alternations: int = 3
    rounds: int = 12
    same: float = 5e-4


RULE = FocalSettings()


class UnknownCamera(NamedTuple):
    """A camera whose focal length is `smallest` to `largest` times that of `reference`, most likely `usual` times.

    sigma: standard deviation of the logarithm of the factor, infinite where nothing is expected of it. radial: whether
    the coefficient of a SIMPLE_RADIAL `reference` is looked for too. alone: whether to begin with no other than
    the usual one.
    """

    reference: Camera
    smallest: float
    largest: float
    usual: float
    sigma: float = math.inf
    radial: bool = False
    alone: bool = False

    def focal(self, camera: Camera) -> UnknownFocal:
        """What is known of the focal length of one of these cameras."""
        offset = math.log(camera.focal / self.reference.focal)
        return UnknownFocal(math.log(self.largest / self.smallest), self.sigma, offset)

    def ladder(self, step: float) -> list[Camera]:
        """Cameras with focal lengths no more than `step` apart that cover the range, the usual ones first."""
        below, above = (math.log(end / self.usual) / math.log(step) for end in (self.smallest, self.largest))
        steps = [0] if self.alone else sorted(range(math.ceil(below - 0.51), math.floor(above + 0.51) + 1), key=abs)
        return [zoomed_camera(self.reference, self.usual * step**k) for k in steps]

    def near(self, camera: Camera) -> "UnknownCamera":
        """The same with one of these cameras as the usual one, to begin with alone."""
        zoom = camera.focal / self.reference.focal
        reference = zoomed_camera(camera, self.reference.focal / camera.focal)
        return self._replace(reference=reference, usual=zoom, alone=True)


def unknown_camera(
    camera: Any, image_size: Any, focal_error: float | int | None, distortion: bool = False
) -> UnknownCamera:
    """The camera of images of a size in pixels, or one with about the focal length of `camera`.

    Raises ValueError for a size that is none, for both a camera and a size, and for an error without a camera.
    """
    if distortion and image_size is None:
        raise ValueError("expected `distortion=True` beside an `image_size`, got none; a camera has its distortion")
    if image_size is not None:
        if camera is not None:
            raise ValueError(
                "expected a `camera` or the `image_size` of one with an unknown focal length, got both; try camera=... "
                "with focal_error=0.1 for a focal length that is known to a tenth"
            )
        if focal_error is not None:
            raise ValueError("expected `focal_error` beside a `camera`, got it beside `image_size`; try without")
        width, height = checked_size(image_size)
        side = max(width, height)
        model, radial = ("SIMPLE_RADIAL", (0.0,)) if distortion else ("SIMPLE_PINHOLE", ())
        reference = camera_from((model, width, height, (side, width / 2, height / 2, *radial)))
        return UnknownCamera(reference, RULE.smallest, RULE.largest, RULE.usual, radial=distortion)
    if camera is None:
        raise ValueError("expected a `camera` whose focal length has the `focal_error`, got none; try image_size")
    if focal_error is None or not 0 < focal_error < 1:
        raise ValueError(f"expected `focal_error` above 0 and below 1, a share of the focal length, got {focal_error}")
    widest = math.exp(RULE.sigmas * focal_error)
    return UnknownCamera(camera_from(camera), 1 / widest, widest, 1.0, focal_error)


@one_blas_thread
def solved_with_focal_length(
    problem_at: Callable[[Camera, UnknownFocal], Problem], unknown: UnknownCamera, options: Options
) -> Solution:
    """The solution with the fewest false alarms, pose and focal length, of what `problem_at` makes of a camera."""
    search = _Ladder(problem_at, unknown, options)
    problem = search.problem(unknown.reference)
    if problem.degenerate is not None:
        return solutions_of({0: problem}, options)[0]
    few, most = is_enumerable(problem.sets), options.settings.schedule.turns
    for camera in (ladder := unknown.ladder(RULE.step_few if few else RULE.step)):
        search.climb(camera, min(RULE.turns, most), len(ladder))
        if search.best.verdict == "confident" and not few:
            break
    if search.best.verdict != "confident" and not few and most > RULE.turns and search.best.camera is not None:
        search.climb(search.best.camera, most, 1)
    return replace(search.contested(), seconds=Clock.now() - search.begun)


@dataclass
class _Ladder:
    """Searches with several focal lengths, and the solutions `ends` that each of them led to."""

    problem_at: Callable[[Camera, UnknownFocal], Problem]
    unknown: UnknownCamera
    options: Options
    begun: float = field(default_factory=Clock.now)
    ends: list[Solution] = field(default_factory=list)

    def problem(self, camera: Camera) -> Problem:
        return self.problem_at(camera, self.unknown.focal(camera))

    @property
    def best(self) -> Solution:
        return min(self.ends, key=lambda end: end.log10_false_alarms)

    def climb(self, camera: Camera, turns: int, rungs: int) -> None:
        """Search with a camera, and with those that fit the poses better that are found."""
        found = self._search(camera, turns, rungs)
        for _ in range(RULE.alternations):
            if found.verdict == "failed":
                break
            better, settled = self._refined(found, camera)
            if settled:
                break
            again = self._search(better, turns, rungs)
            if again.log10_false_alarms >= found.log10_false_alarms:
                break
            found, camera = again, better
        self.ends.append(found)

    def _search(self, camera: Camera, turns: int, rungs: int) -> Solution:
        limit = self.options.time_limit
        if limit is not None:
            left = max(limit - (Clock.now() - self.begun), 1e-3)
            limit = left / max(rungs - len(self.ends), 1)
        options = self.options._replace(settings=self.options.settings.limited(turns), time_limit=limit)
        return solutions_of({0: self.problem(camera)}, options)[0]

    def _refined(self, solution: Solution, camera: Camera) -> tuple[Camera, bool]:
        """The camera that fits best near a pose, and whether it is the one that was given."""
        given, moved = camera.focal, False
        rotation, translation, scale = solution.rotation, solution.translation, solution.stats.residual
        problem = self.problem(camera)
        for _ in range(RULE.rounds):
            middle = rotation @ (problem.sets.middle + problem.origin) + translation
            fitted = with_focal_length(problem.sets, rotation, middle, scale)
            if fitted is None or not 1 / RULE.step < camera.focal * fitted.zoom / given < RULE.step:
                break
            camera = zoomed_camera(camera, fitted.zoom)
            problem = self.problem(camera)
            start = fitted.rotation, fitted.middle - fitted.rotation @ problem.sets.middle
            if self.unknown.radial:
                camera, bent = with_radial(problem, camera, *start, scale)
                problem, moved = self.problem(camera) if bent else problem, moved or bent
            scene = Scene(problem.sets, self.options.seed, SEARCH)
            end = weighed(polished(scene, start[0][None], start[1][None], scale), problem.sets)
            rotation, translation, scale = end.rotation[0], end.translation[0], min(scale, float(end.scale[0]))
            translation = translation - rotation @ problem.origin
            if abs(math.log(fitted.zoom)) < RULE.same:
                break
        return camera, not moved and abs(math.log(camera.focal / given)) < RULE.same

    def contested(self) -> Solution:
        """The best solution, ambiguous where another focal length led to a different pose that fits about as well."""
        best, rule = self.best, SEARCH.evidence
        if best.verdict != "confident":
            return best
        middle = np.median(best.points3d, 0)
        for end in self.ends:
            for other in end.candidates if end is not best else ():
                behind = other.log10_false_alarms - best.log10_false_alarms
                rotations = np.stack([best.rotation, other.rotation])
                moved = rotations @ middle + np.stack([best.translation, other.translation])
                shift = rule.other_shift * float(np.linalg.norm(moved[0]))
                if behind < rule.lead and not same_pose(rotations, moved, 0, rule.other_deg, shift)[1]:
                    away = math.degrees(turned_by(best.rotation, other.rotation))
                    zoom = end.focal_length / best.focal_length
                    what = f"with {zoom:.2f} times the focal length a pose {away:.0f} deg away fits about as well"
                    return replace(best, verdict="ambiguous", reason=f"{what} ({number(behind)} times the number)")
        return best


def with_radial(
    problem: Problem, camera: Camera, rotation: Array, translation: Array, scale: float
) -> tuple[Camera, bool]:
    """The SIMPLE_RADIAL camera whose coefficient, fitted to the matches of a pose with pose and focal length, explains
    them significantly better; itself where that is so of none. And whether it is another."""
    radius = SCALES * scale * problem.per_radian
    i, j = mutual_nearest(problem.image, problem.view(rotation, translation), radius, problem.allowed).T
    if len(i) < FEWEST_BENT:
        return camera, False
    plain = cast(dict[str, Any], plain_camera(camera))
    unit = np.r_[np.ones(3), np.full(3, np.linalg.norm(translation)), 1.0, 1.0]

    def at(step: Array) -> Camera:
        focal, *centre, radial = plain["params"]
        return camera_from(plain | {"params": [focal * math.exp(step[6]), *centre, radial + step[7]]})

    def residuals(step: Array) -> Array:
        step = unit * np.pad(step, (0, 8 - len(step)))
        points = problem.sets.points3d[j] @ (Rotation.from_rotvec(step[:3]).as_matrix() @ rotation).T
        seen = at(step).project(points + translation + step[3:6])
        return np.nan_to_num(seen - problem.image[i], nan=1e3 * radius).ravel() / radius

    without, bent = (least_squares(residuals, np.zeros(count), method="lm") for count in (7, 8))
    if 2 * len(i) * math.log(max(without.cost, 1e-300) / max(bent.cost, 1e-300)) < SIGNIFICANT_BEND:
        return camera, False
    return at(np.r_[np.zeros(6), 0.0, bent.x[7]]), bool(abs(bent.x[7]) > LEAST_BEND)
