"""Meshes: reading every format, refusing what is broken, sampling by area."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy import stats

from bpnp.datamodules.shapes import Mesh, MeshError, read_mesh, sample_surface

VERTICES = "0 0 0\n2 0 0\n2 1 0\n0 1 0\n0 0 3\n"
FACES = "4 0 1 2 3\n3 0 1 4\n"  # a rectangle of area 2 and a triangle of area 3


@pytest.mark.parametrize(
    "text",
    [
        f"OFF\n5 2 0\n{VERTICES}{FACES}",
        f"OFF5 2 0\n{VERTICES}{FACES}",
        f"OFF 5 2 0\n{VERTICES}{FACES}",
        f"\ufeffOFF\r\n# a comment\r\n5 2\r\n\r\n{VERTICES}{FACES}",
        f"OFF\n5 4 0\n{VERTICES}4 0 1 2 3 255 0 0\n2 0 1\n3 0 1 4 0.5 0.5 0.5  # colours\n1 2\n",
        "COFF\n5 2 0\n" + VERTICES.replace("\n", " 255 0 0 255\n") + FACES,
    ],
)
def test_every_off_header_and_polygons_and_colours_are_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mesh.off"
    path.write_text(text, encoding="utf-8")
    mesh = read_mesh(path)
    assert mesh.faces.tolist() == [[0, 1, 4], [0, 1, 2], [0, 2, 3]]
    assert mesh.areas.tolist() == [3.0, 1.0, 1.0]


BROKEN = {
    "empty": ("", "an OFF file begins with `OFF`"),
    "foreign": ("\x89PNG\r\n\x1a\n\x00", "an OFF file begins with `OFF`"),
    "no counts": ("OFF\n", "numbers of vertices and faces"),
    "binary": ("OFF BINARY\n\x00\x01", "numbers of vertices and faces"),
    "truncated vertices": ("OFF\n5 2 0\n0 0 0\n2 0 0\n", "truncated"),
    "truncated faces": (f"OFF\n5 2 0\n{VERTICES}4 0 1 2 3\n", "truncated"),
    "truncated line": (f"OFF\n5 2 0\n{VERTICES}4 0 1 2 3\n3 0 1", "not numbers"),
    "words": (f"OFF\n5 2 0\n{VERTICES.replace('2', 'two')}{FACES}", "not numbers"),
    "no faces": (f"OFF\n5 0 0\n{VERTICES}", "the mesh has no faces"),
    "nan": (f"OFF\n5 2 0\n{VERTICES.replace('3', 'nan')}{FACES}", "NaN or infinite"),
    "missing vertex": (f"OFF\n5 2 0\n{VERTICES}4 0 1 2 3\n3 0 1 5\n", "use the vertices 0 to 5, but there are only 5"),
    "no area": ("OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n", "needs a positive area"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_off_is_one_error_that_names_the_file(tmp_path: Path, kind: str) -> None:
    text, reason = BROKEN[kind]
    path = tmp_path / "chair_0001.off"
    path.write_bytes(text.encode())
    with pytest.raises(MeshError, match=rf"^{re.escape(str(path))}: .*{reason}"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_every_mesh_format_is_read_and_a_truncated_file_refused(tmp_path: Path, suffix: str) -> None:
    """Two boxes of a scene become one mesh, each where the scene puts it."""
    moved = trimesh.creation.box(transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    path = tmp_path / f"boxes{suffix}"
    if suffix == ".glb":
        trimesh.Scene([trimesh.creation.box(), moved]).export(path)
    else:
        trimesh.util.concatenate([trimesh.creation.box(), moved]).export(path)
    mesh = read_mesh(path)
    assert mesh.areas.sum() == pytest.approx(12)
    assert (mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()) == ([-0.5] * 3, [5.5, 0.5, 0.5])
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(MeshError, match=re.escape(str(path))):
        read_mesh(path)
    path.write_bytes(b"")
    with pytest.raises(MeshError, match="empty"):
        read_mesh(path)


QUADS = (
    "ply\nformat ascii 1.0\ncomment from a scanner\nelement vertex 8\nproperty float x\nproperty float y\n"
    "property float z\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    "-1 -1 -1\n-1 -1 1\n-1 1 -1\n-1 1 1\n1 -1 -1\n1 -1 1\n1 1 -1\n1 1 1\n"
    "4 0 1 3 2\n4 4 6 7 5\n4 0 4 5 1\n4 2 3 7 6\n4 0 2 6 4\n4 1 5 7 3\n"
)


def test_a_text_ply_that_is_cut_anywhere_is_refused(tmp_path: Path) -> None:
    """Six squares, of which trimesh reads as many as are left; only a last number that is cut cannot be noticed."""
    path = tmp_path / "cube.ply"
    for text in (QUADS, QUADS.rstrip(), QUADS.replace("\n", "\r\n")):
        path.write_bytes(text.encode())
        assert read_mesh(path).areas.sum() == 24
    body = QUADS.index("end_header") + len("end_header\n")
    for end in range(body, len(QUADS.rstrip())):
        path.write_text(QUADS[:end], encoding="utf-8")
        with pytest.raises(MeshError, match=r"truncated: its header declares 14 rows \(8 vertex, 6 face\), and it has"):
            read_mesh(path)


def test_real_meshes_are_those_that_trimesh_reads(shared_data: Path) -> None:
    files = sorted((shared_data / "psb").glob("*/test/*.off"))[::60]
    assert files
    for path in files:
        mesh, other = read_mesh(path), trimesh.load(path, force="mesh", process=False)
        np.testing.assert_array_equal(mesh.vertices, other.vertices)
        assert mesh.areas.sum() == pytest.approx(other.area)


def test_samples_are_uniform_by_area() -> None:
    """A rectangle of area 2, a triangle of area 3 and one of no area: counts, and uniform within the rectangle."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [0, 0, 3.0]])
    mesh = Mesh(vertices, np.array([[1, 1, 2], [0, 1, 4], [0, 1, 2], [0, 2, 3], [4, 4, 4]]))
    points = sample_surface(mesh, 20_000, np.random.default_rng(0))
    flat = points[:, 2] == 0
    assert ((points[:, 1] == 0) | flat).all()
    assert stats.binomtest(int(flat.sum()), len(points), 2 / 5).pvalue > 1e-3
    assert stats.kstest(points[flat, 0], stats.uniform(0, 2).cdf).pvalue > 1e-3
    assert stats.kstest(points[flat, 1], stats.uniform(0, 1).cdf).pvalue > 1e-3
    np.testing.assert_allclose(points[~flat].mean(0), [2 / 3, 0, 1], atol=0.03)  # centroid of the triangle
