"""Procedural shapes: reproducible, disjoint between splits, varied, and without a symmetry that would hide the pose."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from bpnp.cli import main
from bpnp.datamodules import MeshDataModule
from bpnp.datamodules.shapes import (
    Mesh,
    ProceduralKind,
    aligned_shape,
    normalise,
    procedural_shape,
    procedural_shapes,
    sample_surface,
)


def samples(split: str, count: int, *, seed: int = 0, kind: ProceduralKind = "turned") -> np.ndarray:
    shapes = procedural_shapes(split, count, seed=seed, kind=kind)
    name = {"turned": "procedural", "aligned": "aligned"}[kind]
    assert list(shapes.samplers) == [f"{name}/{split}/00000{i}" for i in range(count)]
    return np.stack([sampler(64) for sampler in shapes.samplers.values()])


@pytest.mark.parametrize("kind", ["turned", "aligned"])
def test_a_shape_depends_on_seed_split_and_number_alone(kind: ProceduralKind) -> None:
    few, many = samples("train", 3, kind=kind), samples("train", 6, kind=kind)
    np.testing.assert_array_equal(few, many[:3])
    others = samples("test", 3, kind=kind), samples("val", 3, kind=kind), samples("train", 3, seed=1, kind=kind)
    drawn = np.concatenate([many, *others]).reshape(15, -1)
    assert len(np.unique(drawn, axis=0)) == 15


@pytest.mark.parametrize("draw", [procedural_shape, aligned_shape])
def test_shapes_are_connected_and_varied(draw: Callable[[np.random.Generator], Mesh]) -> None:
    """Samples of a shape are linked by short steps; elongations (ratios of principal deviations) spread widely."""
    ratios, connected = [], []
    for i in range(30):
        rng = np.random.default_rng(i)
        points = normalise(sample_surface(draw(rng), 600, rng), "unit_sphere")
        near = squareform(pdist(points)) < 0.3
        connected.append(connected_components(near)[0] == 1)
        deviations = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
        ratios.append(deviations[:2] / deviations[2])
    # A part at the bounding box of a torus or a cone may leave a gap.
    assert np.mean(connected) >= (1.0 if draw is procedural_shape else 0.9)
    low, high = np.quantile(ratios, [0.1, 0.9], axis=0)
    assert (high - low > 0.2).all()


def axis_parallel(mesh: Mesh) -> float:
    """Fraction of the surface whose normal is parallel to an axis."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    areas = np.linalg.norm(cross, axis=1)
    return float(areas[np.abs(cross).max(1) > 0.999 * areas].sum() / areas.sum())


def test_aligned_shapes_have_faces_along_the_axes_and_most_a_plane_of_symmetry() -> None:
    parallel, mirrored = [], []
    for i in range(40):
        rng = np.random.default_rng(i)
        mesh = aligned_shape(rng)
        parallel.append(axis_parallel(mesh))
        points = sample_surface(mesh, 2000, rng)
        distances = cKDTree(points).query(points * [-1, 1, 1])[0]
        again = cKDTree(points).query(sample_surface(mesh, 2000, rng))[0]
        mirrored.append(distances.mean() < 1.3 * again.mean())
    turned = [axis_parallel(procedural_shape(np.random.default_rng(i))) for i in range(40)]
    assert np.mean(parallel) > 0.6
    assert np.mean(turned) < 0.05
    assert 0.5 < np.mean(mirrored) < 0.95


def test_the_kind_reaches_the_data_and_an_unknown_one_is_refused(tmp_path: Path) -> None:
    def first(kind: ProceduralKind) -> np.ndarray:
        options = {"num_points": 30, "pool_size": 30, "train_shapes": 2, "val_shapes": 1}
        data = MeshDataModule(**options, procedural_kind=kind, cache_dir=str(tmp_path))
        data.setup("fit")
        return data.datasets["train"].problem(0).points3d[0].numpy()

    expected = {
        kind: normalise(sampler(30), "unit_sphere")
        for kind in ("turned", "aligned")
        for sampler in list(procedural_shapes("train", 2, seed=0, kind=kind).samplers.values())[:1]
    }
    for kind, points in expected.items():
        distances = cKDTree(points).query(first(kind))[0]
        assert distances.max() < 1e-5


def test_an_unknown_kind_is_refused_with_the_known_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["fit", "--config=procedural", "--data.procedural_kind=tall", f"--data.cache_dir={tmp_path}"])
    assert "procedural_kind" in (shown := capsys.readouterr().err)
    assert "aligned" in shown
