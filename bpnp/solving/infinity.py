"""`solve` where the scene points are directions: checked arguments, a search for the rotation, and its `Solution`."""

import math
import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from bpnp.cameras import Camera, camera_from, in_front, zoomed_camera
from bpnp.loops.parallel import Deadline, one_blas_thread
from bpnp.search.evidence.uncertainty import ONE_SIGMA
from bpnp.search.infinity.evidence import Known, how_well_known
from bpnp.search.infinity.kernels import Image
from bpnp.search.infinity.search import search_rotation
from bpnp.search.infinity.settings import DEFAULT, InfinitySettings
from bpnp.solving.arguments import (
    UNIT_NORM,
    Array,
    check_points,
    checked_scores,
    keypoints,
    normalised,
    numbers,
    one_row_each,
    unit_bearings,
)
from bpnp.solving.focal_length import UnknownCamera
from bpnp.solving.matches import SCALES, count_one_to_one, one_to_one
from bpnp.solving.problem import Unit
from bpnp.solving.solution import Candidate, Solution, SolutionStats

FEWEST = 3  # two fix a rotation and are no evidence
NOMINAL = 1e-3  # of the spread of bearings without a camera: what a pixel is taken to be


def refuse_at_infinity(**options: Any) -> None:
    """Raise ValueError for what says nothing of directions."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"expected no `{name}` with `at_infinity`, got {value!r:.60}; try without one of them")


def solve_directions(
    points2d: Any,
    directions: Any,
    camera: Any,
    *,
    unknown: UnknownCamera | None = None,
    scores2d: Any,
    inlier_threshold: float | None,
    seed: int,
    time_limit: float | None,
) -> Solution:
    """The rotation under which unit directions (n, 3) are seen at image points; arguments as for `bpnp.solve`.

    unknown: of a camera whose focal length is looked for: at focal lengths so near to each other that points half an
    image from its middle stay within reach, at a rougher noise; then fitted to the matches, and searched again there.

    Raises ValueError for wrong shapes, fewer than 3 points, directions that are not unit vectors, pixels without a
    camera or the reverse.
    """
    begun, deadline = time.perf_counter(), Deadline.after(time_limit)
    image, scene = keypoints(points2d, ""), one_row_each(numbers("points3d", directions, ""))
    lens = unknown.reference if unknown is not None else None if camera is None else camera_from(camera)
    check_points("points2d", image, (2, 3) if lens is None else (2,), FEWEST, "")
    check_points("points3d", scene, (3,), FEWEST, "")
    length = np.linalg.norm(scene, axis=-1)
    bad = np.flatnonzero(np.abs(length - 1) > UNIT_NORM)
    if len(bad):
        raise ValueError(
            f"expected unit vectors in `points3d` with `at_infinity`, got one of length {length[bad[0]]:g} at point "
            f"{bad[0]}; try to divide by the lengths, or points of a scene without `at_infinity`"
        )
    scene = np.ascontiguousarray(scene / length[:, None])
    scores = checked_scores("scores2d", scores2d, len(image), "")
    known = Given(image, scene, scores, inlier_threshold, seed, begun)
    if unknown is None:
        return _seen_by(lens, known, deadline)
    best = None
    for rung in unknown.ladder(DEFAULT.zoom):
        found = _seen_by(rung, known, deadline, unknown, DEFAULT.of_a_rung())
        camera = rung
        for _ in range(DEFAULT.zoom_rounds if found.verdict != "failed" else 0):
            before, camera = camera.focal, _fitted(camera, known, found)
            found = _seen_by(camera, known, deadline, unknown)
            if not found.found or abs(camera.focal / before - 1) < DEFAULT.zoom_same:
                break
        if best is None or found.log10_false_alarms < best.log10_false_alarms:
            best = found
        if best.verdict == "confident" or deadline.passed():
            break
    assert best is not None  # a ladder has a rung
    return best


class Given(NamedTuple):
    """Of one problem, checked: image points (m, 2), unit directions (n, 3), and options of `bpnp.solve`; when it was
    begun."""

    image: Array
    scene: Array
    scores: Array | None
    inlier_threshold: float | None
    seed: int
    begun: float


def _fitted(camera: Camera, known: Given, solution: Solution) -> Camera:
    """The camera with the focal length that fits the matches best, with a turn beside it."""
    pixels, seen = known.image[solution.matches[:, 0]], known.scene[solution.matches[:, 1]] @ solution.rotation.T

    def residuals(step: Array) -> Array:
        bearings, _, pixel = _bearings(pixels, zoomed_camera(camera, math.exp(step[3])))
        off = bearings - Rotation.from_rotvec(step[:3]).apply(seen)
        return np.asarray((off / pixel[:, None]).ravel())

    return zoomed_camera(camera, math.exp(least_squares(residuals, np.zeros(4), loss="soft_l1", x_scale=0.01).x[3]))


def _with_focal_length(camera: Camera, pixels: Array, seen: Array, known: Known) -> Array:
    """Covariance (4, 4) of the turn and of the focal length, pixels, of matches with directions `seen` (k, 3)."""
    step = 1e-5
    ends = [_bearings(pixels, zoomed_camera(camera, math.exp(sign * step))) for sign in (1, -1)]
    turned = np.cross(np.eye(3)[None], seen[:, None]).swapaxes(1, 2)
    rows = np.concatenate([turned, (ends[1][0] - ends[0][0])[:, :, None] / (2 * step)], -1) / ends[0][2][:, None, None]
    rows = rows.reshape(-1, 4) * [1, 1, 1, 1 / camera.focal]
    free = max(2 * len(seen) - 4, 1)
    return np.asarray((known.noise * stdtrit(free, ONE_SIGMA)) ** 2 * np.linalg.pinv(rows.T @ rows, rcond=1e-15))


def _seen_by(
    lens: Camera | None,
    given: Given,
    deadline: Deadline,
    unknown: UnknownCamera | None = None,
    settings: InfinitySettings = DEFAULT,
) -> Solution:
    """The rotation of a camera. unknown: the cameras of which it is one."""
    image, scene, inlier_threshold = given.image, given.scene, given.inlier_threshold
    unit: Unit = "rad" if image.shape[1] == 3 else "normalised" if lens is None else "px"
    bearings, plane, pixel = _bearings(image, lens)
    usable = np.flatnonzero(np.isfinite(bearings).all(-1) & np.isfinite(pixel))
    if len(usable) < FEWEST:
        raise ValueError(f"expected {FEWEST} or more 2D points that the camera can see, got {len(usable)}")
    bearings, pixel = np.ascontiguousarray(bearings[usable]), np.ascontiguousarray(pixel[usable])
    middle = float(np.median(pixel))  # radians a pixel
    per_radian = 1.0 if lens is None else 1 / middle
    noise = None if inlier_threshold is None else inlier_threshold / per_radian / middle / settings.reach
    with one_blas_thread:
        result = search_rotation(
            Image(bearings, pixel),
            scene,
            scores=None if given.scores is None else given.scores[usable],
            noise=noise if settings is DEFAULT else None,
            zooms=0.0 if unknown is None else math.log(unknown.largest / unknown.smallest),
            seed=given.seed,
            deadline=deadline,
            settings=settings,
        )
    failed = Solution(
        verdict="failed",
        reason=result.reason,
        unit=unit,
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        stats=SolutionStats(result.turns, dropped2d=len(image) - len(usable)),
        seconds=time.perf_counter() - given.begun,
        points2d=plane,
        points3d=scene,
        camera=lens,
    )
    if not result.found:
        return failed
    best, seen = result.found[0], [scene @ one.rotation.T for one in result.found]
    hit = np.flatnonzero(best.match >= 0)
    residual = how_well_known(seen[0][best.match[hit]], bearings[hit], pixel[hit], bearings).noise
    threshold = inlier_threshold or SCALES * residual * middle * per_radian
    matches = one_to_one(bearings, seen[0], threshold / per_radian)
    i, j = matches.T
    known = how_well_known(seen[0][j], bearings[i], pixel[i], bearings)
    covariance = (
        known.covariance
        if unknown is None or lens is None
        else _with_focal_length(lens, image[usable[i]], seen[0][j], known)
    )
    sine = np.linalg.norm(np.cross(bearings[i], seen[0][j]), axis=-1)
    angles = np.arctan2(sine, (bearings[i] * seen[0][j]).sum(-1))
    counts = [len(matches), *(count_one_to_one(bearings, each, threshold / per_radian) for each in seen[1:])]
    return replace(
        failed,
        rotation=best.rotation,
        translation=np.zeros(3),
        matches=np.stack([usable[i], j], -1),
        inlier_count=len(matches),
        inlier_ratio=len(matches) / min(len(image), len(scene)),
        inlier_threshold=threshold,
        reprojection_error=float((angles * per_radian).mean()) if len(matches) else math.nan,
        reprojection_error_deg=float(np.degrees(angles.mean())) if len(matches) else math.nan,
        covariance=np.full_like(covariance, math.nan) if result.verdict == "failed" else covariance,
        candidates=tuple(
            Candidate(
                one.rotation, np.zeros(3), float(one.decades.mean() * math.log(10)), count, one.log10_false_alarms
            )
            for one, count in zip(result.found, counts, strict=True)
        ),
        verdict=result.verdict,
        log10_false_alarms=best.log10_false_alarms,
        stats=SolutionStats(result.turns, residual * middle, result.verdict == "confident", failed.stats.dropped2d),
        seconds=time.perf_counter() - given.begun,
    )


def _bearings(image: Array, camera: Camera | None) -> tuple[Array, Array, Array]:
    """Unit bearings (m, 3) and normalised coordinates (m, 2), NaN where there are none, and radians a pixel (m,)."""
    if camera is None:
        bearings = unit_bearings(image, "") if image.shape[1] == 3 else normalised(image, None, "")
        if image.shape[1] == 2:
            bearings = np.column_stack([bearings, np.ones(len(bearings))])
            bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
        spread = math.sqrt(((bearings - bearings.mean(0)) ** 2).sum(-1).mean())
        return bearings, in_front(bearings)[:, :2], np.full(len(bearings), max(NOMINAL * spread, 1e-12))
    normalised(image, camera, "")  # raises for what are no pixels
    bearings = camera.bearings(image)
    steps = (camera.bearings(image + step) - camera.bearings(image - step) for step in ([0.5, 0.0], [0.0, 0.5]))
    pixel = np.sqrt(sum((step**2).sum(-1) for step in steps) / 2)
    return bearings, in_front(bearings)[:, :2], pixel
