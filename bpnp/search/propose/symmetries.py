"""Motions that map a part of a scene onto the scene: the poses that a symmetry or a repetition confuses.

A motion is a similarity p -> s S p + d, with the scale s = 1 if it is rigid. If it maps scene points onto other scene
points, the pose (R S^T, s t - R S^T d) projects the images of these points to where (R, t) projects the points
themselves: R S^T (s S p + d) + s t - R S^T d = s (R p + t). Every such pose is a competitor of (R, t).

From afar an image does not show which of two points is nearer. A pose then looks like its mirror image A in the plane
through the scene across the line of sight, which has the wrong handedness. If a reflection p -> S p + d with det S = -1
maps scene points onto others, the pose with the rotation A R S^T sees them at these places and is a competitor too.

The motions are found by registering the scene with itself. A base of three points is matched with every congruent
triangle of the scene, and for motions of another scale with every similar one. Its edges determine the motion, and a
sample of the points confirms it. Bases lie in a neighbourhood of some points, so that the cost of a base grows linearly
with the scene. A motion that maps a fraction x of the points is missed by B bases with a probability of (1 - x^3)^B.
The probability is lower if the part is connected in space.

Source: D. Aiger, N. J. Mitra, D. Cohen-Or, 4-points congruent sets for robust pairwise surface registration, ACM TOG
2008, with triangles in place of coplanar bases.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.arrays import Array, Indices
from bpnp.poses import distinct
from bpnp.search.kernels.neighbours import HashedPoints, hashed, lies_on
from bpnp.search.kernels.vectors import compiled, part

NEIGHBOURS = 96  # number of neighbours of a point that a base and its matches come from [points; not tuned]
NEIGHBOURS_OF_MANY = 48  # the same for scenes of more than `MANY_POINTS` [points; cost]
MANY_POINTS = 500  # number of points from which a scene has many [points; cost]
# At most (1 - 1/8)^32 = 1.4 % of the registrations miss a motion of half of the points.
BASES = 32  # number of bases [bases; derived]
COMPACT = 4  # every other base is drawn from this fraction (1 / `COMPACT`) of a neighbourhood [1; not tuned]
DRAWN_TRIANGLES = 4  # number of triangles drawn for a base; the largest is taken [triangles; not tuned]
# Three fix a motion and are no evidence of it.
FEWEST_MOVED = 5  # smallest number of moved points that lie on others [points; derived]
FEWEST_MOVED_SCALED = 8  # least number of moved points on others, at another scale [points; calibration]
# One of 17 motions of a third of the points fails.
FIRST_SAMPLED = 7  # number of sampled points; at least one must confirm a motion [points; derived]
BASES_SCALED = 16  # largest number of bases that are matched at other scales, at most a third of all [bases; cost]
MOST_SCALED_WORK = 2000  # largest number of these bases times points [bases * points; cost]
CHECKED_POINTS = 32  # number of sampled points that confirm a motion before all points do [points; cost]
MOST_WORK = 30_000_000  # pairs compared for all bases together, some 0.1 s; the rest is left out [pairs; cost]
PAIRS_A_SAMPLE = 8  # number of pairs that take as long as a sampled point [pairs; cost]
MOST_FOUND = 4096  # number of motions of all bases together that are ranked [motions; cost]
REFINED_MOTIONS = 48  # number of motions, those of the largest fraction first, that are refined [motions; cost]
REFINED_MOTIONS_SCALED = 8  # number of motions of another scale that are refined [motions; cost]
NEAR_SYMMETRY = 0.02  # largest error of a point under a near symmetry, in extents [fraction; convention]
# Largest error in spacings of the points: at a quarter of the spacing 1 to 6 % of the points lie on others by chance.
TOLERANCE_SPACINGS = 0.25  # [spacings; derived]
FLAT_SCENE = 0.1  # largest third extent of a flat scene, as a fraction of its second extent [fraction; not tuned]
REFINEMENT_ROUNDS = 3  # rounds of the refinement: nearest points, rigid fit [rounds; not tuned]
# Angle between the rotations of two motions below which they can be one; their shifts must be within four tolerances
# too.
SAME_MOTION_DEG = 3.0  # [degrees; not tuned]


class Motions(NamedTuple):
    """Motions p -> scale rotation p + shift of a scene, those that map the largest fraction first."""

    rotation: Array  # (k, 3, 3); those of reflections have the determinant -1
    shift: Array  # (k, 3), in the unit of the scene
    scale: Array  # (k,) size of the copy over that of the part; exactly 1 for rigid motions
    # (k,) of the source points that come to lie within the tolerance of a scene point. The tolerance of a smaller copy
    # is smaller by its scale.
    fraction: Array
    # Largest fraction that a rigid motion which is not among these may map. It is 0 unless a scene has more than are
    # refined, as a lattice has, and 1 if the registration was cut off (`MOST_WORK`).
    left_out: float

    @classmethod
    def none(cls) -> "Motions":
        """Return an empty record."""
        return cls(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), 0.0)

    @classmethod
    def concatenate(cls, parts: Sequence["Motions"]) -> "Motions":
        """Return the motions of several records."""
        rotation, shift, scale, fraction = (
            np.concatenate(each) for each in zip(*(part[:4] for part in [cls.none(), *parts]), strict=True)
        )
        return cls(rotation, shift, scale, fraction, max((part.left_out for part in parts), default=0.0))

    def select(self, kept: Indices | NDArray[np.bool_]) -> "Motions":
        """Return the motions at some indices, or those of a mask."""
        return Motions(self.rotation[kept], self.shift[kept], self.scale[kept], self.fraction[kept], self.left_out)

    def competitors(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Return the poses (k, 3, 3), (k, 3) that these motions confuse with the pose (3, 3), (3,)."""
        rotations = rotation @ self.rotation.transpose(0, 2, 1)
        return rotations, self.scale[:, None] * translation - np.einsum("kij,kj->ki", rotations, self.shift)

    def mirror_images(self, rotation: Array, translation: Array, centre3d: Array) -> tuple[Array, Array]:
        """Return the poses (k, 3, 3), (k, 3) that these reflections confuse with the pose (3, 3), (3,) from afar.

        The scene point `centre3d`, through which the line of sight goes, keeps its distance from the camera.
        """
        seen = rotation @ centre3d + translation
        across = reflection(seen)
        rotations = across @ rotation @ self.rotation.transpose(0, 2, 1)
        return rotations, seen + across @ (translation - seen) - np.einsum("kij,kj->ki", rotations, self.shift)

    def apply(self, points3d: Array) -> Array:
        """Return the points (n, 3) moved by each motion, (k, n, 3)."""
        linear = self.scale[:, None, None] * self.rotation
        return np.einsum("kij,sj->ksi", linear, points3d) + self.shift[:, None]

    def inverse(self) -> "Motions":
        """Return the inverse motions, with the same fractions."""
        back = self.rotation.transpose(0, 2, 1)
        shift = -np.einsum("kij,kj->ki", back, self.shift) / self.scale[:, None]
        return self._replace(rotation=back, shift=shift, scale=1 / self.scale)

    def mapping(self, least: float) -> "Motions":
        """Return the motions that map at least this fraction."""
        return self.select(self.fraction >= least)

    def of(
        self,
        points3d: Array,
        sources: Indices,
        tolerance: float,
        least: float,
        *,
        labels3d: Indices | None = None,
        normals3d: Array | None = None,
    ) -> "Motions":
        """Return those motions of a scene that map at least a fraction `least` of some of its points, `sources` (s,).

        The other arguments are those of `self_motions`.
        """
        moved, reach = self.apply(points3d[sources]), tolerance * np.minimum(self.scale, 1)[:, None]
        near, _ = _mapped(cKDTree(points3d), moved, self.rotation, sources, reach, labels3d, normals3d)
        fraction = near.mean(-1) if len(sources) else np.zeros(len(near))
        fewest = np.where(self.scale == 1, FEWEST_MOVED, FEWEST_MOVED_SCALED)
        order = np.argsort(-fraction, kind="stable")
        order = order[(fraction >= np.maximum(least, fewest / max(len(sources), 1)))[order]]
        # As if all points that they map were sources.
        left_out = min(self.left_out * len(points3d) / max(len(sources), 1), 1.0)
        return self._replace(fraction=fraction, left_out=left_out).select(order)


