"""One problem from a user's arrays: checked, undistorted, and with the plane in which its residuals are measured."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bpnp.cameras import Camera, in_front
from bpnp.geometry import MIN_POINTS
from bpnp.search.point_sets import PointSets, faces
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.arguments import Prior
from bpnp.solving.given_points import (
    check_points,
    checked_labels,
    checked_normals,
    checked_scores,
    keypoints,
    normalised,
    numbers,
    one_row_each,
    unit_bearings,
)

Array = npt.NDArray[np.float64]
Unit = Literal["px", "normalised", "rad"]
FAR = 100.0  # median distances of the points from their median; further off float32 steps by 1e-5 of that distance
FLAT = 1e-6  # of the points' longest extent; what float32 leaves of the other extents of a line
FLOOR_PIXELS = 0.1  # no detector of points is better


@dataclass(frozen=True, eq=False)
class Problem:
    """k usable of m given 2D points, and n 3D points, with all that is known of them and of the pose.

    bearings: (k, 3) unit. usable: (k,) their places among the given. image: (k, d) the usable points where residuals
    are measured, in `unit`: pixels with a camera, else the normalised image plane, or the unit sphere for bearings.
    points2d: (m, 2) normalised, NaN for a point that has no such coordinates. points3d: (n, 3) as given. origin: where
    solvers put the scene's origin, for scenes so far from it that float32 would lose digits. degenerate: why no pose
    can follow from these points, if so. normals3d: (n, 3) unit; labels2d: (k,) and labels3d: (n,), -1 for any;
    scores2d: (k,) and scores3d: (n,), probability of a partner; cosines3d: (n,) as in `PointSets`.
    prior: in the user's coordinates. taken2d: of the given 2D points, how many were left to another pair.
    """

    bearings: Array
    usable: npt.NDArray[np.int64]
    image: Array
    unit: Unit
    points2d: Array
    points3d: Array
    origin: Array
    camera: Camera | None
    degenerate: str | None
    normals3d: Array | None = None
    labels2d: npt.NDArray[np.int64] | None = None
    labels3d: npt.NDArray[np.int64] | None = None
    scores2d: Array | None = None
    scores3d: Array | None = None
    cosines3d: Array | None = None
    prior: Prior | None = None
    taken2d: int = 0

    @property
    def left_out(self) -> tuple[int, int]:
        """How many of the given 2D points could not be undistorted, and how many were left to another pair."""
        return len(self.points2d) - len(self.usable) - self.taken2d, self.taken2d

    @cached_property
    def local3d(self) -> Array:
        """The 3D points around `origin`."""
        return self.points3d - self.origin

    @cached_property
    def per_radian(self) -> float:
        """Units of `image` a radian, at the median point: a plane stretches by (1 + r^2)^(3/4) at the distance r."""
        if self.unit == "rad":
            return 1.0
        stretch = (1 + (self.points2d[self.usable] ** 2).sum(-1)) ** 0.75
        return float(np.median(stretch) * (1.0 if self.camera is None else self.camera.focal))

    @cached_property
    def sets(self) -> PointSets:
        """What a search is given: the points around `origin`, the prior there, and the noise floor of the detector."""
        prior = self.prior if isinstance(self.prior, (PosePrior, GravityPrior)) else None
        if isinstance(prior, PosePrior) and prior.translation is not None:
            moved = np.asarray(prior.translation) + np.asarray(prior.rotation) @ self.origin
            prior = prior._replace(translation=moved)
        floor = None if self.camera is None else FLOOR_PIXELS / self.per_radian
        return PointSets(
            self.bearings, self.local3d, self.normals3d, self.labels2d, self.labels3d, self.cosines3d, self.scores2d,
            self.scores3d, floor=floor, prior=prior,
        )  # fmt: skip

    def view(self, rotation: Array, translation: Array) -> Array:
        """Where all points are seen (n, d), NaN if they cannot be, or face away."""
        seen = self.project(rotation, translation, self.local3d)
        if self.normals3d is not None:
            camera = self.local3d @ rotation.T + translation
            seen[~faces(self.normals3d, self.cosines3d, camera, rotation)] = np.nan
        return seen

    def without(self, taken: npt.NDArray[np.int64]) -> "Problem":
        """The same without some of the given 2D points."""
        kept = ~np.isin(self.usable, taken)
        reason = _degenerate(self.bearings[kept], self.points3d, MIN_POINTS)
        return replace(
            self,
            bearings=self.bearings[kept],
            usable=self.usable[kept],
            image=self.image[kept],
            labels2d=None if self.labels2d is None else self.labels2d[kept],
            scores2d=None if self.scores2d is None else self.scores2d[kept],
            degenerate=None if reason is None else f"of the lights that no other pair has, {reason}",
            taken2d=int((~kept).sum()),
        )

    def allowed(self, i: npt.NDArray[np.int64], j: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Whether usable 2D points i and 3D points j can be partners by their labels."""
        if self.labels2d is None or self.labels3d is None:
            return np.ones(len(i), np.bool_)
        one, other = self.labels2d[i], self.labels3d[j]
        return (one == other) | (one < 0) | (other < 0)

    def project(self, rotation: Array, translation: Array, points: Array) -> Array:
        """Where points (p, 3) around `origin` are seen, in the coordinates of `image`; NaN if they cannot be."""
        camera = points @ rotation.T + translation
        if self.unit == "px" and self.camera is not None:
            return self.camera.project(camera)
        if self.unit == "normalised":
            return in_front(camera)[:, :2]
        length = np.linalg.norm(camera, axis=-1, keepdims=True)
        return np.divide(camera, length, out=np.full_like(camera, np.nan), where=length > 0)


