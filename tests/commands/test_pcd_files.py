"""Point clouds in .pcd files, written here by hand as the format's page describes them, against the same text."""

from pathlib import Path

import numpy as np
import pytest

from bpnp.commands.point_files import read_points3d

ROWS = np.array([[0.5, -1, 2, 7], [1e-3, 4, 5.25, 7], [-6, 7, 8, 2], [9, 1, 1, 0]])
HEADER = (
    "# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH 4\nHEIGHT 1\n"
)
END = "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA {}\n"


def header(fields: str = "x y z label", *, size: str = "4 4 4 4", kind: str = "F F F U", count: str = "1 1 1 1") -> str:
    return HEADER.format(fields, size, kind, count)


def test_an_ascii_cloud_equals_the_text(tmp_path: Path) -> None:
    lines = "\n".join(f"{x:g} {y:g} {z:g} {label:g}" for x, y, z, label in ROWS)
    (tmp_path / "a.pcd").write_text(header() + END.format(4, "ascii") + lines + "\n")
    (tmp_path / "a.csv").write_text("x y z label\n" + lines)
    read = [read_points3d(tmp_path / name) for name in ("a.pcd", "a.csv")]
    for pcd, csv in zip(*read, strict=True):
        assert (pcd is None) == (csv is None)
        if pcd is not None and csv is not None:
            np.testing.assert_array_equal(pcd, csv)


def test_a_binary_cloud_with_normals_and_padding_is_read(tmp_path: Path) -> None:
    kind = np.dtype([("x", "<f4", 3), ("_", "<u1", 4), ("histogram", "<f4", 2), ("normal", "<f8", 3)])
    cloud = np.zeros(4, kind)
    cloud["x"], cloud["normal"], cloud["histogram"] = ROWS[:, :3], [0, 0.6, 0.8], 5
    fields = "x y z _ histogram normal_x normal_y normal_z"
    head = header(fields, size="4 4 4 1 4 8 8 8", kind="F F F U F F F F", count="1 1 1 4 2 1 1 1")
    (tmp_path / "a.pcd").write_bytes((head + END.format(4, "binary")).encode() + cloud.tobytes())
    points, normals, labels, _ = read_points3d(tmp_path / "a.pcd")
    np.testing.assert_array_equal(points, ROWS[:, :3].astype(np.float32))
    np.testing.assert_array_equal(normals, np.tile([0, 0.6, 0.8], (4, 1)))
    assert labels is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its header has no line DATA"),
        (header() + END.format(4, "ascii") + "1 2 3 4\n", "its header states 4 points, and it has 1 rows"),
        (header() + END.format(1, "ascii") + "1 2 3\n", "its rows have 3 numbers, and its header states 4"),
        (header() + END.format(1, "ascii") + "1 2 3 x\n", "its rows are not 4 numbers each"),
        (header() + END.format(999999999, "binary") + "1234", "15999999984 bytes, and there are at most 4"),
        (header() + END.format(10**15, "binary") + "1234", "SIZE, TYPE, COUNT or POINTS hold something else"),
        (header() + END.format(1, "binary_compressed"), "its data are binary_compressed; write them as ascii"),
        (header("a b c label") + END.format(1, "ascii") + "1 2 3 4\n", "it needs the fields x, y, z; its fields are a"),
        (header("x y z") + END.format(1, "ascii") + "1 2 3\n", "have different numbers of words"),
        (header(size="3 4 4 4") + END.format(0, "binary"), "its fields have sizes that do not exist"),
        (header(count="999999999 1 1 1") + END.format(9, "binary") + "1", "header states|do not exist"),
    ],
)
def test_a_broken_cloud_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_text(text)
    with pytest.raises(ValueError, match=f"a.pcd: .*({message})"):
        read_points3d(tmp_path / "a.pcd")