def reflection(normal: Array) -> Array:
    """Return the reflection (3, 3) in the plane through the origin across a vector (3,) of any length."""
    axis = normal / max(float(np.linalg.norm(normal)), 1e-300)
    return np.eye(3) - 2 * np.outer(axis, axis)


def mirror_pose(points3d: Array, rotation: Array, translation: Array) -> tuple[Array, Array] | None:
    """Return the pose that sees a flat scene nearly the same, its normal on the other side of the line of sight.

    None where the scene is not flat (`FLAT_SCENE`). Source: D. Oberkampf, D. DeMenthon, L. Davis, Iterative pose
    estimation using coplanar feature points, CVIU 1996.
    """
    centroid = points3d.mean(0)
    _, extents, axes = np.linalg.svd(points3d - centroid, full_matrices=False)
    if len(points3d) < 3 or extents[2] > FLAT_SCENE * extents[1]:
        return None
    flipped = reflection(axes[2])
    motions = Motions(flipped[None], (centroid - flipped @ centroid)[None], np.ones(1), np.ones(1), 0.0)
    rotations, translations = motions.mirror_images(rotation, translation, centroid)
    return rotations[0], translations[0]


def self_motions(
    points3d: Array,
    tolerance: float,
    *,
    sources: Indices | None = None,
    labels3d: Indices | None = None,
    normals3d: Array | None = None,
    least: float = 0.3,
    bases: int = BASES,
    factor: float | int = 1,
    reflected: bool = False,
) -> Motions:
    """Return distinct motions that map a fraction of a scene's points onto its points, the largest fraction first.

    They map at least the fraction `least` of the `sources`, indices of the points that an image shows, for example; of
    all points without them. A moved point lies on a scene point of its own label (-1 fits any), with a normal within 60
    degrees of its moved one, if it is within `tolerance`. `factor` is the largest ratio of the sizes of a part and its
    copy, 1 for rigid motions only. If `reflected`, the motions have a reflection instead, of the same size only. The
    identity, and reflections that hardly move the sources, as in a flat scene, are left out.

    >>> import numpy as np
    >>> part = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    >>> third = np.array([[-0.5, -(3**0.5) / 2, 0], [3**0.5 / 2, -0.5, 0], [0, 0, 1]])
    >>> motions = self_motions(np.concatenate([part, part @ third.T, part @ third]), 0.02)
    >>> cosines = (np.trace(motions.rotation, axis1=1, axis2=2) - 1) / 2
    >>> np.degrees(np.arccos(cosines)).round(), motions.fraction
    (array([120., 120.]), array([1., 1.]))
    >>> np.sort(self_motions(np.concatenate([part, part / 2 + [3, 0, 0]]), 0.02, factor=4).scale).round(6)
    array([0.5, 2. ])
    """
    points = np.ascontiguousarray(points3d, np.float64)
    moved = np.arange(len(points)) if sources is None else np.asarray(sources, np.int64)
    if len(moved) < 4 or len(points) < 4 or not tolerance > 0:
        return Motions.none()
    count = min(_neighbours(points) + 1, len(points))
    tree = cKDTree(points)
    distance, index = tree.query(points, count)
    labels = np.full(len(points), -1) if labels3d is None else np.asarray(labels3d, np.int64)
    normals = np.empty((0, 3)) if normals3d is None else np.ascontiguousarray(normals3d, np.float64)
    scene = SceneIndex(points, hashed(points, 2 * tolerance), distance, index.astype(np.int64), labels, normals)
    chosen = _bases(points, moved, bases)
    features = labels3d, normals3d
    hand = -1.0 if reflected else 1.0
    rigid = _motions(scene, tree, moved, chosen, tolerance, least, 1.0, hand, features)
    if factor == 1 or reflected:
        return rigid
    several = min(bases // 3, BASES_SCALED, MOST_SCALED_WORK // len(points))
    chosen = _longer_first(points, chosen[:several])
    scaled = _motions(scene, tree, moved, chosen, tolerance, least, float(factor), hand, features)
    both = Motions.concatenate([rigid, scaled])
    return both.select(_distinct(both, points[moved], tolerance, len(both.scale)))


def _motions(
    scene: "SceneIndex",
    tree: Any,
    moved: Indices,
    bases: Indices,
    tolerance: float,
    least: float,
    factor: float,
    hand: float,
    features: tuple[Indices | None, Array | None],
) -> Motions:
    """Return the distinct motions that map bases, refined: rigid ones, or scaled ones if the factor is above 1.

    With the hand -1 they are reflections.
    """
    rigid, own = factor == 1, scene.points[moved]
    fewest, count = FEWEST_MOVED, REFINED_MOTIONS
    if not rigid:
        fewest, count = FEWEST_MOVED_SCALED, REFINED_MOTIONS_SCALED
    least = max(least, fewest / len(moved))
    sample, room = _sample(moved), MOST_FOUND
    found = Found(np.zeros((room, 3, 3)), np.zeros((room, 3)), np.zeros(room))
    confirming, most = math.ceil(0.7 * least * len(sample)), MOST_WORK // max(len(bases), 1)
    total, complete = _register(
        scene, bases, sample, tolerance, confirming, factor, hand, most, found, np.empty((4, 3, 3))
    )
    linear, shift, score = (part[: min(total, room)] for part in found)
    scale = np.ones(len(linear)) if rigid else np.cbrt(np.linalg.det(linear))
    motions = Motions(linear / scale[:, None, None], shift, scale, score, 0.0)
    motions = motions.select(_distinct(motions, own, tolerance, count))
    if not rigid and len(moved) == len(scene.points):
        motions = Motions.concatenate([motions, motions.inverse()])
    each = [motions.select(np.array([k])) for k in range(len(motions.scale))]
    refined = [_refine(scene.points, tree, moved, one, tolerance, *features) for one in each]
    ranked = [k for k, one in enumerate(refined) if one.fraction[0] >= least and _moves(one, own, 3 * tolerance)]
    motions = Motions.concatenate([refined[k] for k in ranked])
    unique = _distinct(motions, own, tolerance, count)
    if not rigid:
        return motions.select(unique)
    # Candidates that were not refined had lower scores: they map no more than those of the lower half.
    is_cut = total > room or len(refined) == count
    lower = [float(motions.fraction[k]) for k in unique if is_cut and ranked[k] >= len(refined) // 2]
    return motions.select(unique)._replace(left_out=max(lower, default=0.0) if complete else 1.0)


def _distinct(motions: Motions, own: Array, tolerance: float, count: int) -> Indices:
    """Return the indices of at most `count` different motions of points (k, 3), best first."""
    if not len(motions.scale):
        return np.empty(0, np.int64)
    size = extent(own)
    offsets = motions.apply(np.median(own, 0)[None])[:, 0] / size
    places = np.column_stack([offsets, motions.scale])
    limits = SAME_MOTION_DEG, max(4 * tolerance / size, 1e-6)
    return distinct(motions.rotation, places, motions.fraction, count, *limits)


def extent(points: Array) -> float:
    """Return the median distance of points (n, 3) from their median: the size of a scene without its far points."""
    return float(np.median(np.linalg.norm(points - np.median(points, 0), axis=-1)))


def matching_tolerance(points3d: Array, sources: Indices, noise: float) -> float:
    """Return the distance within which a moved point lies on a scene point.

    It is three standard deviations of a match, `noise` in the unit of the scene, or `NEAR_SYMMETRY` of the extent,
    whichever is larger, rounded up to a power of two of the latter. It is at most `TOLERANCE_SPACINGS` of the median
    distance of a source from its nearest neighbour, beyond which points lie on others by chance.
    """
    return tolerance_of(*extent_and_spacing(points3d, sources), noise)


def extent_and_spacing(points3d: Array, sources: Indices) -> tuple[float, float]:
    """Return the extent of some points, and the median distance of one of them from its nearest neighbour."""
    nearest = cKDTree(points3d).query(points3d[sources], 2)[0][:, 1]
    return extent(points3d[sources]), float(np.median(nearest[nearest > 0])) if nearest.any() else 0.0


def tolerance_of(extent: float, spacing: float, noise: float) -> float:
    """Return the `matching_tolerance` of points of this extent and spacing."""
    least = NEAR_SYMMETRY * extent
    if not least > 0:
        return 0.0
    steps = math.ceil(math.log2(max(3 * noise / least, 1.0)))
    return min(2.0**steps * least, TOLERANCE_SPACINGS * spacing)


class SceneIndex(NamedTuple):
    """Inputs of the compiled loops."""

    points: Array  # (n, 3)
    table: HashedPoints
    distance: Array  # (n, c) distances of the nearest points, ascending
    neighbours: Indices  # (n, c) their indices
    labels: Indices  # (n,); -1 fits any label
    normals: Array  # (n, 3), or (0, 3) for none


class Found(NamedTuple):
    """Motions that the compiled loops write."""

    linear: Array  # (c, 3, 3) rotations times scales
    shift: Array  # (c, 3)
    score: Array  # (c,) numbers of confirming points


def _bases(points: Array, moved: Indices, count: int) -> Indices:
    """Return bases (b, 3) of source points: wide triangles, each of a neighbourhood."""
    rng = np.random.default_rng(0)
    tree = cKDTree(points[moved])
    first = moved[rng.permutation(len(moved))[np.arange(count) % len(moved)]]
    around = tree.query(points[first], min(_neighbours(points) + 1, len(moved)))[1]
    around = around.reshape(count, -1)
    # The widest of several triangles determines the motion best. Every other base is compact, for small parts.
    size = around.shape[1]
    last = np.where(np.arange(count) % 2, size, max(size // COMPACT, min(size, 4)))
    drawn = 1 + (rng.random((count, DRAWN_TRIANGLES, 2)) * (last - 1)[:, None, None]).astype(np.int64)
    draws = moved[np.take_along_axis(around[:, None], drawn.reshape(count, 1, -1), 2).reshape(drawn.shape)]
    u, v = np.moveaxis(points[draws] - points[first][:, None, None], 2, 0)
    # Twice the area, squared: |u|^2 |v|^2 - (u v)^2.
    area = (u * u).sum(-1) * (v * v).sum(-1) - (u * v).sum(-1) ** 2
    widest = draws[np.arange(count), area.argmax(1)]
    return np.ascontiguousarray(np.column_stack([first, widest]))


def _longer_first(points: Array, bases: Indices) -> Indices:
    """Return bases (b, 3) with the second point farther from the first than the third is."""
    lengths = np.linalg.norm(points[bases[:, 1:]] - points[bases[:, :1]], axis=-1)
    return np.ascontiguousarray(np.where((lengths[:, 1] > lengths[:, 0])[:, None], bases[:, [0, 2, 1]], bases))


def _neighbours(points: Array) -> int:
    """Return the number of neighbours of a point that bases and matches come from."""
    return NEIGHBOURS if len(points) <= MANY_POINTS else NEIGHBOURS_OF_MANY


def _sample(moved: Indices) -> Indices:
    """Return at most `CHECKED_POINTS` sources, drawn at random."""
    order = np.random.default_rng(1).permutation(len(moved))
    return np.ascontiguousarray(moved[order[:CHECKED_POINTS]])


def _refine(
    points: Array,
    tree: Any,
    moved: Indices,
    motion: Motions,
    tolerance: float,
    labels3d: Indices | None,
    normals3d: Array | None,
) -> Motions:
    """Return a motion (1,) fitted to the nearest scene points of the moved ones, with the fraction that it maps.

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
    """
    own, near, reach, rigid = points[moved], np.zeros(len(moved), bool), 2 * tolerance, motion.scale[0] == 1
    for step in range(REFINEMENT_ROUNDS + 1):
        bound = reach * min(float(motion.scale[0]), 1.0)
        near, target = _mapped(tree, motion.apply(own)[0], motion.rotation[0], moved, bound, labels3d, normals3d)
        if step == REFINEMENT_ROUNDS or near.sum() < 3:
            break
        one, other = own[near], points[target[near]]
        centre, onto = one.mean(0), other.mean(0)
        left, stretch, right = np.linalg.svd((other - onto).T @ (one - centre))
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right) * np.linalg.det(motion.rotation[0]))])
        rotation = (left * sign) @ right
        scale = 1.0 if rigid else float((stretch * sign).sum() / max(((one - centre) ** 2).sum(), 1e-300))
        shift = onto - scale * rotation @ centre
        motion = motion._replace(rotation=rotation[None], shift=shift[None], scale=np.array([scale]))
        reach = tolerance if step else 1.5 * tolerance
    return motion._replace(fraction=np.array([near.mean()]))


