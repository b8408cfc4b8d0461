"""What is known of one problem before it is solved: the two point sets, what the image alone tells (their view, their
scales, and which lie together), and how much of all poses a prior leaves."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import same_pose, turned_by
from bpnp.search.evidence.settings import ImagePoints
from bpnp.search.kernels.neighbours import sums_near
from bpnp.search.propose.symmetries import Motions
from bpnp.search.starts import GravityPrior, PosePrior, Prior

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
TURNED_DEG = 5.0  # standard deviation up to which a known rotation lets two matches fix a pose
RADIUS = 3e-3  # radians, of a match, where the size of a pixel is not known
FLOORS = 30.0  # radius of a match in smallest believable scales: 3 pixels, where that is a tenth of one
TILTED = 2.0  # radii by which a tilt may move image points for two matches to fix a pose: those of the last stage
SIGMAS = 2.0  # of a prior: poses farther off could not have been tried
LOG_DEPTHS = math.log(30.0)  # the farthest over the nearest distance at which a scene could stand
PAIRS_A_POINT = 32  # pairs of one label, for each point, up to which each pair is computed
IMAGE = ImagePoints()


class ImageStatistics:
    """Of bearings (m, 3).

    centre: their mean (3,). spread: root mean square distance from it. axes: (3, 2) principal axes on the tangent
    plane, half_widths: (2,) of the rectangle with their standard deviations, solid_angle: its area, steradians, at
    most 4 pi.
    scales: (S,) of residuals, radians, from the smallest that is believed to the largest that is no mere outline.
    chosen: (k,) places of the image points that are looked at. together: (k, S) how many of them lie within
    `rule.together` scales.
    weights: (k, S, S) of the evidence, see `_weights`.
    """

    def __init__(self, bearings: Array, floor: float | None, rule: ImagePoints = IMAGE) -> None:
        m = len(bearings)
        self.centre = bearings.mean(0)
        centred = bearings - self.centre
        self.spread = max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-12)
        variance, axes = np.linalg.eigh(centred.T @ centred / max(m - 1, 1))
        self.half_widths, self.axes = np.sqrt(3 * np.maximum(variance[1:], 1e-24)), axes[:, 1:]
        area = 12 * math.sqrt(max(float(variance[1:].prod()), 0.0))
        self.solid_angle = float(np.clip(area, 1e-24, 4 * math.pi))
        smallest = max(floor or 0.0, rule.floor * self.spread)
        largest = max(rule.coarsest * math.sqrt(self.solid_angle / m), 2 * smallest)
        steps = max(3, 1 + math.ceil(math.log(largest / smallest) / math.log(rule.scale_step)))
        self.scales = np.geomspace(smallest, largest, steps)
        self.chosen = np.arange(m) if m <= rule.most else np.linspace(0, m - 1, rule.most).astype(np.int64)
        within = rule.together * self.scales
        looked_at = bearings[self.chosen]
        together = sums_near(looked_at, looked_at, self.axes, within, np.zeros(steps))
        self.together = together.astype(np.int64)
        expected = 1 + (len(looked_at) - 1) * math.pi * within**2 / self.solid_angle
        self.weights = _weights(self.together, expected, rule.crowded)


def _weights(together: NDArray[np.int64], expected: Array, crowded_sigmas: float) -> Array:
    """(k, S, S): weight of log x_i at the scale s_q in the evidence of image point i at the scale s_r.

    log x_i at s_r is a sum of steps, from the largest scale to s_r. A step from 2 s to s counts with 1 / c_i(s), and
    with 1 / c_i(s_r) if that is less, where c_i(s) is the number of image points within 2 s of i, if it is more than an
    even spread explains: over their expected number. So the place of a clump of points is one observation, and where
    each of them lies within it one each.

    together: (k, S) image points within `ImagePoints.together` scales of each. expected: (S,) of them, spread evenly
    over the view. crowded_sigmas: standard deviations above it from which they are a clump.
    """
    clump = together > expected + crowded_sigmas * np.sqrt(expected)
    crowded = np.where(clump, together / expected, 1.0)
    steps = np.triu(1 / np.maximum(together[:, :, None], crowded[:, None, :]))
    steps[:, :, 1:] -= steps[:, :, :-1]
    return np.asarray(steps)


class UnknownFocal(NamedTuple):
    """What is known of a lens whose focal length is fitted with the pose.

    Attributes:
        log_range: Logarithm of the largest over the smallest focal length that was possible.
        sigma: Standard deviation of the logarithm of the focal length; infinite if nothing is known of it.
        offset: Logarithm of the focal length of these bearings over the expected one.
        radial: Radial coefficient k of the lens with which the bearings were undistorted.
        radial_sigma: Standard deviation of k; 0 if the distortion is known, infinite if k is fitted.
        radial_range: Range of k that was possible; 0 if k is not fitted.
        centre_sigma: Standard deviation of the principal point, in focal lengths. It is not fitted.
    """

    log_range: float
    sigma: float = math.inf
    offset: float = 0.0
    radial: float = 0.0
    radial_sigma: float = 0.0
    radial_range: float = 0.0
    centre_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class PointSets:
    """Both sides of one problem.

    bearings: (m, 3) unit vectors. points3d: (n, 3). normals3d: (n, 3) outward unit normals; a point that faces away is
    not seen. labels2d (m,), labels3d (n,): only points of one label can be partners, -1 fits any.
    cosines3d: (n,) least cosine between a normal and the direction to a camera that sees the point; None for 0. With
    them the few-point search leaves the normals aside. scores2d (m,), scores3d (n,): probability that a point has a
    partner, in (0, 1]; None for equal ones.
    odds2d (m, c), classes3d (n, c): their scalar product is how much likelier a match is by its classes than a mean
    one; the labels are then those of points that are sure of theirs, for searching.
    floor: smallest scale of the residuals that is believed, radians; None for a share of the bearings' spread.
    radius: largest residual of a match in an enumeration, radians; None for that of its settings. clutter: fraction of
    the image points without a partner, if it is known.
    prior: what is known of the pose. log10_tried: of the number of poses that were tried; None for as many as triples
    of matches give. focal: what is known of the focal length with which the bearings were made; None if it is given.
    log10_views: of the number of sets of scene points, such as the views of a map, that are tried with these bearings.
    """

    bearings: Array
    points3d: Array
    normals3d: Array | None = None
    labels2d: Labels | None = None
    labels3d: Labels | None = None
    cosines3d: Array | None = None
    scores2d: Array | None = None
    scores3d: Array | None = None
    floor: float | None = None
    radius: float | None = None
    clutter: float | None = None
    prior: Prior | None = None
    log10_tried: float | None = None
    odds2d: Array | None = None
    classes3d: Array | None = None
    focal: UnknownFocal | None = None
    log10_views: float = 0.0

    @property
    def cones3d(self) -> Array | None:
        """(n, 4) normals and `cosines3d`, None if nothing is known of them."""
        if self.normals3d is None:
            return None
        cosines = np.zeros(len(self.normals3d)) if self.cosines3d is None else self.cosines3d
        return np.column_stack([self.normals3d, cosines])

    @cached_property
    def image(self) -> ImageStatistics:
        """What depends on the image alone, computed when it is first asked for."""
        return ImageStatistics(self.bearings, self.floor)

    @cached_property
    def labelled_pairs(self) -> tuple[Labels, Labels] | None:
        """Every pair of points whose labels agree.

        Returns:
            Indices (k,) among `image.chosen` and (k,) of scene points. None where the labels leave so many pairs that
            sums over neighbours are faster, or where class probabilities or no labels are given.
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
    def registered(self) -> list[tuple[Array, Array, Motions]]:
        """Poses (3, 3), (3,) and the motions of the scene that were found from their matched points."""
        return []

    @cached_property
    def middle(self) -> Array:
        """The median of the scene points (3,)."""
        return np.median(self.points3d, 0)

    def same_pose(self, rotation: Array, translation: Array, degrees: float, share: float) -> NDArray[np.bool_]:
        """Which poses (c, 3, 3), (c, 3) are the first one: turned by `degrees` at most, and the middle of the scene
        moved by this share of its distance."""
        middle = rotation @ self.middle + translation
        return same_pose(rotation, middle, 0, degrees, share * float(np.linalg.norm(middle[0])))

    @property
    def knows_rotation(self) -> bool:
        """Whether a prior tells the rotation to 5 degrees: a half turn then has 10^3.5 times the false alarms."""
        return isinstance(self.prior, PosePrior) and self.prior.rotation_sigma_deg <= TURNED_DEG

    @property
    def match_radius(self) -> float:
        """Largest residual of a match in an enumeration, radians: `radius`, or 3 pixels where a pixel is known."""
        if self.radius is not None:
            return self.radius
        return RADIUS if self.floor is None else FLOORS * self.floor

    @property
    def knows_vertical(self) -> bool:
        """Whether gravity is known so well that a tilt within its error moves no image point out of reach of its match;
        always of three points, which fix no pose without it."""
        if not isinstance(self.prior, GravityPrior):
            return False
        if min(len(self.bearings), len(self.points3d)) == 3:
            return True
        return math.radians(self.prior.sigma_deg) * self.image.spread <= TILTED * self.match_radius

    @property
    def pairs_that_fix(self) -> int:
        """How many matches fix a pose: 2 where the vertical, or the rotation to a few degrees, is known, else 3."""
        return 2 if self.knows_rotation or self.knows_vertical else 3

    @property
    def fitted(self) -> int:
        """Numbers that are fitted to the image points."""
        lens = 0 if self.focal is None else 1 + (self.focal.radial_range > 0)
        return 2 * self.pairs_that_fix + lens

    def log10_share(self, rotation: Array, translation: Array) -> float:
        """log10 of the share of all poses that are as near to the prior as this one, or within two standard deviations.

        Of poses that fit matches of these points: their rotations fill SO(3) evenly, the directions to the middle of
        the scene fill the view, and the logarithms of its distance a factor of 30.
        """
        if self.prior is None:
            return 0.0
        if isinstance(self.prior, GravityPrior):
            up = rotation @ (np.asarray(self.prior.up_scene) / np.linalg.norm(self.prior.up_scene))
            camera = np.asarray(self.prior.up_camera, np.float64)
            off = math.atan2(float(np.linalg.norm(np.cross(up, camera))), float(up @ camera))
            off = min(max(off, math.radians(SIGMAS * self.prior.sigma_deg)), math.pi)
            return math.log10(max((1 - math.cos(off)) / 2, 1e-12))
        known = np.asarray(self.prior.rotation, np.float64)
        off = min(max(turned_by(rotation, known), math.radians(SIGMAS * self.prior.rotation_sigma_deg)), math.pi)
        share = max((off - math.sin(off)) / math.pi, 1e-15)
        if self.prior.translation is not None and math.isfinite(self.prior.translation_sigma):
            expected = known @ self.middle + np.asarray(self.prior.translation)
            distance = max(float(np.linalg.norm(expected)), 1e-12)
            shift = float(np.linalg.norm(rotation @ self.middle + translation - expected))
            relative = max(shift, SIGMAS * self.prior.translation_sigma) / distance
            share *= min(1.0, math.pi * relative**2 / self.image.solid_angle) * min(1.0, 2 * relative / LOG_DEPTHS)
        return math.log10(share)


def faces(normals3d: Array, cosines3d: Array | None, camera: Array, rotation: Array) -> NDArray[np.bool_]:
    """Which points (n, 3) in the camera's frame face it: n . c > cosine, c the unit vector to the camera's centre."""
    towards = -((normals3d @ rotation.T) * camera).sum(-1)
    if cosines3d is None:
        return np.asarray(towards > 0)
    return np.asarray(towards > cosines3d * np.linalg.norm(camera, axis=-1))


def label_groups(
    chosen: Labels, labels2d: Labels | None, labels3d: Labels | None, n: int
) -> list[tuple[Labels, Labels]]:
    """Places in `chosen` and in the scene that can be partners, a group for each label in the image."""
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
