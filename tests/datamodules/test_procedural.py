"""Procedural shapes: reproducible, disjoint between splits, varied, and without a symmetry that would hide the pose."""

from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform

from bpnp.datamodules.meshes import POINTS, open_surfaces
from bpnp.datamodules.store import Store
from bpnp.datamodules.surfaces import ProceduralShapes, normalise, procedural_shape, sample_surface


def shapes(folder: Path, split: str, count: int, *, seed: int = 0) -> Store:
    drawn = ProceduralShapes(split, seed, range(count))
    return open_surfaces(drawn, points=64, normalisation="unit_sphere", cache_dir=str(folder))


def test_a_shape_depends_on_seed_split_and_number_alone(tmp_path: Path) -> None:
    few, many = shapes(tmp_path / "0", "train", 3), shapes(tmp_path / "1", "train", 6)
    np.testing.assert_array_equal(few.bulk[POINTS], many.bulk[POINTS][: 3 * 64])
    assert [few.name(i) for i in range(3)] == [f"procedural/train/00000{i}" for i in range(3)]
    others = [shapes(tmp_path, "test", 3), shapes(tmp_path, "val", 3), shapes(tmp_path, "train", 3, seed=1)]
    drawn = np.concatenate([many.bulk[POINTS], *(other.bulk[POINTS] for other in others)]).reshape(15, -1)
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
