"""Compiles every loop of the search, so that none is compiled in mid-stream."""

import numpy as np

from bpnp.loops.parallel import NEVER, one_blas_thread
from bpnp.loops.vectors import F
from bpnp.search.enumeration.search import search_by_enumeration
from bpnp.search.infinity.kernels import Image
from bpnp.search.infinity.search import search_rotation
from bpnp.search.kernels.dense import dense_scratch, descend
from bpnp.search.kernels.neighbours import HashedPoints, sums_near
from bpnp.search.kernels.raster import Raster, add_shifted, add_up
from bpnp.search.kernels.sides import WeightedBearings, WeightedPoints, blocks_of
from bpnp.search.kernels.sparse import build_tiles, descend_sparse, sparse_scratch
from bpnp.search.point_sets import PointSets
from bpnp.search.settings import DEFAULT

POINTS = 8


@one_blas_thread
def warm_up() -> None:
    """Compile the loops of the search, for some seconds; at once where they were compiled before.

    A tracker calls it before its first frame: what is kept on disk still has to be read, at the first call of each.
    """
    points = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3))
    rays = points + (0, 0, 6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    search_by_enumeration(PointSets(rays, points), NEVER, DEFAULT)
    HashedPoints(points, 0.1).count_on(points, points, 1)
    sums_near(rays, rays, np.eye(3)[:, :2].copy(), np.array([0.1, 0.2]), np.array([1.0, 0.0]))
    search_rotation(Image(rays, np.full(POINTS, 1e-3)), rays)
    _warm_annealing(points, rays)


def _warm_annealing(points: np.ndarray, rays: np.ndarray) -> None:
    one, free = np.ones(POINTS, F), np.full(POINTS, -1, np.int32)
    f, p = (np.ascontiguousarray(side.T, F) for side in (rays - (0, 0, 1), points))
    image = WeightedBearings(f, one, one, free)
    scene = WeightedPoints(p, one, one, free, blocks_of(free, free), np.empty((6, 0), F))
    pose = np.eye(3, dtype=F)[None].copy(), np.array([[0, 0, 6]], F)
    scales, outlier, score = np.array([0.1, 0.05], F), F(1), np.zeros(1, F)
    descend(image, scene, *pose, scales, outlier, score, dense_scratch(POINTS, POINTS))
    tiles = build_tiles(image).with_margin(0.1)
    descend_sparse(tiles, scene, *pose, scales, outlier, 3, np.empty((1, 3), F), sparse_scratch(tiles, POINTS))
    raster, weight, cell = np.zeros((4, 4), F), np.empty(POINTS, F), np.empty(POINTS, np.int32)
    add_up(Raster(raster, F(1), F(2)), scene, *pose, score, weight, cell)
    add_shifted(np.zeros((1, 16, 16), F), Raster(np.zeros((4, 36), F), F(1), F(2)), scene, *pose, weight)
