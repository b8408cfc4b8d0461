"""Starts from anywhere from where points are seen, each aimed at where its points fall best in the image.

A point with a cone is seen by cameras within it. So a start takes a point, a direction within its cone, a distance and
a roll: four numbers instead of the six of a pose. The other two say where the camera looks, and all of them are tried
at once: the score of `bpnp.search.sources.raster`, as a function of the shift of the points in the image, is a sum of
copies of the view's raster, each shifted to the place of a point.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.loops.parallel import in_time
from bpnp.search.candidates import Candidates
from bpnp.search.kernels.raster import Raster, add_shifted
from bpnp.search.kernels.sides import WeightedPoints
from bpnp.search.kernels.sparse import LANES
from bpnp.search.scene import Scene
from bpnp.search.settings import RasterSearch
from bpnp.search.sources.raster import narrowed, raster_of
from bpnp.search.starts import Array

AT_ONCE = 256  # scores of so many poses in memory; for 32 x 32 shifts 1 MB


def within_cones(scene: Scene, rule: RasterSearch) -> Candidates:
    """Distinct poses from starts within the cones of the points, of which there must be some."""
    starts = drawn_in_cones(scene, rule.draws.starts)
    raster = raster_of(scene, replace(rule.raster, cells=scene.settings.cones.aim_cells), rule.narrowing.first_scale)
    points = scene.seen_points(rule.screens.points[0])
    score, shift = np.empty(len(starts), np.float32), np.empty((len(starts), 2), np.float32)

    def aim(i: int, j: int) -> None:
        for k in range(i, j, AT_ONCE):
            part = slice(k, min(k + AT_ONCE, j))
            score[part], shift[part] = best_shifts(starts[part], raster, points)

    done = in_time(aim, len(starts), scene.deadline, scene.settings.lookups_a_check)
    best = np.argsort(-score[:done], kind="stable")[: rule.screens.kept[0]]
    return narrowed(scene, shifted(starts[best], shift[best]), rule)


def drawn_in_cones(scene: Scene, count: int) -> Candidates:
    """Poses that see a point each within its cone, from about the weak-perspective distance, rolled by any angle, the
    middle of the points in the direction (0, 0, 1)."""
    rng, middle = scene.rng, scene.bulk3d.mean(0).astype(np.float64)
    j = rng.integers(len(scene.points3d), size=count)
    axis, cosine = scene.seen.cones[j, :3].astype(np.float64), rng.uniform(np.maximum(scene.seen.cones[j, 3], -1), 1)
    towards = cosine[:, None] * axis + np.sqrt(1 - cosine**2)[:, None] * _across(axis, rng)
    covariance = np.cov(scene.bulk3d.T, bias=True)
    along = np.einsum("si,ij,sj->s", towards, covariance, towards)
    extent = np.sqrt(np.maximum(np.trace(covariance) - along, 0))
    depth = extent / scene.spread * np.exp(scene.settings.cones.log_depth * rng.uniform(-1, 1, count))
    centre = scene.points3d[j] + depth[:, None] * towards
    forward = middle - centre
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-12)
    right = _across(forward, rng)
    rotation = np.stack([right, np.cross(forward, right), forward], 1).astype(np.float32)
    translation = -np.einsum("sij,sj->si", rotation, centre)
    return Candidates.unscored(rotation, translation.astype(np.float32), hits=1)


def best_shifts(poses: Candidates, raster: Raster, points: WeightedPoints) -> tuple[Array, Array]:
    """The largest score (s,) of each pose over all shifts of its points by up to half of the raster, and that shift
    (s, 2), whole cells."""
    count = LANES * math.ceil(len(raster.values) / LANES)
    half = np.float32(raster.half + count / 2 / raster.per_cell)
    padded = Raster(np.pad(raster.values, ((0, 0), (count, count))), half, raster.per_cell)
    scores, weight = np.zeros((len(poses), count, count), np.float32), np.empty_like(points.b)
    add_shifted(scores, padded, points, poses.rotation, poses.translation, weight)
    flat = scores.reshape(len(poses), -1)
    best = flat.argmax(1)
    shift = (np.stack([best % count, best // count], -1) - count // 2) / raster.per_cell
    return flat[np.arange(len(poses)), best], shift.astype(np.float32)


def shifted(poses: Candidates, shift: Array) -> Candidates:
    """Poses turned about their centres so that what is seen at (0, 0, 1) is seen at `shift` (s, 2) of the raster."""
    length = np.linalg.norm(shift, axis=-1)
    angle = 2 * np.arctan(length / 2) / np.maximum(length, 1e-12)
    vectors = angle[:, None] * np.stack([-shift[:, 1], shift[:, 0], np.zeros(len(shift))], -1)
    turn = Rotation.from_rotvec(vectors).as_matrix().astype(np.float32)
    translation = np.einsum("sij,sj->si", turn, poses.translation)
    return replace(poses, rotation=turn @ poses.rotation, translation=translation)


def _across(axis: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Unit vectors (s, 3) at right angles to others, each in a random direction."""
    drawn = rng.standard_normal(axis.shape)
    drawn -= (drawn * axis).sum(-1, keepdims=True) * axis
    return np.asarray(drawn / np.linalg.norm(drawn, axis=-1, keepdims=True))
