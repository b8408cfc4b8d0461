"""Pose models: the unknowns of a pose, and all that depends on which numbers are unknown.

The unknowns are the rotation of the scene, the shift of its centroid and, as needed, the logarithm of the focal length,
a radial coefficient and the logarithm of the scale of the scene of a rig. A model has the directions in which cameras
see scene points, their derivatives by the unknowns, steps, the information of priors, and the number of tests of the
NFA (`bpnp.search.verdict.false_alarms`).

Camera k of a rig, camera_k = C_k rig + c_k, has the scene point p at

    c = C_k (R (p - m) + y) + u c_k.

m is the centroid of the scene and y its position in the frame of the rig. A length of 1 of the rig is u in the scene; a
single camera has C = 1 and c = 0. With x = (X, Y) / Z the point appears at z (1 + k |x|^2) x in the image: z is the
focal length over that of the bearings. The bearings were undistorted with the coefficient k_0, so that its direction
is (x', 1) with

    (1 + k_0 |x'|^2) x' = z (1 + k |x|^2) x.

A step (w, s, ...) gives exp([w]x) R and y + s, multiplies z by the exponential of its third part, and so on. All
functions are pure functions of arrays, in float64.

Two compiled loops of proposers have steps of their own. A search spends most of its time in them, and each fixes its
unknowns, its data types and its way to match: `bpnp.search.kernels.dense.move` (a pose in float32, to all points at
once) and `bpnp.search.few_points.matching.step` (a pose of few one-to-one matches on the stereographic plane).
`bpnp.layers.ransac.consensus.refine_locally` is the refinement of RANSAC in the paper's half, in torch: a batch of
samples and poses at once, on its device.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.search.problem import Problem, UnknownFocal, label_groups
from bpnp.search.starts import GravityPrior, PosePrior, Prior

LEAST_SLOPE = 0.2  # least derivative of the distorted by the undistorted radius of a visible point [1; not tuned]
UNDISTORTING_STEPS = 20  # Newton steps that undistort a radius [steps; numerics]

Extrinsics = tuple[Array, Array]


class PoseState(NamedTuple):
    """Values of the unknowns of a pose, or of several poses (...)."""

    rotation: Array  # (..., 3, 3) from the scene to the camera or the rig
    centroid: Array  # (..., 3) of the scene, in the frame of the camera or the rig
    zoom: Any = 1.0  # focal length over that of the bearings
    radial: Any = 0.0
    unit: Any = 1.0  # length of 1 of the rig, in units of the scene


class Sight(NamedTuple):
    """Scene points (..., n) as one camera sees them."""

    turned: Array  # (..., n, 3) from the centroid of the scene, in the axes of the camera
    camera: Array  # (..., n, 3) in the frame of the camera
    directions: Array  # (..., n, 3) unit directions; NaN for points beyond the largest radius of the camera model
    length: Array  # (..., n) length of the camera's points, with X and Y times `stretch`
    stretch: Array | None  # (..., n) |x'| / |x|; None if it is 1 for all

    def choose(self, chosen: Any) -> "Sight":
        """Return some of the points, by indices or a mask."""
        return Sight(*(None if each is None else each[chosen] for each in self))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class PoseModel:
    """The unknowns of a pose.

    >>> model = PoseModel(np.zeros(3), UnknownFocal(2.0, sigma=0.1))
    >>> model.columns
    {'rotation': slice(0, 3, None), 'shift': slice(3, 6, None), 'log_focal': slice(6, 7, None)}
    >>> model.size, model.fixing
    (7, 4)
    """

    centre: Array  # (3,) point of the scene about which it rotates, its centroid
    # Prior of an unknown focal length. A radial coefficient is unknown if its `radial_sigma` is not 0. None for a given
    # camera.
    lens: UnknownFocal | None = None
    scale: bool = False  # the scale of a rig's scene is unknown
    # Extrinsics (C_k, c_k) of the cameras of a rig; None for a single camera.
    mounts: Sequence[Extrinsics] | None = None
    prior: Prior | None = None  # prior of the pose of the camera or the rig

    @classmethod
    def of(cls, problem: Problem) -> "PoseModel":
        """Return the model of one camera with the points and the priors of a problem."""
        return cls(problem.centre3d, problem.focal, prior=problem.prior)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Name of each unknown, and its columns in a step."""
        bends = self.lens is not None and self.lens.radial_sigma > 0
        sizes = {
            "rotation": 3,
            "shift": 3,
            "log_focal": int(self.lens is not None),
            "radial": int(bends),
            "log_scale": int(self.scale),
        }
        found, first = dict[str, slice](), 0
        for name, size in sizes.items():
            if size:
                found[name] = slice(first, first + size)
                first += size
        return found

    @cached_property
    def size(self) -> int:
        """Number p of unknowns, the degrees of freedom."""
        return sum(columns.stop - columns.start for columns in self.columns.values())

    @property
    def fixing(self) -> int:
        """Number of matches of one camera that fix the unknowns: each match fixes two.

        The scale of a rig's scene, and a radial coefficient that is known from elsewhere, do not count.
        """
        known = "radial" in self.columns and self.lens is not None and math.isfinite(self.lens.radial_sigma)
        return -(-(self.size - self.scale - known) // 2)

    def state(self, rotation: Array, translation: Array) -> PoseState:
        """Return the state of poses (..., 3, 3), (..., 3), homogeneous (..., 4) for a rig, with the given camera."""
        radial = 0.0 if self.lens is None else self.lens.radial
        centroid = rotation @ self.centre + translation[..., :3]
        unit = 1.0 if self.mounts is None else translation[..., 3]
        return PoseState(rotation, centroid, radial=radial, unit=unit)

    def pose(self, state: PoseState) -> tuple[Array, Array]:
        """Return rotation (..., 3, 3) and translation (..., 3) of states; (..., 4) for a rig."""
        translation = state.centroid - state.rotation @ self.centre
        if self.mounts is not None:
            units = np.broadcast_to(np.asarray(state.unit)[..., None], (*translation.shape[:-1], 1))
            translation = np.concatenate([translation, units], -1)
        return state.rotation, translation

    def sight(self, state: PoseState, points: Array, k: int = 0) -> Sight:
        """Return points (n, 3) of the scene as camera k sees them."""
        turned = (points - self.centre) @ np.swapaxes(state.rotation, -1, -2)
        camera = turned + state.centroid[..., None, :]
        if self.mounts is not None:
            turn, shift = self.mounts[k]
            turned, camera = turned @ turn.T, camera @ turn.T
            camera = camera + np.asarray(state.unit)[..., None, None] * shift
        stretch = self._stretch(state, camera)
        seen = (
            camera if stretch is None else np.concatenate([camera[..., :2] * stretch[..., None], camera[..., 2:]], -1)
        )
        length = np.maximum(np.linalg.norm(seen, axis=-1), 1e-300)
        return Sight(turned, camera, seen / length[..., None], length, stretch)

    def directions(self, state: PoseState, points: Array, k: int = 0) -> Array:
        """Return the unit directions (..., n, 3) of points (n, 3) in camera k; NaN beyond the camera model."""
        return self.sight(state, points, k).directions

    def jacobian(self, state: PoseState, sight: Sight, k: int = 0) -> Array:
        """Return the derivatives (..., n, 3, p) of the directions of camera k by the unknowns."""
        seen, reference = sight.directions, 0.0 if self.lens is None else self.lens.radial
        by_point = across(seen) / sight.length[..., None, None]
        squared, radial = None, reference
        if sight.stretch is not None:
            stretch = sight.stretch[..., None, None]
            by_point = by_point * np.concatenate([stretch, stretch, np.ones_like(stretch)], -1)
            if state.radial or reference:
                x = sight.camera[..., :2] / sight.camera[..., 2:]
                squared, radial = (x**2).sum(-1), state.radial
                _, slope = _radii(seen, reference)
                bend = 2 * (radial - reference * sight.stretch**2) / ((1 + radial * squared) * slope)
                along = np.concatenate([x, -squared[..., None]], -1) / sight.camera[..., 2:]
                by_point = by_point + _outwards(seen)[..., None] * (bend[..., None] * along)[..., None, :]
        columns = [self.by_pose(sight, by_point, k)]
        if self.lens is not None:
            columns.append(_lens_columns(seen, reference, squared, radial, bends="radial" in self.columns))
        if self.scale and self.mounts is not None:
            columns.append(by_point @ (-np.asarray(state.unit)[..., None] * self.mounts[k][1])[..., None, :, None])
        return np.concatenate(columns, -1) if len(columns) > 1 else columns[0]

    def by_pose(self, sight: Sight, by_point: Array, k: int = 0) -> Array:
        """Convert derivatives (..., n, d, 3) by points in the frame of camera k to those by rotation and shift.

        They are (..., n, d, 6).
        """
        (x, y, z), (u, v, w) = (np.moveaxis(each, -1, 0) for each in (sight.turned[..., None, :], by_point))
        columns = [np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1), by_point]
        if self.mounts is not None:
            columns = [each @ self.mounts[k][0] for each in columns]
        return np.concatenate(columns, -1)

    def moved(self, state: PoseState, step: Array) -> PoseState:
        """Return the state after a step (..., p)."""
        columns = self.columns
        changed: dict[str, Any] = {
            "rotation": Rotation.from_rotvec(step[..., :3]).as_matrix() @ state.rotation,
            "centroid": state.centroid + step[..., columns["shift"]],
        }
        if "log_focal" in columns:
            changed["zoom"] = state.zoom * np.exp(step[..., columns["log_focal"].start])
        if "radial" in columns:
            changed["radial"] = state.radial + step[..., columns["radial"].start]
        if "log_scale" in columns:
            changed["unit"] = state.unit * np.exp(-step[..., columns["log_scale"].start])
        return state._replace(**changed)

    def information(self, state: PoseState) -> Array:
        """Return the information (p, p) of the priors; those of a rig count once for all its cameras."""
        columns, information = self.columns, np.zeros((self.size, self.size))
        if self.lens is not None:
            for name, sigma in (("log_focal", self.lens.sigma), ("radial", self.lens.radial_sigma)):
                if name in columns:
                    information[columns[name], columns[name]] = 1 / sigma**2
        if isinstance(self.prior, GravityPrior):
            up, _ = self.prior.directions()
            information[:3, :3] = (np.eye(3) - np.outer(up, up)) / math.radians(self.prior.sigma_deg) ** 2
        elif isinstance(self.prior, PosePrior):
            information[:3, :3] = np.eye(3) / math.radians(self.prior.rotation_sigma_deg) ** 2
            if self.prior.translation is not None:
                by_origin = np.concatenate([crossed(state.rotation @ self.centre), np.eye(3)], 1)
                information[:6, :6] += by_origin.T @ by_origin / self.prior.translation_sigma**2
        return information

    def lens_prior(self, state: PoseState) -> tuple[Array, Array]:
        """Return information (p, p) and gradient (p,) of the prior of the focal length, for steps towards it.

        The priors of the pose draw the poses from which a search starts. Steps do not follow them.
        """
        information, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        if self.lens is not None and math.isfinite(self.lens.sigma):
            at = self.columns["log_focal"].start
            information[at, at] = self.lens.sigma**-2
            gradient[at] = -(self.lens.offset + math.log(state.zoom)) / self.lens.sigma**2
        return information, gradient

    def log10_tests(self, problems: Sequence[Problem]) -> float:
        """Return log10 of the number T of tests with the points of all cameras, which propose poses independently.

        The tests of a camera are the choices of as many matches as fix the unknowns, or those of a given lens for each
        distinguishable lens if they are fewer. `Problem.log10_tried` replaces their number if it is set. An unknown
        scale of the scene takes one match more, of any two points of a camera. A prior does not change the number; see
        `Problem.log10_prior_fraction`.
        """
        alone = [self._log10_tests_of(problem) for problem in problems]
        tests = alone[0] if len(alone) == 1 else math.log10(sum(10**one for one in alone))
        if self.scale:
            tests += math.log10(sum(len(each.bearings) * len(each.points3d) for each in problems))
        return tests

    def _log10_tests_of(self, problem: Problem) -> float:
        if problem.log10_tried is not None:
            return problem.log10_tried
        tests = self.log10_choices(problem)
        if self.lens is None:
            return tests
        image, given = problem.image, replace(self, lens=None)
        return min(tests, given.log10_choices(problem) + float(log10_lenses(self.lens, image.spread, image.scales)[0]))

    def log10_choices(self, problem: Problem) -> float:
        """Return log10 of the number of states that fit as many matches as fix the unknowns, for all choices of them.

        It is 2 (m)_k (n)_k / k! with k = `fixing`, about two for each choice of three or four matches. Labels, if
        given, have to agree.
        """
        m, n = len(problem.bearings), len(problem.points3d)
        choices = math.prod((m - i) * (n - i) / (i + 1) for i in range(self.fixing))
        if problem.labels2d is not None and problem.labels3d is not None:
            groups = label_groups(np.arange(m), problem.labels2d, problem.labels3d, n)
            agreeing = sum(len(rows) * len(columns) for rows, columns in groups)
            choices = min(choices, math.prod((agreeing - i) / (i + 1) for i in range(self.fixing)))
        return math.log10(2 * max(choices, 1.0))

    def log10_cells(self, spread: float, scales: Array, solid_angle: float = 4 * math.pi) -> Array:
        """Return log10 (S,) of the number of distinguishable states, cells of width s, at each scale s of an image.

        With h the RMS angular radius of the image points, radians, and A the solid angle of the view, steradians, it is
        the number of:
        - 8 pi^2 (h / s)^3 rotations about the scene centroid, which move points at h from it by s,
        - A / s^2 positions of the centroid in the view,
        - log(30) h / s distances of it, up to a factor of 30.

        Each is multiplied by the number of distinguishable lenses (`log10_lenses`).
        """
        relative = spread / scales
        cells = 8 * math.pi**2 * relative**4 * (solid_angle / scales**2) * math.log(30)
        return np.asarray(np.log10(np.maximum(cells, 1.0)) + log10_lenses(self.lens, spread, scales))

    def fixing_ways(self, cameras: int = 1, apart: Iterable[tuple[int, int]] = ()) -> list[list[int]]:
        """Return the ways to choose matches that fix the unknowns, each as their number in each camera.

        One camera of a pair with a non-zero baseline, `apart`, has the match that fixes the scale.
        """
        one = np.eye(cameras, dtype=np.int64)
        if not self.scale:
            return (self.fixing * one).tolist()
        pairs = list(apart)
        return [(self.fixing * one[k] + one[j]).tolist() for k, j in (*pairs, *(pair[::-1] for pair in pairs))]

    def _stretch(self, state: PoseState, camera: Array) -> Array | None:
        """Return |x'| / |x| (..., n) of points (..., n, 3); NaN beyond the camera model. None if all are 1."""
        lens = self.lens
        if lens is None or (np.all(state.zoom == 1) and np.all(state.radial == lens.radial)):
            return None
        zoom = np.asarray(state.zoom)[..., None]
        if "radial" not in self.columns and lens.radial == state.radial == 0:
            return np.broadcast_to(zoom, camera.shape[:-1])
        ahead = camera[..., 2] > 0
        squared = (camera[..., :2] ** 2).sum(-1) / np.where(ahead, camera[..., 2], np.inf) ** 2
        visible = ahead & (1 + 3 * state.radial * squared > LEAST_SLOPE)
        stretch = np.where(visible, zoom * (1 + state.radial * squared), np.nan)
        if lens.radial:
            radius = stretch * np.sqrt(squared)
            stretch = stretch * np.where(radius > 0, true_radius(radius, lens.radial) / np.maximum(radius, 1e-300), 1.0)
        return np.asarray(stretch)


