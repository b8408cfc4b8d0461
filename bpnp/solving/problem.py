"""One problem from a user's arrays: checked, undistorted, and with the plane in which its residuals are measured."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bpnp.cameras import Camera, in_front
from bpnp.poses import MIN_POINTS
from bpnp.search.point_sets import PointSets, UnknownFocal, faces
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.arguments import (
    Array,
    Labels,
    Prior,
    check_points,
    check_unit,
    checked_labels,
    checked_normals,
    checked_scores,
    image_points,
    scene_points,
    unit_bearings,
)

Unit = Literal["px", "normalised", "rad"]
FAR = 100.0  # median distances of the points from their median; further off float32 steps by 1e-5 of that distance
FLAT = 1e-6  # of the points' longest extent; what float32 leaves of the other extents of a line
LIKELY = 0.1  # by their classes, over a mean match, at least, of two points that are matched
FLOOR_PIXELS = 0.1  # no detector of points is better
OF_IMAGE = "bearings", "labels2d", "scores2d", "odds2d"  # fields of PointSets with a row a point
OF_SCENE = "points3d", "normals3d", "labels3d", "cosines3d", "scores3d", "classes3d"


@dataclass(frozen=True, eq=False)
class Problem:
    """k usable of m 2D points, and n 3D points, with all that is known of them and of the pose.

    sets: what a search is given: the usable points, the scene around `origin`, which is elsewhere than the user's for
    scenes so far from it that float32 would lose digits, the prior there, and the noise floor of the detector.
    usable: (k,) places of the usable 2D points among the m. image: (k, d) these points where residuals are measured, in
    `unit`: pixels with a camera, else the normalised image plane, or the unit sphere for bearings.
    points2d: (m, 2) normalised, NaN for a point that has no such coordinates. points3d: (n, 3) as given.
    degenerate: why no pose can follow from these points, if so. prior: in the user's coordinates, or a network.
    taken2d: of the m, how many were left to another problem.
    """

    sets: PointSets
    usable: Labels
    image: Array
    unit: Unit
    points2d: Array
    points3d: Array
    origin: Array
    camera: Camera | None
    degenerate: str | None
    prior: Prior | None = None
    taken2d: int = 0

    @property
    def left_out(self) -> tuple[int, int]:
        """How many of the 2D points could not be undistorted, and how many were left to another problem."""
        return len(self.points2d) - len(self.usable) - self.taken2d, self.taken2d

    @cached_property
    def per_radian(self) -> float:
        """Units of `image` a radian."""
        return _per_radian(self.points2d[self.usable], self.unit, self.camera)

    def view(self, rotation: Array, translation: Array) -> Array:
        """Where all points are seen (n, d), NaN if they cannot be, or face away."""
        seen = self.project(rotation, translation, self.sets.points3d)
        if self.sets.normals3d is not None:
            camera = self.sets.points3d @ rotation.T + translation
            seen[~faces(self.sets.normals3d, self.sets.cosines3d, camera, rotation)] = np.nan
        return seen

    def without(self, taken: Labels) -> "Problem":
        """The same without some of the m 2D points."""
        stay = np.flatnonzero(~np.isin(self.usable, taken))
        sets = chosen(self.sets, stay)
        reason = degenerate_points(sets.bearings, self.points3d)
        return replace(
            self,
            sets=sets,
            usable=self.usable[stay],
            image=self.image[stay],
            degenerate=None if reason is None else f"of the lights that no other problem has, {reason}",
            taken2d=len(self.usable) - len(stay),
        )

    def allowed(self, i: Labels, j: Labels) -> npt.NDArray[np.bool_]:
        """Whether usable 2D points i and 3D points j can be partners by their labels."""
        if self.sets.odds2d is not None and self.sets.classes3d is not None:
            return np.asarray((self.sets.odds2d[i] * self.sets.classes3d[j]).sum(-1) > LIKELY)
        if self.sets.labels2d is None or self.sets.labels3d is None:
            return np.ones(len(i), np.bool_)
        label2d, label3d = self.sets.labels2d[i], self.sets.labels3d[j]
        return (label2d == label3d) | (label2d < 0) | (label3d < 0)

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
    focal: UnknownFocal | None = None,
) -> Problem:
    """Check the arrays of one problem; they are as for `bpnp.solve`, camera and prior are checked.

    cosines3d, focal: as in `PointSets`, not checked. Pixels that cannot be undistorted are left out of `usable`. Raises
    ValueError that names the argument: wrong shape, swapped, fewer points than fix a pose (3 where gravity is known,
    else 4), NaN, pixels without a camera or the reverse, normals, labels or scores that do not go with the points.
    """
    fewest = MIN_POINTS - isinstance(prior, GravityPrior)
    image, scene = image_points(points2d), scene_points(points3d)
    if image.ndim == 2 and image.shape[1] == 3 and (camera is not None or scene.shape[-1:] == (2,)):
        wrong = image if camera is not None else scene
        what = "`points3d` of shape (n, 3)" if camera is None else "pixels `points2d` of shape (m, 2) with a `camera`"
        raise ValueError(f"expected {what}, got {wrong.shape} (are points2d and points3d swapped?)")
    check_points("points2d", image, (2, 3) if camera is None else (2,), fewest)
    check_points("points3d", scene, (3,), fewest)
    unit, (bearings, plane) = unit_of(image, camera), bearings_of(image, camera)
    image = bearings if unit == "rad" else image
    usable = np.flatnonzero(np.isfinite(bearings).all(-1))
    check_seen(usable, image, fewest)
    origin, known = _origin(scene), prior if isinstance(prior, (PosePrior, GravityPrior)) else None
    if isinstance(known, PosePrior) and known.translation is not None:
        known = known._replace(translation=np.asarray(known.translation) + np.asarray(known.rotation) @ origin)
    sets = PointSets(
        bearings,
        scene - origin,
        normals3d=checked_normals(normals3d, len(scene)),
        cosines3d=cosines3d,
        scores2d=checked_scores("scores2d", scores2d, len(image)),
        scores3d=checked_scores("scores3d", scores3d, len(scene)),
        floor=None if camera is None else FLOOR_PIXELS / _per_radian(plane[usable], unit, camera),
        prior=known,
        focal=focal,
        **checked_labels(labels2d, labels3d, (len(image), len(scene))),
    )
    sets = chosen(sets, usable)
    degenerate = degenerate_points(sets.bearings, scene, fewest)
    return Problem(sets, usable, image[usable], unit, plane, scene, origin, camera, degenerate, prior)


def bearings_of(image: Array, camera: Camera | None) -> tuple[Array, Array]:
    """Unit bearings (m, 3) of image points in front of a camera and their normalised coordinates (m, 2), NaN for none.
    Raises ValueError for pixels without a camera or the reverse."""
    if image.shape[1] == 3:
        bearings = unit_bearings(image)
        return bearings, in_front(bearings)[:, :2]
    check_unit(image, camera)
    plane = image if camera is None else camera.normalise(image)
    rays = np.column_stack([plane, np.ones(len(plane))])
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), plane


def unit_of(image: Array, camera: Camera | None) -> Unit:
    """In which residuals of such image points are measured."""
    return "rad" if image.shape[1] == 3 else "normalised" if camera is None else "px"


def check_seen(usable: Labels, image: Array, fewest: int) -> None:
    """Raise ValueError where too few of the 2D points are usable."""
    if len(usable) < fewest:
        raise ValueError(
            f"expected {fewest} or more 2D points that the camera can see, got {len(usable)} of {len(image)}"
        )


def chosen(sets: PointSets, image: Labels, scene: Labels | slice = slice(None)) -> PointSets:
    """These image points and scene points alone, with what is known of them."""
    rows = dict.fromkeys(OF_IMAGE, image) | dict.fromkeys(OF_SCENE, scene)
    known = {name: values[rows[name]] for name in rows if (values := getattr(sets, name)) is not None}
    return replace(sets, **known)


def _per_radian(points2d: Array, unit: Unit, camera: Camera | None) -> float:
    """Units a radian, at the median point: a plane stretches by (1 + r^2)^(3/4) at the distance r."""
    if unit == "rad":
        return 1.0
    stretch = (1 + (points2d**2).sum(-1)) ** 0.75
    return float(np.median(stretch) * (1.0 if camera is None else camera.focal))


def _origin(points3d: Array) -> Array:
    """The median of the points if they are far from the origin, else the origin."""
    median = np.median(points3d, axis=0)
    extent = np.median(np.linalg.norm(points3d - median, axis=-1))
    return median if np.linalg.norm(median) > FAR * extent else np.zeros(3)


def degenerate_points(bearings: Array, points3d: Array, fewest: int = MIN_POINTS) -> str | None:
    """Why no pose can follow from points, of which `fewest` different ones fix one; None if one may."""
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
