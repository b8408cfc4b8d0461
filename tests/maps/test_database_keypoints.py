"""Keypoints come out of a database as COLMAP itself wrote them; damaged, unknown and other photos are refused."""

import sqlite3
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from bpnp.maps.photos import photo_keypoints, read_database

ROWS = np.array([[0.5, 0.5, 2.0, 0.1], [99.25, 49.75, 4.0, 0.2], [0.5, 0.5, 2.0, 1.7]], np.float32)


def write_database(path: Path, keypoints: dict[str, np.ndarray]) -> Path:
    """By COLMAP's own library: photos of 100 x 50 pixels."""
    with pycolmap.Database.open(path) as content:
        camera = content.write_camera(
            pycolmap.Camera(camera_id=0, model="PINHOLE", width=100, height=50, params=[80.0, 80, 50, 25])
        )
        for name, rows in keypoints.items():
            content.write_keypoints(content.write_image(pycolmap.Image(name=name, camera_id=camera)), rows)
    return path


def photo_of(folder: Path) -> Path:
    Image.new("L", (100, 50)).save(folder / "photo.png")
    return folder / "photo.png"


@pytest.fixture
def database(tmp_path: Path) -> Path:
    shapes = np.column_stack([ROWS[:2, :2], [[0, -3, 3, 0], [2, 0, 0, 4]]]).astype(np.float32)
    return write_database(
        tmp_path / "database.db",
        {"a.jpg": ROWS, "b.jpg": ROWS[:, :2], "c.jpg": shapes, "out.jpg": ROWS + 60, "none.jpg": ROWS[:0]},
    )


def test_keypoints_of_a_database_are_one_per_position_with_their_scale(database: Path) -> None:
    found = read_database(database, "a.jpg", (100, 50))
    np.testing.assert_array_equal(found.pixels, [[0.5, 0.5], [99.25, 49.75]])
    np.testing.assert_array_equal(found.scores, [2, 4])
    assert found.size == (100, 50)
    np.testing.assert_array_equal(read_database(database, "b.jpg").scores, [1, 1])
    np.testing.assert_array_equal(read_database(database, "c.jpg").scores, [3, 3])  # a turn by 90 deg times 3; 2 and 4


def test_an_unusable_database_is_one_clear_error(database: Path, tmp_path: Path) -> None:
    for photo, size, message in (
        ("d.jpg", None, r"database\.db has no keypoints of d\.jpg, but of a\.jpg, b\.jpg"),
        ("none.jpg", None, r"has no keypoints of none\.jpg$"),
        (
            "a.jpg",
            (200, 100),
            r"a\.jpg in .*database\.db are those of a photo of size \(100, 50\), but the photo has \(200, 100\)",
        ),
        ("out.jpg", None, r"2 keypoints are outside the 100 x 50 pixels of out\.jpg"),
    ):
        with pytest.raises(ValueError, match=message):
            read_database(database, photo, size)
    other = tmp_path / "other.db"
    other.write_bytes(b"something else, longer than the header of a database")
    with pytest.raises(ValueError, match=r"other\.db is no database of COLMAP: file is not a database"):
        read_database(other, "a.jpg")
    (tmp_path / "cut.db").write_bytes(database.read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"cut\.db is no database of COLMAP"):
        read_database(tmp_path / "cut.db", "a.jpg")
    (tmp_path / "nothing.db").touch()
    with pytest.raises(ValueError, match=r"nothing\.db is empty; give hloc's HDF5 file"):
        photo_keypoints(photo_of(tmp_path), tmp_path / "nothing.db", "a.jpg")
    assert (tmp_path / "nothing.db").stat().st_size == 0  # pycolmap would make a database of it
    write_database(tmp_path / "no images.db", {})
    with pytest.raises(ValueError, match=r"no images\.db has no keypoints of a\.jpg: it has no images"):
        photo_keypoints(photo_of(tmp_path), tmp_path / "no images.db", "a.jpg")
    with sqlite3.connect(tmp_path / "empty.db") as content:
        content.execute("CREATE TABLE other (number INTEGER)")
    with pytest.raises(ValueError, match="no such table: images"):
        read_database(tmp_path / "empty.db", "a.jpg")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("rows = 4", "4 rows of 4 numbers in 48 bytes"),
        ("rows = -3", "-3 rows of 4 numbers in 48 bytes"),
        ("cols = 3", "3 rows of 3 numbers in 48 bytes"),
        ("data = NULL", "3 rows of 4 numbers in 0 bytes"),
        ("data = 'text'", "3 rows of 4 numbers in 0 bytes"),
        ("rows = 'x'", "x rows of 4 numbers in 48 bytes"),
        ("data = x'0000c07f00000000', cols = 2, rows = 1", "1 keypoints of .* are NaN or infinite"),
    ],
)
def test_damaged_rows_are_refused(database: Path, change: str, message: str) -> None:
    with sqlite3.connect(database) as content:
        content.execute(f"UPDATE keypoints SET {change} WHERE image_id = 1")
    with pytest.raises(ValueError, match=message) as error:
        read_database(database, "a.jpg")
    assert f"a.jpg in {database}" in str(error.value)
