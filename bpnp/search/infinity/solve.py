"""`solve` for scene points that are directions: argument checks, the search for the rotation, and the `Solution`.

The cameras of a rig see directions from one point, since their distances are negligible. Their bearings, turned into
the axes of the rig, are therefore the bearings of one image.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from bpnp.cameras import Camera, camera_from, in_front
from bpnp.runtime import Clock, Deadline, one_blas_thread
from bpnp.search.arguments import (
    Array,
    Labels,
    about,
    check_points,
    check_unit,
    checked_labels,
    checked_scores,
    image_points,
    scene_points,
    unit_vectors,
)
from bpnp.search.config import INFINITY, MATCHES, InfinitySettings
from bpnp.search.focal_length import FocalSweep, UnknownCamera
from bpnp.search.infinity.evidence import how_well_known, noise_of, prior_information, uncertainty_of
from bpnp.search.infinity.search import search_rotation
from bpnp.search.inputs import bearings_of, check_seen, check_view, unit_of
from bpnp.search.matching import angles_between, count_one_to_one, one_to_one, with_unfinished
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.refine.gauss_newton import ImageMatches, Iteration, image_equations, image_rows, refine
from bpnp.search.solution import FOCAL_LENGTH, ROTATION_PARAMETERS, Solution, SolutionStats, add_pose
from bpnp.search.solvers import Options
from bpnp.search.starts import PosePrior, Prior

FIRST = replace(INFINITY, least_share=INFINITY.first_share)  # of the first search with each focal length
COARSE = replace(FIRST, noise=(INFINITY.coarse_noise,))


class Sky(NamedTuple):
    """Directions and the images of one or more cameras that see them.

    Attributes:
        images: Pixels (m_k, 2), normalised coordinates or bearings (m_k, 3) of each camera.
        camera_rotations: (3, 3) rotations rig = C^T camera of the cameras, as C; None for a single camera.
        lenses: Cameras; None for normalised coordinates and bearings.
        unknown: Cameras with an unknown focal length; None if it is known.
        problem: Annotations and prior of all points, with empty bearings.
        is_distorted: Fit a radial coefficient with the focal length.
    """

    images: list[Array]
    camera_rotations: list[Array] | None
    lenses: list[Camera | None]
    unknown: list[UnknownCamera] | None
    problem: Problem
    is_distorted: bool

    def at(self, zoom: float, radial: float | None) -> "Sky":
        """Return the cameras with `zoom` times the focal lengths of the references and a radial coefficient."""
        return self._replace(lenses=[one.at(zoom, radial) for one in self.unknown or ()])

    @property
    def lens(self) -> tuple[float, float | None]:
        """Zoom and radial coefficient of the cameras with an unknown focal length."""
        assert self.unknown is not None
        assert self.lenses[0] is not None
        return self.unknown[0].parts(self.lenses[0])


def prepare_directions(
    points2d: Sequence[Any],
    directions: Any,
    cameras: Sequence[Any],
    unknown: list[UnknownCamera] | None,
    point_options: Mapping[str, Any],
    options: Options,
    *,
    camera_rotations: list[Array] | None = None,
    prior: Prior | None = None,
    distortion: bool = False,
) -> Callable[[], Solution]:
    """Check a problem of directions, and return the function that estimates the rotation; see `bpnp.solve`.

    Args:
        points2d: Points of each camera.
        directions: (n, 3) unit directions.
        cameras: Camera of each of them; None without one.
        unknown: Cameras with an unknown focal length; None if it is known. All have the same factor of the focal length
            of their reference.
        point_options: Lists of `labels2d` and `scores2d`, one array or None per camera; `labels3d` and `scores3d`. The
            points of a camera without scores have 1 if another camera has scores.
        options: Options of the search.
        camera_rotations: (3, 3) rotations cam_from_rig of the cameras of a rig; None for one camera.
        prior: Prior of the rotation. Its translation is ignored.
        distortion: Fit a radial coefficient with an unknown focal length. Default False.

    Raises:
        ValueError: The shapes are wrong, there are fewer than 3 points, the directions are not unit vectors, or there
            are pixels without a camera or the reverse.
    """
    scene = scene_points(directions)
    lenses: list[Camera | None] = [None if camera is None else camera_from(camera) for camera in cameras]
    if unknown is not None:
        lenses = [one.reference for one in unknown]
    images, annotations = [], []
    is_scored = any(scores is not None for scores in point_options["scores2d"])
    for k, (points, lens) in enumerate(zip(points2d, lenses, strict=True)):
        with about(None if camera_rotations is None else f"camera {k}"):
            image = image_points(points)
            check_points(
                "points2d", image, (2, 3) if lens is None else (2,), INFINITY.fewest if camera_rotations is None else 1
            )
            images.append(image)
            scores = checked_scores("scores2d", point_options["scores2d"][k], len(image))
            annotations.append(
                checked_labels(point_options["labels2d"][k], point_options["labels3d"], (len(image), len(scene)))
                | {"scores2d": np.ones(len(image)) if is_scored and scores is None else scores}
            )
    check_points("points3d", scene, (3,), INFINITY.fewest)
    hint = "divide by the lengths, or leave out `at_infinity` for points of a scene"
    scene = np.ascontiguousarray(unit_vectors("points3d", scene, hint))
    arrays = {name: [each[name] for each in annotations] for name in annotations[0]}
    joined: dict[str, Any] = {
        name: np.concatenate(each) for name, each in arrays.items() if name.endswith("2d") and each[0] is not None
    }
    problem = Problem(
        np.empty((0, 3)),
        scene,
        labels3d=annotations[0].get("labels3d"),
        classes3d=annotations[0].get("classes3d"),
        scores3d=checked_scores("scores3d", point_options["scores3d"], len(scene)),
        clutter=options.clutter,
        prior=prior._replace(translation=None) if isinstance(prior, PosePrior) else prior,
        **joined,
    )
    sky = Sky(images, camera_rotations, lenses, unknown, problem, distortion)
    return partial(_solve, sky, options) if unknown is None else _SkySweep(sky, options).sweep


class _SkySweep(FocalSweep):
    """Focal lengths of cameras that see directions, which have one factor of those of their references.

    A search at a coarse noise comes first. The focal length is fitted to its matches, and then searched with. Many
    directions are not significant at a coarse noise; if this search fails, the given focal length is searched with.

    Args:
        sky: Cameras with an unknown focal length.
        options: Options of the search.
    """

    def __init__(self, sky: Sky, options: Options) -> None:
        assert sky.unknown is not None
        first, *others = sky.unknown
        for image, lens in zip(sky.images, sky.lenses, strict=True):
            reach = np.nanmax(np.linalg.norm(_bearings(image, lens)[1], axis=-1), initial=first.reach)
            first = first._replace(reach=float(reach))
        self.sky = sky._replace(unknown=[first, *others])
        super().__init__(first, options, INFINITY.sweep)

    def preselect(self, camera: Camera) -> Camera:
        sky = self.sky.at(*self.unknown.parts(camera))
        found = _solve(sky, self.options._replace(until=self.deadline), COARSE)
        return camera if found.verdict == "failed" else self.refine(found, camera)

    def solve_with(self, camera: Camera, options: Options) -> Solution:
        settings = FIRST if options.settings.schedule.iterations <= self.constants.iterations else INFINITY
        return _solve(self.sky.at(*self.unknown.parts(camera)), options, settings)

    def refine(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> Camera:
        """Return the camera that fits the matches best; a radial coefficient is fitted with `Sky.is_distorted`."""
        zoom, radial = self.unknown.parts(camera)
        sky = self.sky.at(zoom, radial)
        model = _model(sky)
        if len(solution.matches) < model.fixing:
            return camera
        matches = _in_image(sky, solution.matches)
        linearise = image_equations(model, matches, lost=INFINITY.lost, robust=INFINITY.robust)
        start = model.state(solution.rotation)
        end = refine(model, start, linearise, [INFINITY.robust] * MATCHES.most_steps, settled=_is_settled).state
        return self.unknown.at(zoom * float(end.zoom), float(end.radial) if sky.is_distorted else radial)


def _parts(sky: Sky, matches: Labels) -> list[tuple[int, Array, Array]]:
    """Return the index of each camera with matches, its matched image points and their directions."""
    first = np.cumsum([0, *map(len, sky.images)])
    parts = []
    for k, (start, end) in enumerate(pairwise(first.tolist())):
        i, j = matches[(matches[:, 0] >= start) & (matches[:, 0] < end)].T
        if len(i):
            parts.append((k, sky.images[k][i - start], sky.problem.points3d[j]))
    return parts


def _to_rig(sky: Sky, k: int, bearings: Array) -> Array:
    """Return bearings (m, 3) of camera k in the axes of the rig."""
    return bearings if sky.camera_rotations is None else bearings @ sky.camera_rotations[k]


def _model(sky: Sky) -> PoseModel:
    """Return the unknowns of the fit to given matches: the rotation, the focal length and a radial coefficient."""
    assert sky.unknown is not None
    zoom, radial = sky.lens
    lens = UnknownFocal(
        math.inf, sky.unknown[0].sigma, math.log(zoom), radial or 0.0, math.inf if sky.is_distorted else 0.0
    )
    mounts = None if sky.camera_rotations is None else [(turn, np.zeros(3)) for turn in sky.camera_rotations]
    return PoseModel(np.zeros(3), lens, moves=False, mounts=mounts, prior=sky.problem.prior)


def _in_image(sky: Sky, matches: Labels) -> list[ImageMatches]:
    """Return matches (k, 2) as those of each camera."""
    lenses = [lens for lens in sky.lenses if lens is not None]
    return [ImageMatches(lenses[k].project, points, pixels, k) for k, pixels, points in _parts(sky, matches)]


def _is_settled(last: Iteration) -> bool:
    return bool(np.abs(last.step).max() < INFINITY.settled)


def _with_focal_length(sky: Sky, rotation: Array, matches: Labels) -> Array:
    """Return the covariance (4, 4) of rotation and focal length, pixels, from matches (k, 2); NaN without matches."""
    if not len(matches):
        return np.full((4, 4), math.nan)
    model = _model(sky)
    state = model.state(rotation)
    rows = [image_rows(model, each, state) for each in _in_image(sky, matches)]
    residual, jacobian = map(np.concatenate, zip(*rows, strict=True))
    in_view = np.isfinite(residual).all(-1) & np.isfinite(jacobian).all((-1, -2))
    residual, jacobian = residual[in_view], jacobian[in_view]
    assert sky.lenses[0] is not None
    unit = np.array([1, 1, 1, sky.lenses[0].focal])
    covariance = uncertainty_of(residual, jacobian, model.information(state)).covariance[:4, :4]
    return np.asarray(covariance * np.outer(unit, unit))


def _solve(sky: Sky, options: Options, settings: InfinitySettings = INFINITY) -> Solution:
    """Return the solution for given cameras, which are some of the sweep if the focal length is unknown."""
    begun, deadline = Clock.now(), options.limit()
    inlier_threshold = None if settings is COARSE else options.inlier_threshold
    scene, lens = sky.problem.points3d, sky.lenses[0]
    parts = [_bearings(image, own) for image, own in zip(sky.images, sky.lenses, strict=True)]
    planes = [plane for _, plane, _ in parts]
    every = np.concatenate([_to_rig(sky, k, rays) for k, (rays, _, _) in enumerate(parts)])
    pixel = np.concatenate([pixel for _, _, pixel in parts])
    usable = np.flatnonzero(np.isfinite(every).all(-1) & np.isfinite(pixel))
    check_seen(usable, np.concatenate(planes), INFINITY.fewest)
    focal = None if sky.unknown is None or lens is None else sky.unknown[0].focal(lens)
    problem = replace(sky.problem, bearings=every, focal=focal).choose(usable)
    every, pixel = np.ascontiguousarray(problem.bearings), np.ascontiguousarray(pixel[usable])
    owner = np.concatenate([np.full(len(image), k) for k, image in enumerate(sky.images)])[usable]
    if lens is None:
        spread = math.sqrt(((every - every.mean(0)) ** 2).sum(-1).mean())
        pixel = np.full(len(every), max(INFINITY.nominal * spread, 1e-12))
    median_pixel = np.array([np.median(pixel[owner == k]) if (owner == k).any() else np.nan for k in range(len(parts))])
    per_radian = np.ones(len(parts)) if lens is None else 1 / median_pixel
    one = int(np.nanargmin(median_pixel))  # camera in whose pixels the noise is
    noise = (
        None if inlier_threshold is None else inlier_threshold / per_radian[one] / median_pixel[one] / settings.reach
    )
    with one_blas_thread:
        result = search_rotation(
            replace(problem, bearings=every),
            pixel,
            noise=noise,
            seed=options.seed,
            deadline=deadline,
            settings=settings,
            progress=options.progress_of(0),
        )
    parameters = ROTATION_PARAMETERS if sky.unknown is None else (*ROTATION_PARAMETERS, FOCAL_LENGTH)
    solution = Solution(
        covariance=np.full((len(parameters), len(parameters)), math.nan),
        parameters=parameters,
        verdict=result.verdict,
        reason=result.reason,
        reason_code=result.code,
        seconds=Clock.now() - begun,
        unit=unit_of(sky.images[0], lens),
        inlier_threshold=math.nan if inlier_threshold is None else inlier_threshold,
        stats=SolutionStats(result.batches, dropped2d=problem.dropped2d),
        points2d=np.concatenate(planes),
        points_per_camera=None if sky.camera_rotations is None else tuple(map(len, planes)),
        points3d=scene,
        camera=lens if sky.camera_rotations is None or sky.unknown is not None else None,
    )
    found = result.candidates
    if found.matches is None:
        return solution
    rotated = [scene @ rotation.T for rotation in found.rotation]
    hit = np.flatnonzero(found.matches[0] >= 0)
    residual = noise_of(rotated[0][found.matches[0, hit]], every[hit], pixel[hit])
    threshold = inlier_threshold or MATCHES.reach * residual * float(median_pixel[one] * per_radian[one])
    pairs, counts = _match_in_cameras(problem, rotated, owner, threshold / per_radian, deadline)
    i, j = pairs.T
    matches = np.stack([usable[i], j], -1)
    if sky.unknown is None:
        information = prior_information(problem)
        covariance = how_well_known(rotated[0][j], every[i], pixel[i], information=information).covariance
    else:
        covariance = _with_focal_length(sky, found.rotation[0], matches)
    angles = angles_between(every[i], rotated[0][j])
    solution = add_pose(
        solution,
        result,
        found,
        counts.tolist(),
        matches,
        angles * per_radian[owner[i]],
        angles,
        most=sum(min(len(image), len(scene)) for image in sky.images),
        threshold=threshold,
        residual=residual * float(median_pixel[one]),
        covariance=np.full_like(covariance, math.nan) if result.verdict == "failed" else covariance,
    )
    return with_unfinished(replace(solution, seconds=Clock.now() - begun), deadline)


def _match_in_cameras(
    problem: Problem, rotated: Sequence[Array], owner: Labels, radii: Array, deadline: Deadline
) -> tuple[Labels, Labels]:
    """Match the image points of each camera one to one to rotated directions.

    Args:
        problem: Points of the problem, bearings of all cameras.
        rotated: Directions (n, 3) rotated by each of c rotations.
        owner: Camera (m,) of each bearing.
        radii: Largest angle of a match in each camera, radians.
        deadline: As for `one_to_one`.

    Returns:
        Matches (k, 2) of the first rotation, and the numbers (c,) of matches of all.
    """
    every, pairs, counts = problem.bearings, [], np.zeros(len(rotated), np.int64)
    for k in np.unique(owner).tolist():
        own, radius = np.flatnonzero(owner == k), float(radii[k])

        def may_match(i: Any, j: Any, own: Any = own) -> Any:
            return problem.may_match(own[i], j)

        i, j = one_to_one(every[own], rotated[0], radius, may_match, deadline).T
        pairs.append(np.stack([own[i], j], -1))
        counts += [len(i), *(count_one_to_one(every[own], each, radius, may_match, deadline) for each in rotated[1:])]
    return np.concatenate(pairs), counts


def _bearings(image: Array, camera: Camera | None) -> tuple[Array, Array, Array]:
    """Return unit bearings (m, 3), normalised coordinates (m, 2), NaN if undefined, and radians per pixel (m,).

    Without a camera a pixel is one radian.
    """
    if camera is None:
        bearings, plane = bearings_of(image, None)
        return bearings, plane, np.ones(len(bearings))
    check_unit(image, camera)
    bearings = camera.bearings(image)
    check_view(in_front(bearings)[:, :2], camera)
    step = INFINITY.pixel_step
    steps = ((camera.bearings(image + shift) - bearings) / step for shift in ([step, 0.0], [0.0, step]))
    pixel = np.sqrt(sum((step**2).sum(-1) for step in steps) / 2)
    return bearings, in_front(bearings)[:, :2], pixel