def _mapped(
    tree: Any,
    moved: Array,
    rotation: Array,
    sources: Indices,
    reach: float | Array,
    labels3d: Indices | None,
    normals3d: Array | None,
) -> tuple[NDArray[np.bool_], Indices]:
    """Return which moved points (..., s, 3) of the sources (s,) lie on a scene point with a fitting label and normal.

    A point lies on the nearest scene point within `reach`, one or (..., 1) of the motions; the indices (..., s) of
    these are 0 if none is within reach.
    """
    distance, target = tree.query(moved, distance_upper_bound=np.max(reach, initial=0.0))
    near = distance < reach
    target = np.where(near, target, 0)
    if labels3d is not None:
        own, other = labels3d[sources], labels3d[target]
        near &= (own == other) | (own < 0) | (other < 0)
    if normals3d is not None:
        turned = normals3d[sources] @ np.swapaxes(rotation, -1, -2)
        near &= (turned * normals3d[target]).sum(-1) > 0.5
    return near, target


def _moves(motion: Motions, own: Array, least: float) -> bool:
    """Return whether a motion is not the identity: its root mean square shift of points (k, 3) exceeds `least`."""
    return float(np.sqrt(((motion.apply(own)[0] - own) ** 2).sum(-1).mean())) > least


@compiled
def _register(
    scene: SceneIndex,
    bases: Any,
    sample: Any,
    tolerance: float,
    least: int,
    factor: float,
    hand: float,
    most: int,
    found: Found,
    work: Any,
) -> Any:
    """Find the motions that map a base (3,) onto a congruent or similar one and that enough sampled points confirm.

    Two similar bases differ in size by more than the tolerance, and by at most the ratio `factor`, 1 for congruent
    bases. With the `hand` -1 a base is reflected in its plane before it is mapped. A moved point lies on a scene point
    within the tolerance; `least` sampled points must. `work` (4, 3, 3) is overwritten. `found` keeps the motions that
    the most points confirm. Return the number of motions, which may exceed its slots; and False if a base took more
    than the largest work, so that the rest of the scene was left out for it.
    """
    points, count, complete = scene.points, 0, True
    frame, target, linear, shift = work[0], work[1], work[2], work[3, 0]
    for base in range(len(bases)):
        a, b, c = bases[base, 0], bases[base, 1], bases[base, 2]
        ab, ac, bc = _between(points, a, b), _between(points, a, c), _between(points, b, c)
        if not _frame(points, a, b, c, frame):
            continue
        work_done = 0
        for i in range(len(points)):
            if work_done > most:
                complete = False
                break
            if not _fits(scene, a, i):
                continue
            row = scene.distance[i]
            first_j, last_j = _first_above(row, ab / factor - tolerance), _first_above(row, ab * factor + tolerance)
            first_l, last_l = 0, 0
            if factor == 1:
                first_l, last_l = _first_above(row, ac - tolerance), _first_above(row, ac + tolerance)
            scale, near = 1.0, tolerance
            for at_j in range(first_j, last_j):
                j = scene.neighbours[i, at_j]
                if j == i or not _fits(scene, b, j):
                    continue
                if factor > 1:
                    if abs(row[at_j] - ab) <= tolerance:
                        continue
                    scale = row[at_j] / ab
                    near = tolerance * min(scale, 1.0)
                    # Both limits grow with the scale, which grows with j.
                    while first_l < len(row) and row[first_l] < scale * ac - near:
                        first_l += 1
                    while last_l < len(row) and row[last_l] < scale * ac + near:
                        last_l += 1
                for at_l in range(first_l, last_l):
                    l = scene.neighbours[i, at_l]  # noqa: E741
                    work_done += 1
                    if l in (i, j) or not _fits(scene, c, l) or (hand > 0 and i == a and j == b and l == c):
                        continue
                    jl = _between(points, j, l)
                    if abs(jl - scale * bc) > near:
                        continue
                    if not _frame(points, i, j, l, target):
                        continue
                    size = (row[at_j] + row[at_l] + jl) / (ab + ac + bc) if factor > 1 else 1.0
                    for p in range(3):
                        for q in range(3):
                            linear[p, q] = size * (
                                target[0, p] * frame[0, q]
                                + hand * target[1, p] * frame[1, q]
                                + target[2, p] * frame[2, q]
                            )
                    for p in range(3):
                        x = (points[a, 0] + points[b, 0] + points[c, 0]) / 3
                        y = (points[a, 1] + points[b, 1] + points[c, 1]) / 3
                        z = (points[a, 2] + points[b, 2] + points[c, 2]) / 3
                        shift[p] = (points[i, p] + points[j, p] + points[l, p]) / 3 - (
                            linear[p, 0] * x + linear[p, 1] * y + linear[p, 2] * z
                        )
                    score, left = 0, len(sample)
                    for s in range(len(sample)):
                        if score + left < least or (score == 0 and s == FIRST_SAMPLED):
                            break
                        left -= 1
                        work_done += PAIRS_A_SAMPLE
                        score += _on(scene, linear, shift, sample[s], 2 * near)
                    if score >= least:
                        _keep(found, count, score, linear, shift)
                        count += 1
    return count, complete