def across(seen: Array) -> Array:
    """Return the projections (..., 3, 3) onto the planes perpendicular to directions (..., 3)."""
    return np.asarray(np.eye(3) - seen[..., :, None] * seen[..., None, :])


def crossed(vector: Array) -> Array:
    """Return the cross-product matrix (3, 3) of a vector (3,)."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def lens_columns(seen: Array, radial: float) -> Array:
    """Return the derivatives (..., 3, 2) of directions (..., 3) by log focal length and radial coefficient k.

    With y = (1 + k |x|^2) x fixed by the image, dx = x (1 + k |x|^2) / (1 + 3 k |x|^2) d log f, and dx = x |x|^2 / (1 +
    3 k |x|^2) dk. The camera model is the one with which the bearings were undistorted.
    """
    return _lens_columns(seen, radial, None, radial)


def lens_error_columns(seen: Array, radial: float) -> Array:
    """Return the derivatives (..., 3, 5) of directions by parameters of the camera model that are not fitted.

    These are the principal point, in focal lengths, the tangential coefficients p1 and p2 (Brown 1966) and the second
    radial coefficient k2, as in OpenCV's camera model. A step of them moves the image y = (1 + k r^2) x of x = (X, Y),
    Z = 1, r = |x|, by

        (1, 0), (0, 1), (2 X Y, r^2 + 2 Y^2), (r^2 + 2 X^2, 2 X Y), r^4 x.

    A motion dy of the image moves x by (dy - 2 k x (x^T dy) / (1 + 3 k r^2)) / (1 + k r^2), k the radial coefficient
    with which the bearings were undistorted. The derivatives are 0 behind the camera.

    Source: D. C. Brown, Decentering distortion of lenses, Photogrammetric Engineering 1966.
    """
    ahead = seen[..., 2:] > 0
    x = np.where(ahead, seen[..., :2] / np.where(ahead, seen[..., 2:], 1.0), 0.0)
    squared, slope = (each[..., None, None] for each in _radii(seen, radial))
    both = 2 * x[..., :1] * x[..., 1:]
    own = squared[..., 0] + 2 * x**2
    tangential = np.stack([np.concatenate(pair, -1) for pair in ((both, own[..., 1:]), (own[..., :1], both))], -1)
    centre = np.broadcast_to(np.eye(2), tangential.shape)
    moved = np.concatenate([centre, tangential, squared**2 * x[..., None]], -1)
    outwards = x[..., :, None] * (x[..., None, :] @ moved)
    moved = (moved - 2 * radial / slope * outwards) / (1 + radial * squared)
    return np.asarray(across(seen)[..., :2] @ moved * np.maximum(seen[..., 2], 0.0)[..., None, None])


def undistort(bearings: Array, zoom: float, radial: float) -> Array:
    """Convert bearings (m, 3) of a distorted camera to those of a pinhole with 1 / zoom times its focal length.

    >>> x = np.array([[0.6, 0.3, 1.0]])
    >>> bent = x * [[1.2 * (1 - 0.2 * 0.45)] * 2 + [1]]
    >>> back = undistort(bent / np.linalg.norm(bent), 1.2, -0.2)
    >>> np.round(back / back[:, 2:], 9).tolist()
    [[0.6, 0.3, 1.0]]
    """
    seen = bearings[:, :2] / bearings[:, 2:] / zoom
    radius = np.linalg.norm(seen, axis=-1)
    shrunk = true_radius(radius, radial) / np.maximum(radius, 1e-300)
    rays = np.column_stack([seen * shrunk[:, None], np.ones(len(seen))])
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def true_radius(radius: Array, radial: float) -> Array:
    """Solve r (1 + k r^2) = radius, in focal lengths, by Newton steps; NaN stays NaN.

    r is at most the largest radius of the camera model.
    """
    most = math.sqrt((1 - LEAST_SLOPE) / (-3 * radial)) if radial < 0 else math.inf
    true = np.minimum(radius, most)
    for _ in range(UNDISTORTING_STEPS):
        slope = np.maximum(1 + 3 * radial * true**2, LEAST_SLOPE)
        true = np.clip(true - (true * (1 + radial * true**2) - radius) / slope, 0.0, most)
    return np.asarray(true)


def _radii(seen: Array, radial: float) -> tuple[Array, Array]:
    """Return |x'|^2 (...) of directions (..., 3), 0 behind the camera, and the derivative of the image radius."""
    ahead = seen[..., 2] > 0
    squared = (seen[..., :2] ** 2).sum(-1) / np.where(ahead, seen[..., 2], 1.0) ** 2 * ahead
    return squared, np.maximum(1 + 3 * radial * squared, LEAST_SLOPE)


