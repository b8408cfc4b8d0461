"""Record of the points of a problem: image points and scene points, with their annotations and the priors of the pose.

The scene is divided by its size once, where a `Problem` is made. No later step depends on the unit or on the origin of
the scene; `to_user` converts a pose to the user's coordinates.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array, Labels
from bpnp.poses import MIN_POINTS, SAME, Tolerance, rotation_angle, same_pose
from bpnp.search.image_statistics import ImageStatistics
from bpnp.search.measured import UNMEASURED, Measured
from bpnp.search.starts import GravityPrior, PosePrior, Prior

BULK = 20.0  # distance beyond which scene points do not affect origin and unit [median distances; not tuned]
TWO_MATCH_DEG = 5.0  # largest deviation of a rotation prior with which two matches fix a pose [degrees; not tuned]
# Largest motion of the image points by the tilt with which two matches fix a pose.
TWO_MATCH_TILT = 2.0  # [match radii; not tuned]
MATCH_RADIUS = 3e-3  # radius of a match if the pixel size is unknown [radians; not tuned]
MATCH_FLOORS = 30.0  # radius of a match if it is known: 3 pixels for a floor of a tenth [noise floors; convention]
EQUALLY_NEAR_SIGMAS = 2.0  # width of a prior within which all poses are equally near [standard deviations; convention]
LOG_DEPTHS = math.log(30.0)  # log of the farthest over the nearest possible distance of a scene [nats; convention]
PAIRS_A_POINT = 32  # largest number of pairs per point for which every pair is computed [pairs; cost]
LIKELY_CLASS = 0.1  # least likelihood of a possible match by its classes, relative to a mean match [ratio; not tuned]
LINE_RATIO = 1e-6  # second extent of points over the first, below which they lie on a line [ratio; numerics, float32]
LEAST_SIGMA = 1e-6  # least standard deviation of a translation of a prior [size of the scene; numerics, float64]
WIDEST_SIGMA = 1e9  # standard deviation of a translation above which it is unknown [size of the scene; numerics]

OF_IMAGE = "bearings", "labels2d", "scores2d", "odds2d"  # fields with one row per image point
OF_SCENE = "points3d", "normals3d", "labels3d", "cosines3d", "scores3d", "classes3d"  # one row per scene point


class UnknownFocal(NamedTuple):
    """Prior of a camera model whose focal length is fitted with the pose."""

    log_range: float  # logarithm of the largest over the smallest possible focal length
    sigma: float = math.inf  # standard deviation of the logarithm of the focal length; infinite without a prior
    offset: float = 0.0  # logarithm of the focal length of these bearings over the expected one
    radial: float = 0.0  # radial coefficient k of the camera model with which the bearings were undistorted
    radial_sigma: float = 0.0  # standard deviation of k; 0 if the distortion is given, infinite if k is fitted
    radial_range: float = 0.0  # range of possible k; 0 if k is not fitted
    centre_sigma: float = 0.0  # standard deviation of the principal point, in focal lengths. It is not fitted
    tangential_sigma: float = 0.0  # standard deviation of the tangential coefficients. They are not fitted
    quartic_sigma: float = 0.0  # standard deviation of the second radial coefficient, of r^4. It is not fitted


@dataclass(frozen=True, eq=False)
class Problem:
    """Unmatched image points and scene points of a search, with their annotations and the priors of the pose.

    `Problem.of` makes one from the user's coordinates. Poses are those of the scene in unit size, camera = R p + t;
    `from_user` and `to_user` convert them. `bpnp.datamodules.Problem` is one of a data set, with matches and true pose.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> points = 1000 * rng.uniform(-1, 1, (20, 3)) + [5000, 0, 0]
        >>> seen = points - [5000, 0, -4000]
        >>> problem = Problem.of(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
        >>> round(float((problem.points3d**2).sum(1).mean()), 6)
        1.0
        >>> _, translation = problem.to_user(*problem.from_user(np.eye(3), np.array([-5000, 0, 4000.0])))
        >>> translation.round(6).tolist()
        [-5000.0, 0.0, 4000.0]
    """

    bearings: Array  # (m, 3) unit vectors of the image points, in the camera's frame
    points3d: Array  # (n, 3) scene points, (x - origin) / size of the user's points x
    normals3d: Array | None = None  # (n, 3) outward unit normals; a point that faces away from the camera is not seen
    labels2d: Labels | None = None  # (m,) labels of the image points; only points with equal labels match, -1 fits any
    labels3d: Labels | None = None  # (n,) labels of the scene points
    # (n,) least cosine between a normal and the direction to a camera that sees the point; None for 0. With them the
    # enumeration ignores the normals.
    cosines3d: Array | None = None
    scores2d: Array | None = None  # (m,) probability in (0, 1] that an image point has a match; None for equal ones
    scores3d: Array | None = None  # (n,) probability in (0, 1] that a scene point has a match; None for equal ones
    # Smallest scale of the residuals, radians; None for a fraction of the RMS radius of the bearings.
    floor: float | None = None
    radius: float | None = None  # largest residual of a match in an enumeration, radians; None for that of its settings
    clutter: float | None = None  # fraction of the image points without a match; None if it is unknown
    prior: Prior | None = None  # prior of the pose, in unit size
    # Logarithm of the number of poses that were tried; None for the number that triples of matches give.
    log10_tried: float | None = None
    # (m, c) with `classes3d`: their scalar product is how much likelier a match is by its classes than a mean one. The
    # labels are then those of points whose class is certain.
    odds2d: Array | None = None
    classes3d: Array | None = None  # (n, c) probabilities of the classes
    # Prior of the focal length with which the bearings were computed; None if it is given.
    focal: UnknownFocal | None = None
    # Logarithm of the number of sets of scene points, such as the views of a map, that are tried with these bearings.
    log10_views: float = 0.0
    origin: Array | None = None  # (3,) of the user's coordinates that is the origin here
    size: float = 1.0  # RMS distance of the scene points from it, user's unit
    measured: Measured = UNMEASURED  # the image points as the user measured them; the bearings by default
    given3d: Array | None = None  # the scene points in the user's coordinates; None if they are these
    is_shared: bool = False  # other problems have these image points too: those that this one leaves may be theirs
    network: Any = None  # trained network whose pose is tried first
    baseline: bool = False  # other cameras at known distances see the scene too: a copy of another size looks different

    def __post_init__(self) -> None:
        if self.measured is UNMEASURED:
            object.__setattr__(self, "measured", Measured.of(self.bearings))

    @classmethod
    def of(cls, bearings: Array, points3d: Array, *, prior: Prior | None = None, **attributes: Any) -> "Problem":
        """Make a problem from bearings, and points and a prior in the user's coordinates and unit."""
        bulk = points3d[in_bulk(points3d)]
        bulk = bulk if np.ptp(bulk, axis=0).any() else points3d
        origin = bulk.mean(0)
        size = float(np.sqrt(((bulk - origin) ** 2).sum(-1).mean())) or 1.0
        problem = cls(bearings, points3d, origin=origin, size=size, given3d=points3d, **attributes)
        known_pose = None if prior is None else problem.prior_from_user(prior)
        return replace(problem, points3d=problem.points_from_user(points3d), prior=known_pose)

    def points_from_user(self, points3d: Array) -> Array:
        """Return points (k, 3) of the user's coordinates in those of the scene in unit size."""
        return (points3d if self.origin is None else points3d - self.origin) / self.size

    def from_user(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Return poses (..., 3, 3), (..., 3) of the user's coordinates as poses of the scene in unit size."""
        moved = translation if self.origin is None else translation + rotation @ self.origin
        return rotation, moved / self.size

    def to_user(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Return poses (..., 3, 3), (..., 3) of the scene in unit size as poses of the user's coordinates."""
        scaled = translation * self.size
        return rotation, scaled if self.origin is None else scaled - rotation @ self.origin

    def prior_from_user(self, prior: Prior) -> Prior:
        """Return a prior in the user's coordinates as one of the scene in unit size."""
        if isinstance(prior, GravityPrior) or prior.translation is None:
            return prior
        rotation, translation = self.from_user(np.asarray(prior.rotation), np.asarray(prior.translation))
        sigma = prior.translation_sigma / self.size
        if sigma < LEAST_SIGMA:
            least = 10.0 ** math.ceil(math.log10(LEAST_SIGMA * self.size))
            raise ValueError(
                f"`prior.translation_sigma` is {prior.translation_sigma:g}, for a scene of size {self.size:.2g}; give "
                f"{least:g} or more, even where the translation is known exactly"
            )
        sigma = sigma if sigma <= WIDEST_SIGMA else math.inf
        return prior._replace(rotation=rotation, translation=translation, translation_sigma=sigma)

    def choose(self, image: Labels | slice = slice(None), scene: Labels | slice = slice(None)) -> "Problem":
        """Return the problem restricted to the image points and scene points of these indices or slices."""
        rows = dict.fromkeys(OF_IMAGE, image) | dict.fromkeys(OF_SCENE, scene)
        selected = {name: values[rows[name]] for name in rows if (values := getattr(self, name)) is not None}
        given3d = None if self.given3d is None else self.given3d[scene]
        return replace(self, measured=self.measured.choose(image), given3d=given3d, **selected)

    def without(self, taken: Labels) -> "Problem":
        """Return the problem without the image points that have these indices among the user's."""
        stay = np.flatnonzero(~np.isin(self.measured.indices, taken))
        left = self.choose(stay)
        return replace(
            left, measured=replace(left.measured, taken=left.measured.taken + len(self.bearings) - len(stay))
        )

    @property
    def all3d(self) -> Array:
        """(n, 3) scene points in the user's coordinates."""
        return self.points3d if self.given3d is None else self.given3d

    @cached_property
    def degenerate(self) -> str | None:
        """Reason why these points fix no pose; None if they may."""
        fewest = MIN_POINTS - isinstance(self.prior, GravityPrior)
        reason = why_degenerate(self.bearings, self.points3d, fewest)
        return f"of the 2D points that no other problem has, {reason}" if reason and self.measured.taken else reason

    def project_scene(self, rotation: Array, translation: Array) -> Array:
        """Project the scene points, (n, d); NaN for those without an image or that face away."""
        in_camera = self.points3d @ rotation.T + translation
        seen = self.measured.project(in_camera)
        if self.normals3d is not None:
            seen[~faces(self.normals3d, self.cosines3d, in_camera, rotation)] = np.nan
        return seen

    def may_match(self, i: Labels, j: Labels) -> NDArray[np.bool_]:
        """Return a mask (k,) of pairs i, j (k,) of image and scene points that their labels or classes admit."""
        if self.odds2d is not None and self.classes3d is not None:
            return np.asarray((self.odds2d[i] * self.classes3d[j]).sum(-1) > LIKELY_CLASS)
        if self.labels2d is None or self.labels3d is None:
            return np.ones(len(i), np.bool_)
        label2d, label3d = self.labels2d[i], self.labels3d[j]
        return (label2d == label3d) | (label2d < 0) | (label3d < 0)

    @property
    def cones3d(self) -> Array | None:
        """(n, 4) normals and `cosines3d`; None without normals."""
        if self.normals3d is None:
            return None
        cosines = np.zeros(len(self.normals3d)) if self.cosines3d is None else self.cosines3d
        return np.column_stack([self.normals3d, cosines])

    @cached_property
    def image(self) -> ImageStatistics:
        """Statistics of the image points."""
        return ImageStatistics(self.bearings, self.floor)

    @cached_property
    def labelled_pairs(self) -> tuple[Labels, Labels] | None:
        """Indices among `image.chosen` and of scene points (k,) of every pair whose labels are equal or include -1.

        None with too many pairs, for which sums over neighbours are faster, and with class probabilities or without
        labels.
        """
        if self.labels2d is None or self.labels3d is None or self.odds2d is not None:
            return None
        chosen, n = self.image.chosen, len(self.points3d)
        groups = label_groups(chosen, self.labels2d, self.labels3d, n)
        if sum(len(rows) * len(columns) for rows, columns in groups) > PAIRS_A_POINT * (len(chosen) + n):
            return None
        i = [np.repeat(rows, len(columns)) for rows, columns in groups]
        j = [np.tile(columns, len(rows)) for rows, columns in groups]
        return np.concatenate(i), np.concatenate(j)

    @cached_property
    def candidate_scores(self) -> Array | None:
        """(m,) mean of `scores3d` over the scene points whose label fits each image point, over that of all points.

        None without labels or `scores3d`, and with class probabilities.
        """
        if self.labels2d is None or self.labels3d is None or self.scores3d is None or self.odds2d is not None:
            return None
        scores = np.ones(len(self.labels2d))
        for rows, columns in label_groups(np.arange(len(scores)), self.labels2d, self.labels3d, len(self.labels3d)):
            if len(columns):
                scores[rows] = self.scores3d[columns].mean() / self.scores3d.mean()
        return scores

    @cached_property
    def centre3d(self) -> Array:
        """(3,) median of the scene points."""
        return np.median(self.points3d, 0)

    @property
    def centre3d_of_user(self) -> Array:
        """(3,) median of the scene points in the user's coordinates."""
        centre = self.size * self.centre3d
        return centre if self.origin is None else centre + self.origin

    def same_as(
        self, pose: tuple[Array, Array], rotation: Array, translation: Array, tolerance: Tolerance = SAME
    ) -> NDArray[np.bool_]:
        """Return a mask of the poses (c, 3, 3), (c, 3) that are equal to a given one, (3, 3) and (3,)."""
        return same_pose(pose, rotation, translation, self.centre3d, tolerance)

    @property
    def has_known_rotation(self) -> bool:
        """True if a prior has the rotation to 5 degrees: a half turn then has 10^3.5 times the false alarms."""
        return isinstance(self.prior, PosePrior) and self.prior.rotation_sigma_deg <= TWO_MATCH_DEG

    @property
    def match_radius(self) -> float:
        """Largest residual of a match in an enumeration, radians: `radius`, or 3 pixels if the pixel size is known."""
        if self.radius is not None:
            return self.radius
        return MATCH_RADIUS if self.floor is None else MATCH_FLOORS * self.floor

    @property
    def has_known_vertical(self) -> bool:
        """True if a tilt within the error of the gravity prior moves no image point out of reach of its match.

        Always true for three points, which fix no pose without it.
        """
        if not isinstance(self.prior, GravityPrior):
            return False
        if min(len(self.bearings), len(self.points3d)) == 3:
            return True
        return math.radians(self.prior.sigma_deg) * self.image.spread <= TWO_MATCH_TILT * self.match_radius

    @property
    def fixing_matches(self) -> int:
        """Number of matches that fix a pose: 2 with a close prior of the vertical or of the rotation, else 3."""
        return 2 if self.has_known_rotation or self.has_known_vertical else 3

    @property
    def fitted(self) -> int:
        """Number of parameters that are fitted to the image points."""
        lens = 0 if self.focal is None else 1 + (self.focal.radial_range > 0)
        return 2 * self.fixing_matches + lens

    def prior_sigmas(self, rotation: Array, translation: Array) -> float:
        """Return the larger deviation of rotation and position from the prior, in standard deviations; 0 without."""
        prior = self.prior
        if prior is None:
            return 0.0
        if isinstance(prior, GravityPrior):
            up, camera = rotation @ prior.directions()[1], np.asarray(prior.up_camera, np.float64)
            off = math.atan2(float(np.linalg.norm(np.cross(up, camera))), float(up @ camera))
            return math.degrees(off) / prior.sigma_deg
        prior_rotation = np.asarray(prior.rotation, np.float64)
        far = math.degrees(rotation_angle(rotation, prior_rotation)) / prior.rotation_sigma_deg
        if prior.translation is None or not math.isfinite(prior.translation_sigma):
            return far
        expected = prior_rotation @ self.centre3d + np.asarray(prior.translation)
        shift = float(np.linalg.norm(rotation @ self.centre3d + translation - expected))
        return max(far, shift / prior.translation_sigma)

    def log10_prior_fraction(self, rotation: Array, translation: Array) -> float:
        """Return log10 of the fraction F of all poses that are at least as near to the prior as this one.

        It is 0 without a prior. The nearness is the larger of the deviations of rotation and position from the prior,
        in standard deviations. Poses within `EQUALLY_NEAR_SIGMAS` of them are equally near. The poses are those that
        fit matches of these points: their rotations fill SO(3) evenly, the directions to the median scene point fill
        the view, and the logarithms of its distance a factor of 30. For poses of unrelated points, F exceeds a uniform
        variable in [0, 1]: it is a p-value of the prior, and the NFA is the number of tests times F over the likelihood
        ratio of the points.
        """
        prior = self.prior
        if prior is None:
            return 0.0
        far = max(self.prior_sigmas(rotation, translation), EQUALLY_NEAR_SIGMAS)
        if isinstance(prior, GravityPrior):
            off = min(far * math.radians(prior.sigma_deg), math.pi)
            return math.log10(max((1 - math.cos(off)) / 2, 1e-12))
        off = min(far * math.radians(prior.rotation_sigma_deg), math.pi)
        fraction = max((off - math.sin(off)) / math.pi, 1e-15)
        if prior.translation is not None and math.isfinite(prior.translation_sigma):
            expected = np.asarray(prior.rotation) @ self.centre3d + np.asarray(prior.translation)
            relative = far * prior.translation_sigma / max(float(np.linalg.norm(expected)), 1e-12)
            fraction *= min(1.0, math.pi * relative**2 / self.image.solid_angle)
            fraction *= min(1.0, 2 * math.atanh(relative) / LOG_DEPTHS) if relative < 1 else 1.0
        return math.log10(fraction)


def faces(normals3d: Array, cosines3d: Array | None, camera: Array, rotation: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of points that face the camera: n . c > cosine, c the unit vector to its centre.

    The points are in the camera's frame, the unit normals in the scene, and the least cosines 0 if not given.
    """
    towards = -((normals3d @ rotation.T) * camera).sum(-1)
    if cosines3d is None:
        return np.asarray(towards > 0)
    return np.asarray(towards > cosines3d * np.linalg.norm(camera, axis=-1))


def label_groups(
    chosen: Labels, labels2d: Labels | None, labels3d: Labels | None, n: int
) -> list[tuple[Labels, Labels]]:
    """Return indices into `chosen` image points and of the n scene points that may match, for each label in the image.

    Labels are -1 for any, None for no labels.
    """
    if labels2d is None or labels3d is None:
        return [(np.arange(len(chosen)), np.arange(n))]
    order, any_label = np.argsort(labels3d, kind="stable"), np.flatnonzero(labels3d == -1)
    values, rows = np.unique(labels2d[chosen], return_inverse=True)
    groups = np.split(np.argsort(rows, kind="stable"), np.cumsum(np.bincount(rows, minlength=len(values)))[:-1])
    first, last = (np.searchsorted(labels3d[order], values, side) for side in ("left", "right"))
    columns = [order[i:j] for i, j in zip(first.tolist(), last.tolist(), strict=True)]
    if len(any_label):
        columns = [np.sort(np.r_[one, any_label]) for one in columns]
    if len(values) and values[0] == -1:
        columns[0] = np.arange(n)
    return list(zip(groups, columns, strict=True))


def in_bulk(points3d: Array) -> NDArray[np.bool_]:
    """Return a mask of the points (n, 3) that are within `BULK` median distances of the median."""
    distance = np.linalg.norm(points3d - np.median(points3d, 0), axis=-1)
    return np.asarray(distance <= BULK * float(np.median(distance)))


def why_degenerate(bearings: Array, points3d: Array, fewest: int = MIN_POINTS) -> str | None:
    """Return the reason why points fix no pose; None if they may: at least `fewest` different ones do."""
    for name, points in (("2D", bearings), ("3D", points3d)):
        count, others = 0, points
        while len(others) and count < fewest:
            count, others = count + 1, others[(others != others[0]).any(-1)]
        if count < fewest:
            return f"only {count} different {name} point{'' if count == 1 else 's'}: {fewest} or more fix a pose"
    # One point far away hides the extent of all others, and one off a line hides the line.
    if all(_are_on_a_line(some) for some in (points3d, points3d[in_bulk(points3d)])):
        return "the 3D points lie on one line: the camera can turn about it"
    return None


def _are_on_a_line(points: Array) -> bool:
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return len(extents) < 2 or bool(extents[1] <= LINE_RATIO * extents[0])
