"""What is known of one pair before it is solved: the two point sets, and how much of all poses a prior leaves."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.geometry import same_pose, turned_by
from bpnp.search.evidence.image_statistics import ImageStatistics
from bpnp.search.starts import GravityPrior, PosePrior, Prior

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
TURNED_DEG = 5.0  # standard deviation up to which a known rotation lets two pairs fix a pose
SIGMAS = 2.0  # of a prior: poses farther off could not have been tried
LOG_DEPTHS = math.log(30.0)  # the farthest over the nearest distance at which a scene could stand


class UnknownFocal(NamedTuple):
    """What is known of a focal length that is fitted with the pose.

    log_range: logarithm of the largest over the smallest that was possible. sigma: standard deviation of its logarithm,
    infinite where nothing is expected. offset: logarithm of that of these bearings over the expected one.
    """

    log_range: float
    sigma: float = math.inf
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class PointSets:
    """One pair.

    bearings: (m, 3) unit vectors. points3d: (n, 3). normals3d: (n, 3) outward unit normals; a point that faces away is
    not seen. labels2d (m,), labels3d (n,): only points of one label can be partners, -1 fits any.
    cosines3d: (n,) least cosine between a normal and the direction to a camera that sees the point; None for 0. With
    them the few-point search leaves the normals aside. scores2d (m,), scores3d (n,): probability that a point has a
    partner, in (0, 1]; None for equal ones.
    odds2d (m, c), classes3d (n, c): their scalar product is how much likelier a match is by its classes than a mean
    one; the labels are then those of points that are sure of theirs, for searching.
    floor: smallest scale of the residuals that is believed, radians; None for a share of the bearings' spread.
    prior: what is known of the pose. log10_tried: of the number of poses that were tried; None for as many as triples
    of matches give. focal: what is known of the focal length with which the bearings were made; None if it is given.
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
    prior: Prior | None = None
    log10_tried: float | None = None
    odds2d: Array | None = None
    classes3d: Array | None = None
    focal: UnknownFocal | None = None

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
    def pairs_that_fix(self) -> int:
        """How many pairs of points fix a pose: 2 where gravity, or the rotation to a few degrees, is known, else 3."""
        return 2 if self.knows_rotation or isinstance(self.prior, GravityPrior) else 3

    @property
    def fitted(self) -> int:
        """Numbers that are fitted to the image points."""
        return 2 * self.pairs_that_fix + (self.focal is not None)

    def log10_share(self, rotation: Array, translation: Array) -> float:
        """log10 of the share of all poses that are as near to the prior as this one, or within two standard deviations.

        Of poses that fit pairs of these points: their rotations fill SO(3) evenly, the directions to the middle of the
        scene fill the view, and the logarithms of its distance a factor of 30.
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
