"""`solve` with a `rig`: argument checks, the search for one pose of all cameras, and the `Solution`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from bpnp.arrays import PoseArrays
from bpnp.cameras import Camera, camera_from
from bpnp.runtime import NEVER, Clock
from bpnp.search.arguments import about, checked_pose, pose_of
from bpnp.search.assemble import Solved, assembled
from bpnp.search.few_points.enumeration import is_enumerable
from bpnp.search.focal_length import FocalSweep, UnknownCamera
from bpnp.search.inputs import problem_from
from bpnp.search.problem import UnknownFocal
from bpnp.search.rig.cameras import Rig
from bpnp.search.rig.poses import search_rig
from bpnp.search.solution import Solution
from bpnp.search.solvers import Options, at_deadline, ending_seconds
from bpnp.search.starts import GravityPrior, PosePrior, Prior
from bpnp.search.verdict.decide import Case, decide
from bpnp.search.verdict.reasons import objection


def prepare_rig(
    points2d: Sequence[Any],
    points3d: Any,
    cameras: Sequence[Any],
    unknown: Sequence[UnknownCamera] | None,
    mounts: Sequence[PoseArrays],
    point_options: Mapping[str, Any],
    options: Options,
    *,
    prior: Prior | None = None,
    scale: bool = False,
) -> Callable[[], Solved]:
    """Check the problem of a rig, and return the function that estimates its pose rig_from_world; see `bpnp.solve`.

    The pose is rig_from_world; `mounts` are the extrinsics cam_from_rig, `unknown` the cameras whose focal length is to
    be fitted. A camera is None for normalised coordinates and bearings. `labels2d` and `scores2d` are lists with one
    array or None per camera. With `scale` that of the scene is estimated too.
    """
    placed = isinstance(prior, PosePrior) and prior.translation is not None and math.isfinite(prior.translation_sigma)
    if scale and placed:
        raise ValueError(
            "`prior` has a `translation_sigma`, but with `scale=True` the unit of the scene is unknown, and with it "
            "the distance of the scene from a camera; use PosePrior(rotation, None, rotation_sigma_deg)"
        )
    points = RigPoints(
        list(points2d),
        points3d,
        list(mounts),
        dict(point_options),
        options.inlier_threshold,
        options.clutter,
        prior,
        is_metric=not scale,
    )
    lenses = [None if camera is None else camera_from(camera) for camera in cameras]
    if unknown is None:
        return partial(_solve, points.rig(lenses), options)
    rig = points.rig([one.reference for one in unknown])
    if any(problem.degenerate is not None for problem in rig.problems):
        return partial(_solve, rig, options)
    sweep = _RigSweep(list(unknown), points, options)
    return partial(sweep.sweep, few=all(is_enumerable(problem) for problem in rig.problems))


@dataclass
class RigPoints:
    """Points of the cameras of a rig, before the camera models are known; arguments as for `prepare_rig`."""

    points2d: list[Any]
    points3d: Any
    mounts: list[PoseArrays]
    point_options: dict[str, Any]
    inlier_threshold: float | None
    clutter: float | None
    prior: Prior | None
    is_metric: bool

    def rig(self, lenses: Sequence[Camera | None], focal: UnknownFocal | None = None) -> Rig:
        """Return the rig with these cameras, and with the prior of a focal length that is fitted."""
        problems = []
        for k, (image, lens) in enumerate(zip(self.points2d, lenses, strict=True)):
            arrays = {name: values[k] if name.endswith("2d") else values for name, values in self.point_options.items()}
            vertical = self.prior if isinstance(self.prior, GravityPrior) else None  # with it, three points fix a pose
            with about(f"camera {k}"):
                problem = problem_from(
                    image, self.points3d, lens, prior=vertical, inlier_threshold=self.inlier_threshold, **arrays
                )
            problems.append(replace(problem, clutter=self.clutter))
        prior = self.prior if self.prior is None else problems[0].prior_from_user(self.prior)
        rig = Rig(problems, self.mounts, is_metric=self.is_metric, prior=prior, lens=focal)
        if not (self.is_metric or rig.apart):
            raise ValueError(
                "all cameras of the `rig` have one centre, which does not determine the scale of the scene; give "
                "cameras with a baseline, or leave out `scale=True`"
            )
        return rig


class _RigSweep(FocalSweep):
    """Focal lengths of the cameras of a rig, which have one factor of those of their references."""

    def __init__(self, unknown: list[UnknownCamera], points: RigPoints, options: Options) -> None:
        self.points, self.every = points, unknown
        first = unknown[0]
        for problem in points.rig([one.reference for one in unknown]).problems:
            first = first.seen_by(problem)
        # A radial coefficient is fitted only with `distortion=True`.
        first = first._replace(radial=0.0) if first.distorted else first._replace(bends=False)
        super().__init__(first, options)

    def rig(self, camera: Camera) -> Rig:
        """Return the rig whose first camera is one of the sweep."""
        zoom, radial = self.unknown.parts(camera)
        return self.points.rig([one.at(zoom, radial) for one in self.every], self.unknown.focal(camera))

    def solve_with(self, camera: Camera, options: Options) -> Solved:
        case, solution = _solve(self.rig(camera), options)
        return Solved(case, replace(solution, camera=camera))

    def refine(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> Camera:
        if zooms != (1.0,):  # the fit of the lens has started at wide scales
            return camera
        rig, first = self.rig(camera), self.unknown.parts(camera)
        unit = 1 / solution.scale
        rotation, shift = rig.problems[0].from_user(solution.rotation, unit * solution.translation)
        zoom, radial = rig.fit_lens(rotation, np.r_[shift, unit], solution.stats.residual)
        return self.unknown.at(first[0] * zoom, radial if self.unknown.bends else None)


def _solve(rig: Rig, options: Options) -> Solved:
    begun, deadline = Clock.now(), NEVER
    reasons = [problem.degenerate for problem in rig.problems if problem.degenerate is not None]
    if reasons:
        case = Case.without_pose(rig.problems[0], objection("degenerate", why=reasons[0]), exhaustive=True)
    else:
        deadline = options.limit().before(ending_seconds(*rig.problems))
        case = search_rig(
            rig,
            clutter=options.clutter,
            seed=options.seed,
            deadline=deadline,
            settings=options.settings,
            progress=options.progress_of(0),
        )
    result = at_deadline(decide(case), options, deadline, Clock.now() - begun)
    solution = assembled(rig, result, inlier_threshold=options.inlier_threshold, deadline=deadline)
    return Solved(case, replace(solution, seconds=Clock.now() - begun))


def mount_from(name: str, value: Any) -> PoseArrays:
    """Return rotation and translation of extrinsics cam_from_rig; see `pose_of` for the forms."""
    pose = pose_of(value, name)
    if pose is None or pose[1] is None:
        wrong = f"has the shape {value.shape}" if hasattr(value, "shape") else f"is {value!r:.80}"
        raise ValueError(
            f"`{name}` {wrong}; give cam_from_rig as (R, t), a matrix (3, 4) or (4, 4), or a pycolmap.Rigid3d"
        )
    return checked_pose(f"{name}.", *pose)