def problem_from(
    points2d: Any,
    points3d: Any,
    camera: Camera | None,
    *,
    normals3d: Any = None,
    labels2d: Any = None,
    labels3d: Any = None,
    scores2d: Any = None,
    scores3d: Any = None,
    cosines3d: Array | None = None,
    prior: Prior | None = None,
    where: str = "",
) -> Problem:
    """Check the arrays of one pair.

    points2d: (m, 2) pixels with a camera, normalised coordinates or (m, 3) unit bearings without; points3d (n, 3).
    cosines3d: as in `PointSets`, not checked. where: added to the errors, to name the pair. Pixels that cannot be
    undistorted are left out of `usable`. Raises ValueError that names the argument: wrong shape, swapped, fewer points
    than fix a pose (3 where gravity is known, else 4), NaN, pixels without a camera or the reverse, normals, labels or
    scores that do not go with the points.
    """
    fewest = MIN_POINTS - isinstance(prior, GravityPrior)
    given2d, given3d = keypoints(points2d, where), one_row_each(numbers("points3d", points3d, where))
    if given2d.ndim == 2 and given2d.shape[1] == 3 and (camera is not None or given3d.shape[-1:] == (2,)):
        wrong = given2d if camera is not None else given3d
        what = "`points3d` of shape (n, 3)" if camera is None else "pixels `points2d` of shape (m, 2) with a `camera`"
        raise ValueError(f"expected {what}{where}, got {wrong.shape} (are points2d and points3d swapped?)")
    check_points("points2d", given2d, (2, 3) if camera is None else (2,), fewest, where)
    check_points("points3d", given3d, (3,), fewest, where)
    if given2d.shape[1] == 3:
        image, unit = unit_bearings(given2d, where), "rad"
        bearings, plane = image, in_front(image)[:, :2]
    else:
        image, unit, plane = given2d, "normalised" if camera is None else "px", normalised(given2d, camera, where)
        rays = np.column_stack([plane, np.ones(len(plane))])
        bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    usable = np.flatnonzero(np.isfinite(bearings).all(-1))
    if len(usable) < fewest:
        raise ValueError(
            f"expected {fewest} or more 2D points that the camera can see{where}, got {len(usable)} of {len(image)}"
        )
    scores = checked_scores("scores2d", scores2d, len(given2d), where)
    labels = checked_labels(labels2d, labels3d, (len(given2d), len(given3d)), where)
    return Problem(
        bearings=bearings[usable],
        usable=usable,
        image=image[usable],
        unit=unit,  # type: ignore[arg-type]
        points2d=plane,
        points3d=given3d,
        origin=_origin(given3d),
        camera=camera,
        degenerate=_degenerate(bearings[usable], given3d, fewest),
        normals3d=checked_normals(normals3d, len(given3d), where),
        labels2d=None if labels is None else labels[0][usable],
        labels3d=None if labels is None else labels[1],
        scores2d=None if scores is None else scores[usable],
        scores3d=checked_scores("scores3d", scores3d, len(given3d), where),
        cosines3d=cosines3d,
        prior=prior,
    )


def _origin(points3d: Array) -> Array:
    """The median of the points if they are far from the origin, else the origin."""
    median = np.median(points3d, axis=0)
    extent = np.median(np.linalg.norm(points3d - median, axis=-1))
    return median if np.linalg.norm(median) > FAR * extent else np.zeros(3)


def _degenerate(bearings: Array, points3d: Array, fewest: int) -> str | None:
    for name, points in (("2D", bearings), ("3D", points3d)):
        count, others = 0, points
        while len(others) and count < fewest:
            count, others = count + 1, others[(others != others[0]).any(-1)]
        if count < fewest:
            return f"only {count} different {name} point{'s' if count > 1 else ''}: {fewest} or more fix a pose"
    extents = np.linalg.svd(points3d - points3d.mean(0), compute_uv=False)
    if extents[1] <= FLAT * extents[0]:
        return "the 3D points lie on one line: the camera can turn about it"
    return None
