"""Keypoints of a photo in COLMAP's database.

Source: https://colmap.github.io/database.html
"""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.maps.keypoints import Keypoints, check_inside

HEADER = b"SQLite format 3\0"
COLUMNS = (2, 4, 6)  # x, y; and scale, orientation; or and a 2x2 matrix of the local shape
QUERY = """SELECT rows, cols, data, width, height FROM images
    LEFT JOIN keypoints USING (image_id) LEFT JOIN cameras USING (camera_id) WHERE name = ?"""


def is_database(file: Path) -> bool:
    """Whether a file begins as those of SQLite do."""
    with file.open("rb") as content:
        return content.read(len(HEADER)) == HEADER


def read_database(file: Path, photo: str, size: tuple[int, int] | None = None) -> Keypoints:
    """The keypoints of the image `photo`, one for each place, the score its scale in pixels where the database has it.

    size: of the photo in pixels, to compare with that of the image's camera.
    Raises ValueError, naming file and photo, if it is not in the database, has no keypoints or such of another size, or
    if these are damaged or lie outside the photo.
    """
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as content:
            found = content.execute(QUERY, (photo,)).fetchone()
            some = content.execute("SELECT name FROM images LIMIT 5").fetchall()
    except sqlite3.Error as error:
        raise ValueError(f"expected a database of COLMAP, got {file}: {error}") from error
    if found is None or not found[0]:
        names = ", ".join(str(name) for (name,) in some)
        raise ValueError(f"expected keypoints of {photo} in {file}, got none{'' if found else f', but {names}'}")
    count, columns, data, width, height = found
    rows = _rows(count, columns, data, f"{photo} in {file}")
    own = None if width is None else (int(width), int(height))
    if own is not None and size is not None and own != size:
        raise ValueError(f"expected keypoints of {photo} at its size {size} in {file}, got them at {own}")
    pixels, first = np.unique(rows[:, :2], axis=0, return_index=True)
    check_inside(pixels, size or own, f"{photo} in {file}")
    return Keypoints(pixels, _scales(rows)[first], size or own)


def _rows(count: Any, columns: Any, data: Any, where: str) -> NDArray[np.float64]:
    """(count, columns). Raises ValueError for what is not so many finite numbers."""
    size = len(data) if isinstance(data, bytes) else 0
    if columns not in COLUMNS or not isinstance(count, int) or size != 4 * count * columns:
        expected = "rows of 2, 4 or 6 numbers of 4 bytes"
        raise ValueError(f"expected {expected} for {where}, got {count} rows of {columns} in {size} bytes")
    rows = np.frombuffer(data, "<f4").reshape(count, columns).astype(np.float64)
    if not np.isfinite(rows).all():
        raise ValueError(f"expected finite keypoints of {where}, got {(~np.isfinite(rows)).any(1).sum()} that are not")
    return rows


def _scales(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scales, the mean length of the columns of a 2x2 shape; 1 where there is none."""
    if rows.shape[1] == 6:
        return np.asarray(np.linalg.norm(rows[:, 2:].reshape(-1, 2, 2), axis=1).mean(1))
    return rows[:, 2] if rows.shape[1] == 4 else np.ones(len(rows))
