"""Files of points and cameras, against what was written into them."""

import io
import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bpnp.cameras import camera_from
from bpnp.commands.point_files import read_camera, read_points2d, read_points3d, read_pose

POINTS = np.random.default_rng(0).normal(size=(20, 3))


def rows(points: np.ndarray, separator: str) -> str:
    return "\n".join(separator.join(map(repr, row)) for row in points.tolist())


def points_of(path: Path, **options: int) -> np.ndarray:
    return read_points3d(path, **options)[0]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "x,y,z\n" + rows(POINTS, ",")),
        ("a.csv", "\ufeff" + rows(POINTS, ", ")),
        ("a.csv", rows(POINTS, ";") + "\r\n\r\n"),
        ("a.txt", "# X Y Z\n\n" + rows(POINTS, " ")),
        ("a.txt", rows(POINTS, "\t") + " # last"),
        ("a.xyz", rows(POINTS, "  ")),
    ],
)
def test_text_columns_are_read_in_any_layout(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(points_of(tmp_path / name), POINTS)
    np.testing.assert_array_equal(read_points2d(tmp_path / name)[0], POINTS)


def test_npy_files_of_any_dtype_and_opencv_shape_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for dtype in (np.float32, np.float64, np.int32, ">f8"):
        np.save(path, POINTS.astype(dtype))
        np.testing.assert_array_equal(points_of(path), POINTS.astype(dtype).astype(np.float64))
    for shape in ((20, 2), (20, 1, 2)):  # OpenCV's
        np.save(path, POINTS[:, :2].reshape(shape))
        np.testing.assert_array_equal(read_points2d(path)[0], POINTS[:, :2])


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_cloud_keeps_the_order_of_its_points(encoding: str, tmp_path: Path) -> None:
    cloud = np.concatenate([POINTS, POINTS[:2]]).astype(np.float32)
    (tmp_path / "cloud.ply").write_bytes(trimesh.PointCloud(cloud).export(file_type="ply", encoding=encoding))
    np.testing.assert_allclose(points_of(tmp_path / "cloud.ply"), cloud, atol=1e-6)


@pytest.mark.parametrize("suffix", [".off", ".ply", ".obj", ".stl", ".glb"])
def test_a_mesh_gives_its_corners_or_its_surface(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box(extents=(2, 4, 6)).export(path)
    corners = points_of(path)
    assert {tuple(corner) for corner in corners.tolist()} == {
        (x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)
    }
    assert len(corners) == 8
    surface = points_of(path, surface=500, seed=1)
    assert surface.shape == (500, 3)
    np.testing.assert_allclose((np.abs(surface) / [1, 2, 3]).max(-1), 1, atol=1e-6)
    assert (points_of(path, surface=500, seed=1) == surface).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.csv",
            b"1,2,3\n4,5\n",
            "has rows of 3 and of 2 columns, such as '1,2,3' and '4,5'; each row needs the same, x, y, z",
        ),
        ("a.csv", b"1,2,3\n4,,6\n", "needs rows of numbers, x, y, z; it has '4,,6'"),
        ("a.csv", b"1,2,3\nx,y,z\n", "needs rows of numbers, x, y, z; it has 'x,y,z'"),
        ("a.csv", b"", "a.csv has no lines of numbers"),
        ("a.csv", b"x,y,z\n", "lines of numbers"),
        ("a.csv", b"1,2\n3,4\n", r"needs 3 to 4 or .*its shape is \(2, 2\) \(are the two files swapped\?\)"),
        ("a.csv", b"1,2,3,4,5\n", r"needs 3 to 4 or 6 to 7 columns .*its shape is \(1, 5\)$"),
        ("a.csv", b"x,y,z\nLED,2,3\n", "needs rows of numbers, x, y, z; it has 'LED,2,3'"),
        ("a.csv", b"x;y;z\n1.000,5;2;3\n", "needs rows of numbers, x, y, z; it has '1.000,5;2;3'"),
        ("a.csv", b"a,b,label\n1,2,3\n", "a.csv needs columns x, y, z; its columns are a, b, label"),
        ("a.csv", b"x,y,z,label\n1,2,3,0.5\n", "the column label of .*a.csv holds 0.5; labels are integers"),
        ("a.txt", b"\xff\xfe\x00", "rows of numbers from .*a.txt"),
        ("a.npy", b"not numpy", "rows of numbers from .*a.npy"),
        ("a.npy", b"", "rows of numbers from .*a.npy"),
        ("a.jpg", b"", "a.jpg has to end in .npy, .csv, .txt, .xyz, .pcd, .glb, .obj, .off, .ply, .stl"),
        ("a.ply", b"", "a.ply: the file is empty"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n0 0 0\n1 1 1\n",
            r"a.ply: the file is truncated: its header declares 4 rows \(4 vertex\), and it has 2",
        ),
        ("a.stl", b"no mesh", "a.stl: the file has 0 points"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n", "truncated"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n1000000000000 0 1 2\n", "a face states 1000000000000 corners"),
    ],
)
def test_a_broken_file_is_named(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_points3d(tmp_path / name)


def test_a_file_that_holds_no_points_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    with pytest.raises(ValueError, match="there is no file .*nowhere.npy"):
        read_points3d(tmp_path / "nowhere.npy")
    for content in (np.array([{"a": 1}], dtype=object), np.zeros(3), np.zeros((4, 3, 3))):
        np.save(path, content)
        with pytest.raises(ValueError, match="rows of numbers"):
            read_points3d(path)
    np.save(path, POINTS)
    with pytest.raises(ValueError, match="--surface draws points from a mesh, and"):
        read_points3d(path, surface=9)
    np.save(path, POINTS[:, :1])
    with pytest.raises(ValueError, match=r"needs points with 2 or 3 columns; its shape is \(20, 1\)"):
        read_points2d(path)
    trimesh.creation.box().export(tmp_path / "a.ply")
    with pytest.raises(ValueError, match="has to end in .npy, .csv, .txt, .xyz$"):
        read_points2d(tmp_path / "a.ply")


def test_a_camera_is_read_from_a_file_or_from_a_colmap_name(tmp_path: Path) -> None:
    matrix = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    np.save(tmp_path / "k.npy", matrix)
    (tmp_path / "k.txt").write_text(rows(matrix, " "))
    for name in ("k.npy", "k.txt"):
        np.testing.assert_array_equal(read_camera(str(tmp_path / name)), matrix)
    params = [500.0, 510.0, 320.0, 240.0]
    assert read_camera("PINHOLE,500,510,320,240") == ("PINHOLE", params)
    assert read_camera("pinhole 500 510 320 240") == ("PINHOLE", params)
    assert read_camera("PINHOLE 640 480 500 510 320 240") == ("PINHOLE", 640.0, 480.0, params)


def test_the_camera_of_an_image_is_read_from_a_model_with_several(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n7 PINHOLE 100 80 90 91 50 40\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.jpg\n3 4 1\n2 1 0 0 0 0 0 2 7 b.jpg\n5 6 1\n")
    (tmp_path / "points3D.txt").write_text("1 0 0 5 0 0 0 0 1 0 2 0\n")
    model, *size, params = read_camera(str(tmp_path), "b.jpg")
    assert (model, size, list(params)) == ("PINHOLE", [100, 80], [90, 91, 50, 40])
    with pytest.raises(ValueError, match="has 2 cameras; choose one by --image, such as a.jpg, b.jpg"):
        read_camera(str(tmp_path / "cameras.txt"))
    with pytest.raises(ValueError, match="has no image 'c.jpg' with a camera; its images are a.jpg, b.jpg"):
        read_camera(str(tmp_path), "c.jpg")
    with pytest.raises(ValueError, match="--image needs a COLMAP model as --camera, which is 'PINHOLE"):
        read_camera("PINHOLE,500,510,320,240", "a.jpg")


def test_files_of_other_formats_with_the_names_of_colmap_are_read(tmp_path: Path) -> None:
    """Beside a COLMAP model too, whose points and camera are others."""
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.jpg\n3 4 1\n")
    (tmp_path / "points3D.txt").write_text("1 0 0 5 0 0 0 0 1 0\n")
    np.save(tmp_path / "points3D.npy", POINTS)
    trimesh.PointCloud(POINTS).export(tmp_path / "points3D.ply")
    for name in ("points3D.npy", "points3D.ply"):
        np.testing.assert_allclose(points_of(tmp_path / name), POINTS, atol=1e-6)
    np.testing.assert_array_equal(points_of(tmp_path / "points3D.txt"), [[0, 0, 5]])
    matrix = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    (tmp_path / "cameras.csv").write_text(rows(matrix, ","))
    np.testing.assert_array_equal(read_camera(str(tmp_path / "cameras.csv")), matrix)
    assert read_camera(str(tmp_path / "cameras.txt"))[0] == "SIMPLE_PINHOLE"


@pytest.mark.parametrize("text", ["PINHOLE", "500,500,320", "500,500,320,240,0", "PINHOLE,wide", ""])
def test_a_text_that_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is neither a file with .* nor fx,fy,cx,cy nor MODEL,PARAMETERS"):
        read_camera(text)


@pytest.mark.parametrize("text", ["nope.csv", "k.npy", "folder/camera", "my camera.yaml", "cameras.bin", "K.TXT"])
def test_a_file_of_a_camera_that_does_not_exist_is_named(text: str) -> None:
    with pytest.raises(ValueError, match=f"^there is no file {text}, which --camera names$"):
        read_camera(text)


@pytest.mark.parametrize("text", ["500,510,320.5,240", "500 510 320.5 240", "500, 510, 320.5, 240"])
def test_four_numbers_are_the_camera_of_a_matrix(text: str) -> None:
    matrix = [[500, 0, 320.5], [0, 510, 240], [0, 0, 1]]
    np.testing.assert_array_equal(camera_from(read_camera(text)).matrix, matrix)


def test_normals_and_labels_are_found_by_column_name_or_position(tmp_path: Path) -> None:
    named, plain, image = (tmp_path / name for name in ("named.csv", "plain.txt", "image.csv"))
    named.write_text("label,x,y,z,nx,ny,nz\n7,1,2,3,0,0,1\n-1,4,5,6,1,0,0\n")
    plain.write_text("1 2 3 0 0 1 7\n4 5 6 1 0 0 -1\n")
    for path in (named, plain):
        points, normals, labels, scores = read_points3d(path)
        assert scores is None
        np.testing.assert_array_equal(points, [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_array_equal(normals, [[0, 0, 1], [1, 0, 0]])
        np.testing.assert_array_equal(labels, [7, -1])
    image.write_text("x;y;label\n10;20;7\n30;40;8\n")
    points, _, labels, _ = read_points2d(image)
    np.testing.assert_array_equal(points, [[10, 20], [30, 40]])
    np.testing.assert_array_equal(labels, [7, 8])


def test_scores_are_a_column_of_their_name(tmp_path: Path) -> None:
    image, scene, cloud = (tmp_path / name for name in ("x.csv", "p.txt", "a.ply"))
    image.write_text("x,y,score\n10,20,0.5\n30,40,1\n")
    scene.write_text("score x y z\n1e-3 1 2 3\n1 4 5 6\n")
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", "score"))
    cloud.write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n1 2 3 0.25\n")
    assert np.array_equal(read_points2d(image).scores, [0.5, 1])  # type: ignore[arg-type]
    assert np.array_equal(read_points3d(scene).scores, [1e-3, 1])  # type: ignore[arg-type]
    assert np.array_equal(read_points3d(cloud).scores, [0.25])  # type: ignore[arg-type]
    for wrong in ("0", "37", "nan", "-0.5"):
        image.write_text(f"x,y,score\n10,20,0.5\n30,40,{wrong}\n")
        with pytest.raises(ValueError, match=rf"column score of .*x.csv holds {wrong}; scores are above 0 and at most"):
            read_points2d(image)


def test_a_header_without_x_and_y_is_no_point(tmp_path: Path) -> None:
    """Its first two columns would be solved as if they were pixels."""
    (tmp_path / "a.csv").write_text("id,row,column\n1,10,20\n2,30,40\n")
    with pytest.raises(ValueError, match=r"a\.csv needs columns x, y, or u, v; its columns are id, row, column"):
        read_points2d(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("id,y,x,scale\n1,10,20,3\n2,30,40,5\n")
    np.testing.assert_array_equal(read_points2d(tmp_path / "a.csv")[0], [[20, 10], [40, 30]])


@pytest.mark.parametrize("text", ["label,x,y,z,size\n3,1,2,4\n", "x y z\n1 2 3 4 5 6\n"])
def test_a_first_line_that_names_another_number_of_columns_is_refused(text: str, tmp_path: Path) -> None:
    """Read without the names, the label would be x."""
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=r"a\.csv names [53] columns in its first line; its rows have [46]$"):
        read_points3d(tmp_path / "a.csv")


@pytest.mark.parametrize("header", ["x,y,z,x", "X,y,z,x", "x,y,z,label,label"])
def test_a_first_line_that_names_a_column_twice_is_refused(header: str, tmp_path: Path) -> None:
    """Otherwise the last one would be read."""
    rows = np.arange(2.0 * len(header.split(","))).reshape(2, -1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="")
    name = header.split(",")[-1]
    with pytest.raises(ValueError, match=rf"a\.csv names 2 columns {name} in its first line; keep one of them$"):
        read_points3d(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("x,y,z,note,note\n1,2,3,4,5\n")  # of columns that are not read
    np.testing.assert_array_equal(read_points3d(tmp_path / "b.csv")[0], [[1, 2, 3]])


@pytest.mark.parametrize("label", ["inf", "-1e30"])
def test_a_label_that_no_integer_holds_is_refused(label: str, tmp_path: Path) -> None:
    """As an int64 it is negative, a point of unknown label."""
    (tmp_path / "a.csv").write_text(f"x,y,z,label\n1,2,3,{label}\n")
    with pytest.raises(ValueError, match="the column label of .* holds .*; labels are integers"):
        read_points3d(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "text",
    [
        '"x","y","label"\n1.5,2.5,7\n3.5,-4.5,8\n',
        '"","x","y","label"\n"1",1.5,2.5,7\n"2",3.5,-4.5,8\n',  # R's write.csv
        '"x" "y" "label"\n"1" 1.5 2.5 7\n"2" 3.5 -4.5 8\n',  # R's write.table, whose first line has a word less
        '"";"x";"y";"label"\n"a b";1,5;2,5;7\n"c";3,5;-4,5;8\n',  # R's write.csv2
        "u;v;label\n1,5;2,5;7\n3,5;-4,5;8\n",
        "u\tv\tlabel\n1,5\t2,5\t7\n3,5\t-4,5\t8\n",
        ",x,y,label\n0,1.5,2.5,7\n1,3.5,-4.5,8\n",  # pandas
        "Name,U,V,label,note\nLED 1,1.5,2.5,7,\nLED 2,3.5,-4.5,8,weak\n",
    ],
)
def test_tables_written_by_r_and_spreadsheets_are_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    points, _, labels, _ = read_points2d(path)
    np.testing.assert_array_equal(points, [[1.5, 2.5], [3.5, -4.5]])
    np.testing.assert_array_equal(labels, [7, 8])


def test_decimal_commas_are_read_without_column_names(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("1,5;2,5;-1e-3\n3;4,25;0\n")
    np.testing.assert_array_equal(points_of(tmp_path / "a.csv"), [[1.5, 2.5, -1e-3], [3, 4.25, 0]])


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_cloud_has_normals_and_labels(encoding: str, tmp_path: Path) -> None:
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [("red", "u1"), ("label", "<i4")]
    rows = np.array([(1, 2, 3, 0, 0, 1, 9, 7), (1, 2, 3, 1, 0, 0, 9, -1), (4, 5, 6, 0, -1, 0, 9, 8)], kinds)
    names = {"<f4": "float", "u1": "uchar", "<i4": "int"}
    header = "".join(f"property {names[kind]} {name}\n" for name, kind in kinds)
    text = "\n".join(" ".join(f"{value:g}" for value in row.tolist()) for row in rows)
    path = tmp_path / "a.ply"
    head = f"ply\nformat {encoding} 1.0\nelement vertex 3\n{header}end_header\n".encode()
    path.write_bytes(head + (f"{text}\n".encode() if encoding == "ascii" else rows.tobytes()))
    points, normals, labels, _ = read_points3d(path)
    np.testing.assert_array_equal(points, [[1, 2, 3], [1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(normals, [[0, 0, 1], [1, 0, 0], [0, -1, 0]])
    np.testing.assert_array_equal(labels, [7, -1, 8])


def test_normals_that_are_all_zero_are_ignored(tmp_path: Path) -> None:
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    text = f"ply\nformat ascii 1.0\nelement vertex 2\n{header}end_header\n1 2 3 0 0 0\n4 5 6 0 0 0\n"
    (tmp_path / "a.ply").write_text(text)
    assert read_points3d(tmp_path / "a.ply")[1] is None


def test_a_pipe_is_read(tmp_path: Path) -> None:
    """A path like the shell's `<(...)`: it is no regular file, has no suffix, and can be read once."""
    array = io.BytesIO()
    np.save(array, POINTS)
    for content in (("x,y,z\n" + rows(POINTS, ",")).encode(), array.getvalue()):
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        writer = threading.Thread(target=pipe.write_bytes, args=(content,))
        writer.start()
        np.testing.assert_array_equal(points_of(pipe), POINTS)
        writer.join()
        pipe.unlink()


@pytest.mark.parametrize(
    ("stdin", "sentence"),
    [
        (None, "standard input is closed"),
        (io.TextIOWrapper(io.BytesIO(b"")), "standard input has no lines of numbers"),
    ],
    ids=["closed", "empty"],
)
def test_standard_input_without_points_is_named(
    stdin: io.TextIOWrapper | None, sentence: str, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", stdin)
    assert sentence in fails("solve", "-", "-")


def test_a_folder_in_place_of_a_file_is_named(tmp_path: Path, fails: Callable[..., str]) -> None:
    assert f"{tmp_path} is a folder; give a file" in fails("solve", str(tmp_path), str(tmp_path))


def test_standard_input_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for content, read in (
        (b"u,v\n1,2\n3,4\n", lambda: read_points2d(Path("-"))[0].tolist()),
        (b"1 2\n3 4\n", lambda: read_camera("-").tolist()),
        (b'{"rotation": [1, 2], "translation": [3, 4]}', lambda: [side.tolist() for side in read_pose(Path("-"))]),
    ):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(content)))
        assert read() == [[1, 2], [3, 4]]


def test_an_index_column_is_left_out_where_it_is_one(tmp_path: Path) -> None:
    """The first column counts the rows, and the others have too few or too many columns without it."""
    path = tmp_path / "a.txt"
    count, labels = np.arange(20), np.arange(20) % 3
    for first in (0, 1):
        path.write_text(rows(np.column_stack([count + first, POINTS]), " "))
        np.testing.assert_array_equal(points_of(path), POINTS)
        path.write_text(rows(np.column_stack([count + first, POINTS[:, :2]]), " "))
        np.testing.assert_array_equal(read_points2d(path)[0], POINTS[:, :2])
        path.write_text(rows(np.column_stack([count + first, POINTS, labels]), " "))
        points, _, found, _ = read_points3d(path)
        np.testing.assert_array_equal(points, POINTS)
        np.testing.assert_array_equal(found, labels)
    path.write_text("id x y z\n" + rows(np.column_stack([count + 5, POINTS]), " "))
    np.testing.assert_array_equal(points_of(path), POINTS)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (  # millimetres, or a row of labelled points
            read_points3d,
            "1 0 0 0\n2 30 0 0\n3 0 30 5\n4 30 30 0\n",
            "a.txt counts its rows, and may be x or an index; .* such as `x y z label` or `index x y z`",
        ),
        (
            read_points2d,
            "0 1.5 2.5 3\n1 2.5 3.5 3\n2 3.5 4.5 3\n",
            "a.txt counts its rows; remove it, or name the columns .* `index x y`",
        ),
        (
            read_points2d,
            "7 120.5 80\n12 121 90\n33 300 7\n",
            "has 3 columns, which are read as unit bearings, .* `index x y`",
        ),
        (
            read_points3d,
            "7 1.5 8 2.5\n12 1 2 3\n",
            "label of .*a.txt holds 2.5; labels are integers; if a column without a name",
        ),
        (
            read_points2d,
            "photo\n1\n1 2\n2\n3 4\n",
            "has rows of 1 and of 2 columns, such as '1' and '1 2'; .* the same, x, y$",
        ),
    ],
)
def test_columns_that_may_mean_two_things_are_named(
    read: Callable[[Path], object], text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read(path)


@pytest.mark.parametrize("name", ["a.csv", "a.npy", "a.pcd", "a.ply", "a.txt"])
def test_devices_and_arrays_that_claim_too_much_are_refused(
    name: str, tmp_path: Path, fails: Callable[..., str]
) -> None:
    (tmp_path / "p2.csv").write_text("u,v\n1,2\n3,4\n5,9\n7,3\n")
    (tmp_path / name).symlink_to("/dev/zero")
    assert f"{name} is a device; give a file" in fails("solve", str(tmp_path / "p2.csv"), str(tmp_path / name))
    (tmp_path / name).unlink()
    with (tmp_path / name).open("wb") as file:
        file.truncate(10**13)
    assert "MiB that are read of such a file" in fails("solve", str(tmp_path / "p2.csv"), str(tmp_path / name))


def test_a_pose_that_is_nested_or_has_no_fields_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    for text, message in (
        ("[" * 100_000, "nested too deeply"),
        ("[]", r"it holds \[\]"),
        ('{"rotation": []}', "'translation' is missing"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=f'pose.json is no JSON with "rotation" and "translation": .*{message}'):
            read_pose(path)