def _outwards(seen: Array) -> Array:
    """Return the derivatives (..., 3) of directions (..., 3) by the logarithm of their distance from the axis."""
    flat = seen * (1, 1, 0)
    return np.asarray(flat - seen * (flat * flat).sum(-1, keepdims=True))


def _lens_columns(seen: Array, reference: float, squared: Array | None, radial: float, *, bends: bool = True) -> Array:
    """Return the derivatives (..., 3, 2) of directions by log focal length and by radial coefficient.

    The bearings were undistorted with the radial coefficient `reference`; `squared` is |x|^2 of the points, None for
    |x'|^2 of the directions. Unless it `bends`, the result is (..., 3, 1), without those by the coefficient.
    """
    outwards = _outwards(seen)[..., None]
    if not (bends or reference):
        return outwards
    own, slope = _radii(seen, reference)
    squared = own if squared is None else squared
    by_focal = outwards * ((1 + reference * own) / slope)[..., None, None]
    return np.concatenate([by_focal, by_focal * (squared / (1 + radial * squared))[..., None, None]], -1)[
        ..., : 1 + bends
    ]


def log10_lenses(lens: UnknownFocal | None, spread: float, scales: Array) -> Array:
    """Return log10 (S,) of the number of distinguishable lenses at each scale s of an image, radians.

    It is 0 for a given lens. A focal length moves points at the RMS angular radius h by h d log f, a radial coefficient
    by h^3 dk.
    """
    if lens is None:
        return np.zeros(len(scales))
    moved = lens.log_range * spread, lens.radial_range * spread**3
    return np.asarray(sum(np.log10(np.maximum(each / scales, 1.0)) for each in moved))
