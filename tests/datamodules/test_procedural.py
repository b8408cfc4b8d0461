"""Procedural shapes: reproducible, disjoint between splits, varied, and without a symmetry that would hide the pose."""

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform

from bpnp.datamodules.shapes import normalise, procedural_shape, procedural_shapes, sample_surface


def samples(split: str, count: int, *, seed: int = 0) -> np.ndarray:
    shapes = procedural_shapes(split, count, seed=seed)
    assert list(shapes.samplers) == [f"procedural/{split}/00000{i}" for i in range(count)]
    return np.stack([sampler(64) for sampler in shapes.samplers.values()])


def test_a_shape_depends_on_seed_split_and_number_alone() -> None:
    few, many = samples("train", 3), samples("train", 6)
    np.testing.assert_array_equal(few, many[:3])
    others = samples("test", 3), samples("val", 3), samples("train", 3, seed=1)
    drawn = np.concatenate([many, *others]).reshape(15, -1)
    assert len(np.unique(drawn, axis=0)) == 15


def test_shapes_are_connected_and_varied() -> None:
    """Samples of a shape are linked by short steps; elongations (ratios of principal deviations) spread widely."""
    ratios = []
    for i in range(30):
        rng = np.random.default_rng(i)
        points = normalise(sample_surface(procedural_shape(rng), 600, rng), "unit_sphere")
        near = squareform(pdist(points)) < 0.3
        assert connected_components(near)[0] == 1
        deviations = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
        ratios.append(deviations[:2] / deviations[2])
    low, high = np.quantile(ratios, [0.1, 0.9], axis=0)
    assert (high - low > 0.2).all()