@part
def _keep(found: Found, count: int, score: int, linear: Any, shift: Any) -> None:
    """Write the next motion, after `count` others, into a free slot of `found`, or over the worst if it is better."""
    slot = count
    if count >= len(found.score):
        slot = 0
        for e in range(1, len(found.score)):
            if found.score[e] < found.score[slot]:
                slot = e
        if found.score[slot] >= score:
            return
    found.score[slot] = score
    for p in range(3):
        found.shift[slot, p] = shift[p]
        for q in range(3):
            found.linear[slot, p, q] = linear[p, q]


@part
def _fits(scene: SceneIndex, a: int, i: int) -> Any:
    """Return whether the labels of two points are compatible."""
    one, other = scene.labels[a], scene.labels[i]
    return one < 0 or other < 0 or one == other


@part
def _between(points: Any, a: int, b: int) -> Any:
    """Return the distance of two points."""
    x, y, z = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
    return math.sqrt(x * x + y * y + z * z)


@part
def _first_above(row: Any, value: float) -> Any:
    """Return the index of the first of ascending distances that is not below the value."""
    low, high = 0, len(row)
    while low < high:
        middle = (low + high) // 2
        if row[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@part
def _frame(points: Any, a: int, b: int, c: int, frame: Any) -> Any:
    """Write the orthonormal frame of a triangle, row by row; return False where it is flat."""
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    long, normal = math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(nx * nx + ny * ny + nz * nz)
    if not (long > 0 and normal > 1e-6 * long * long):
        return False
    ux, uy, uz, nx, ny, nz = ux / long, uy / long, uz / long, nx / normal, ny / normal, nz / normal
    frame[0, 0], frame[0, 1], frame[0, 2] = ux, uy, uz
    frame[1, 0], frame[1, 1], frame[1, 2] = nx, ny, nz
    frame[2, 0], frame[2, 1], frame[2, 2] = uy * nz - uz * ny, uz * nx - ux * nz, ux * ny - uy * nx
    return True


@part
def _on(scene: SceneIndex, linear: Any, shift: Any, k: int, reach: Any) -> Any:
    """Return whether a moved point lies near a scene point."""
    points = scene.points
    x, y, z = points[k, 0], points[k, 1], points[k, 2]
    return lies_on(
        scene.table,
        linear[0, 0] * x + linear[0, 1] * y + linear[0, 2] * z + shift[0],
        linear[1, 0] * x + linear[1, 1] * y + linear[1, 2] * z + shift[1],
        linear[2, 0] * x + linear[2, 1] * y + linear[2, 2] * z + shift[2],
        reach,
    )
