"""Compiles every loop of the search, so that none is compiled in mid-stream."""

import numpy as np

from bpnp.loops.parallel import NEVER, one_blas_thread
from bpnp.search.annealing import run_batch
from bpnp.search.candidates import Candidates
from bpnp.search.enumeration.search import search_by_enumeration
from bpnp.search.infinity.kernels import Image
from bpnp.search.infinity.search import search_rotation
from bpnp.search.kernels.neighbours import hashed
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.sources.cones import best_shifts
from bpnp.search.sources.raster import looked_up, raster_of

POINTS = 8


@one_blas_thread
def warm_up() -> None:
    """Compile the loops of the search, for some seconds; at once where they were compiled before.

    A tracker calls it before its first frame: what is kept on disk still has to be read, at the first call of each.
    """
    points = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3))
    rays = points + (0, 0, 6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    sets = PointSets(rays, points)
    search_by_enumeration(sets, NEVER, DEFAULT)
    hashed(points, 0.1).count_on(points, points, 1)
    search_rotation(Image(rays, np.full(POINTS, 1e-3)), rays)
    scene = Scene(sets, 0, DEFAULT)
    start = Candidates.unscored(*scene.enter(np.eye(3)[None], np.array([[0, 0, 6.0]])))
    run_batch(scene, start)
    looks = DEFAULT.beside.raster, DEFAULT.beside.narrowing.first_scale
    looked_up(scene, start, *looks, POINTS, 1)
    best_shifts(start, raster_of(scene, *looks), scene.seen_points(POINTS))
