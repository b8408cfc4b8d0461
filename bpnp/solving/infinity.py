"""`solve` for scene points that are directions: argument checks, the search for the rotation, and the `Solution`."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from bpnp.cameras import Camera, camera_from, in_front, scale_focal_length
from bpnp.loops.parallel import Clock, Deadline, one_blas_thread
from bpnp.search.infinity.evidence import how_well_known, noise_of, uncertainty_of
from bpnp.search.infinity.kernels import Image
from bpnp.search.infinity.search import DEFAULT, InfinitySettings, search_rotation
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import UnknownFocal
from bpnp.search.refine.gauss_newton import ImageMatches, Iteration, image_equations, image_rows, refine
from bpnp.solving.arguments import (
    Array,
    check_points,
    check_unit,
    checked_scores,
    image_points,
    scene_points,
    unit_vectors,
)
from bpnp.solving.focal_length import UnknownCamera
from bpnp.solving.inputs import bearings_of, check_seen, unit_of
from bpnp.solving.matches import SCALES, angles_between, count_one_to_one, one_to_one
from bpnp.solving.solution import FOCAL_LENGTH, ROTATION_PARAMETERS, Solution, SolutionStats, with_pose
from bpnp.solving.sources import Options

FEWEST = 3  # two fix a rotation and leave no evidence
HALF = 0.5  # pixels, step for the angle per pixel
ROTATION_AND_FOCAL = PoseModel(np.zeros(3), UnknownFocal(math.inf), moves=False)
ROBUST, LOST = 1.0, 1e3  # residual from which a match counts less, and that of a point that leaves the view, pixels
MOST_STEPS, EXACT = 50, 1e-9  # steps of a fit of the focal length, and the change that ends them
NOMINAL = 1e-3  # nominal pixel without a camera, as a fraction of the RMS angular radius of the bearings


def solve_directions(
    points2d: Any, directions: Any, camera: Any, unknown: UnknownCamera | None, scores2d: Any, options: Options
) -> Solution:
    """Estimate the rotation of a camera from image points and unit directions (n, 3); arguments as for `bpnp.solve`.

    With an unknown focal length a sweep of focal lengths is searched at a coarse noise. Its steps are so small that
    points half an image from the image centre still match. The focal length is then fitted to the matches, and the
    search repeated.

    Args:
        points2d: (m, 2) pixels, or normalised coordinates or bearings (m, 3) without a camera.
        directions: (n, 3) unit directions.
        camera: Camera of the pixels; None without one, or with `unknown`.
        unknown: Camera with an unknown focal length; None if it is known.
        scores2d: (m,) probabilities in (0, 1]; points with the largest ones are tried first. None for no order.
        options: Options of the search.

    Raises:
        ValueError: The shapes are wrong, there are fewer than 3 points, the directions are not unit vectors, or there
            are pixels without a camera or the reverse.
    """
    begun, deadline = Clock.now(), Deadline.after(options.time_limit)
    image, scene = image_points(points2d), scene_points(directions)
    lens = unknown.reference if unknown is not None else None if camera is None else camera_from(camera)
    check_points("points2d", image, (2, 3) if lens is None else (2,), FEWEST)
    check_points("points3d", scene, (3,), FEWEST)
    hint = "divide by the lengths, or leave out `at_infinity` for points of a scene"
    scene = np.ascontiguousarray(unit_vectors("points3d", scene, hint))
    scores = checked_scores("scores2d", scores2d, len(image))

    def seen_by(lens: Camera | None, settings: InfinitySettings = DEFAULT) -> Solution:
        solution = _seen_by(lens, image, scene, scores, unknown, options, deadline, settings)
        return replace(solution, seconds=Clock.now() - begun)

    if unknown is None:
        return seen_by(lens)
    ends = list[Solution]()
    rough = replace(DEFAULT, noise=(DEFAULT.zoom_noise,), least_share=DEFAULT.zoom_share)
    exact = replace(rough, noise=DEFAULT.noise)
    for rung in unknown.ladder(DEFAULT.zoom):
        found, camera = seen_by(rung, rough), rung
        if found.verdict == "failed":  # among many directions unrelated ones fit as well at the coarse noise
            found = seen_by(rung, exact if ends else DEFAULT)
        promising = found.log10_false_alarms <= DEFAULT.zoom_alarms
        for _ in range(DEFAULT.zoom_rounds if promising else 0):
            before, camera = camera.focal, _fitted(camera, image, scene, found)
            again = seen_by(camera)
            if again.log10_false_alarms > found.log10_false_alarms and again.verdict == "failed":
                break
            found = again
            if abs(camera.focal / before - 1) < DEFAULT.zoom_same:
                break
        ends.append(found)
        best = min(ends, key=lambda end: end.log10_false_alarms)
        if best.verdict == "confident" or deadline.passed():
            break
    return best


def _fitted(camera: Camera, image: Array, scene: Array, solution: Solution) -> Camera:
    """Return the camera with the focal length that fits the matches best, fitted together with a rotation."""
    i, j = solution.matches.T
    matches = ImageMatches(camera.project, scene[j], image[i])
    linearise = image_equations(ROTATION_AND_FOCAL, [matches], lost=LOST, robust=ROBUST)
    start = ROTATION_AND_FOCAL.state(solution.rotation)
    end = refine(ROTATION_AND_FOCAL, start, linearise, [ROBUST] * MOST_STEPS, settled=_is_settled)
    return scale_focal_length(camera, float(end.state.zoom))


def _is_settled(last: Iteration) -> bool:
    return bool(np.abs(last.step).max() < EXACT)


def _with_focal_length(camera: Camera, pixels: Array, directions: Array, rotation: Array) -> Array:
    """Return the covariance (4, 4) of rotation and focal length, pixels, from matches of directions (k, 3)."""
    state = ROTATION_AND_FOCAL.state(rotation)
    residual, jacobian = image_rows(ROTATION_AND_FOCAL, ImageMatches(camera.project, directions, pixels), state)
    unit = np.array([1, 1, 1, camera.focal])
    return uncertainty_of(residual, jacobian).covariance * np.outer(unit, unit)


def _seen_by(
    lens: Camera | None,
    image: Array,
    scene: Array,
    scores: Array | None,
    unknown: UnknownCamera | None,
    options: Options,
    deadline: Deadline,
    settings: InfinitySettings,
) -> Solution:
    """Return the solution for one camera, which is one of the sweep if the focal length is unknown."""
    bearings, plane, pixel = _bearings(image, lens)
    inlier_threshold = options.inlier_threshold
    usable = np.flatnonzero(np.isfinite(bearings).all(-1) & np.isfinite(pixel))
    check_seen(usable, image, FEWEST)
    bearings, pixel = np.ascontiguousarray(bearings[usable]), np.ascontiguousarray(pixel[usable])
    middle = float(np.median(pixel))  # radians per pixel
    per_radian = 1.0 if lens is None else 1 / middle
    noise = None if inlier_threshold is None else inlier_threshold / per_radian / middle / settings.reach
    with one_blas_thread:
        result = search_rotation(
            Image(bearings, pixel),
            scene,
            scores=None if scores is None else scores[usable],
            noise=noise if settings is DEFAULT else None,
            zooms=0.0 if unknown is None else math.log(unknown.largest / unknown.smallest),
            seed=options.seed,
            deadline=deadline,
            settings=settings,
        )
    parameters = ROTATION_PARAMETERS if unknown is None else (*ROTATION_PARAMETERS, FOCAL_LENGTH)
    solution = Solution(
        covariance=np.full((len(parameters), len(parameters)), math.nan),
        parameters=parameters,
        verdict=result.verdict,
        reason=result.reason,
        reason_code=result.code,
        unit=unit_of(image, lens),
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        stats=SolutionStats(result.batches, dropped2d=len(image) - len(usable)),
        points2d=plane,
        points3d=scene,
        camera=lens,
    )
    found = result.candidates
    if found.matches is None:
        return solution
    seen = [scene @ rotation.T for rotation in found.rotation]
    hit = np.flatnonzero(found.matches[0] >= 0)
    residual = noise_of(seen[0][found.matches[0, hit]], bearings[hit], pixel[hit])
    threshold = inlier_threshold or SCALES * residual * middle * per_radian
    radius = threshold / per_radian
    i, j = one_to_one(bearings, seen[0], radius).T
    counts = [len(i), *(count_one_to_one(bearings, each, radius) for each in seen[1:])]
    matched = seen[0][j], bearings[i], pixel[i]
    covariance = how_well_known(*matched).covariance
    if unknown is not None and lens is not None:
        covariance = _with_focal_length(lens, image[usable[i]], scene[j], found.rotation[0])
    angles = angles_between(bearings[i], seen[0][j])
    return with_pose(
        solution,
        result,
        found,
        counts,
        np.stack([usable[i], j], -1),
        angles * per_radian,
        angles,
        most=min(len(image), len(scene)),
        threshold=threshold,
        residual=residual * middle,
        covariance=np.full_like(covariance, math.nan) if result.verdict == "failed" else covariance,
    )


def _bearings(image: Array, camera: Camera | None) -> tuple[Array, Array, Array]:
    """Return unit bearings (m, 3), normalised coordinates (m, 2), NaN if undefined, and radians per pixel (m,)."""
    if camera is None:
        bearings, plane = bearings_of(image, None)
        spread = math.sqrt(((bearings - bearings.mean(0)) ** 2).sum(-1).mean())
        return bearings, plane, np.full(len(bearings), max(NOMINAL * spread, 1e-12))
    check_unit(image, camera)
    bearings = camera.bearings(image)
    steps = ((camera.bearings(image + step) - bearings) / HALF for step in ([HALF, 0.0], [0.0, HALF]))
    pixel = np.sqrt(sum((step**2).sum(-1) for step in steps) / 2)
    return bearings, in_front(bearings)[:, :2], pixel
