"""Photo files: discovery, camera data of EXIF, and keypoints."""

import importlib
import math
import os
import sqlite3
from collections.abc import Collection, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bpnp.arrays import Array
from bpnp.bounded_files import MOST_TEXT, check_size, open_input
from bpnp.cameras import CENTRE, outside_image, same_aspect_ratio
from bpnp.report.images import open_photo

Size = tuple[int, int]  # width and height, pixels
# Pillow may not read the last four; they are listed so that the error names the photo.
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".avif", ".dng"}
IFD_EXIF = 0x8769  # [EXIF; convention]
FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x920A, 0xA405  # [EXIF; convention]
RESOLUTION_X, RESOLUTION_UNIT = 0xA20E, 0xA210  # [EXIF; convention]
ORIENTATION = 0x0112  # [EXIF; convention]
# Direction up in the camera (x right, y down) of a photo with this orientation; the others are mirrored.
UP_OF_ORIENTATION = {1: (0.0, -1.0, 0.0), 3: (0.0, 1.0, 0.0), 6: (-1.0, 0.0, 0.0), 8: (1.0, 0.0, 0.0)}
PIXELS_X, PIXELS_Y = 0xA002, 0xA003  # [EXIF; convention]
# Equivalent focal lengths are by the diagonal (CIPA DCG-001).
DIAGONAL_35MM = 43.2666  # of a frame of 36 x 24 mm [mm; convention]
MILLIMETRES = {2: 25.4, 3: 10.0}  # per unit of the resolution, by EXIF number: inch, centimetre
SQLITE = b"SQLite format 3\0"
# x, y; and scale, orientation; or and a 2x2 matrix of the local shape. https://colmap.github.io/database.html
COLUMNS = (2, 4, 6)  # [numbers; convention]
MOST_DETECTED = 8192  # largest number of SIFT keypoints of a photo, COLMAP's [keypoints; convention]
# Contrast threshold of the keypoints, of three layers together: COLMAP's peak_threshold of 0.02 / 3, half of OpenCV's
# default.
CONTRAST_THRESHOLD = 0.02  # [intensity, 0 to 1; convention]
QUERY = """SELECT rows, cols, data, width, height FROM images
    LEFT JOIN keypoints USING (image_id) LEFT JOIN cameras USING (camera_id) WHERE name = ?"""


class Keypoints(NamedTuple):
    """Keypoints of a photo."""

    pixels: Array  # (m, 2) pixels in COLMAP's convention: (0.5, 0.5) is the centre of the first pixel
    scores: Array  # (m,) strengths
    size: Size | None  # (width, height) of the photo, pixels; None if it is unknown


def photo_files(paths: Iterable[Path], besides: Collection[Path] = ()) -> dict[str, Path]:
    """Return photo files by name: given files by file name, and files in given folders by their path in the folder.

    Folders are searched recursively, also through links, without the folders `besides`, such as that of the pictures of
    the results. Raise ValueError if a path does not exist, there is no photo, two photos have one name, or a name
    cannot begin a line of a text file of poses.
    """
    files: dict[str, Path] = {}
    left_out = {folder.resolve() for folder in besides}
    for path in paths:
        if not path.exists():
            raise ValueError(f"{path} does not exist; give a photo or a folder of photos")
        inside = (file for file in _files_in(path) if file.suffix.lower() in SUFFIXES)
        for file in (f for f in inside if left_out.isdisjoint(f.resolve().parents)) if path.is_dir() else [path]:
            name = file.relative_to(path).as_posix() if path.is_dir() else file.name
            if files.setdefault(name, file) != file:
                raise ValueError(f"{files[name]} and {file} have the same name; photos need different names")
            if name.startswith("#") or len(name.splitlines()) > 1:
                raise ValueError(f"the photo {name!r} begins with # or has a line break in its name; rename the file")
    if not files:
        outside = f" outside {' and '.join(map(str, besides))}" if besides else ""
        raise ValueError(f"there are no photos{outside}; give one or more photos, or folders with photos")
    return files


def _files_in(top: Path) -> list[Path]:
    """Return all files below a folder, sorted; a link to a folder is followed unless it leads back to itself."""
    files: list[Path] = []
    for name, children, names in os.walk(top, followlinks=True):
        folder = Path(name)
        if folder.resolve() in map(Path.resolve, folder.absolute().parents):
            children.clear()
        else:
            files += (folder / file for file in names)
    return sorted(files)


def photo_size(photo: Path) -> Size:
    """Return (width, height) of a photo, pixels; raise ValueError if it cannot be read."""
    return _read_size_and_tags(photo)[0]


def focal_from_exif(photo: Path) -> float | None:
    """Return the focal length in pixels of a photo at its stored size, from EXIF; None if EXIF has none for this size.

    The 35 mm equivalent has priority, since it is unchanged if a photo is scaled. Otherwise the focal length in
    millimetres is multiplied by the sensor resolution and scaled by the ratio of the stored size to the original size.
    A photo whose aspect ratio differs from the original was cropped at an unknown position, and the result is None.
    (pycolmap's `infer_camera_from_image` does not correct the sensor resolution of a scaled photo.) Raise ValueError if
    the photo cannot be read.
    """
    size, tags = _read_size_and_tags(photo)
    taken = int(_number_of(tags, PIXELS_X)), int(_number_of(tags, PIXELS_Y))
    if all(taken) and not same_aspect_ratio((max(taken), min(taken)), (max(size), min(size))):
        return None
    equivalent = _number_of(tags, FOCAL_LENGTH_35MM)
    if equivalent > 0:
        return float(equivalent * np.hypot(*size) / DIAGONAL_35MM)
    millimetres, resolution = _number_of(tags, FOCAL_LENGTH), _number_of(tags, RESOLUTION_X)
    unit = MILLIMETRES.get(int(_number_of(tags, RESOLUTION_UNIT, 2.0)))
    if not (millimetres > 0 and resolution > 0 and unit and all(taken)):
        return None
    return millimetres * resolution / unit * max(size) / max(taken)


def up_from_exif(photo: Path) -> tuple[float, float, float] | None:
    """Return the direction up in the camera frame of a stored photo, to a quarter turn, from the EXIF orientation.

    It is a unit vector; None if there is no orientation, or a mirrored one. Raise ValueError if the photo cannot be
    read.
    """
    return UP_OF_ORIENTATION.get(_read_size_and_tags(photo)[1].get(ORIENTATION, 0))


def _read_size_and_tags(photo: Path) -> tuple[Size, dict[int, Any]]:
    """Return the size of a photo and its EXIF tags, with the orientation."""
    with open_photo(photo) as image:
        exif = image.getexif()
        return image.size, {ORIENTATION: exif.get(ORIENTATION), **exif.get_ifd(IFD_EXIF)}


def _number_of(tags: dict[int, Any], tag: int, default: float = 0.0) -> float:
    """Return the number of an EXIF tag; the default if the tag is missing, or is not a number from 0."""
    try:
        value = float(tags.get(tag, default))
    except (TypeError, ValueError, OverflowError):
        return default
    return value if 0 <= value < math.inf else default


def photo_keypoints(photo: Path, file: str | Path | None, name: str) -> Keypoints:
    """Return the keypoints of a photo from an HDF5 file of hloc or a COLMAP database; None detects SIFT keypoints."""
    if file is None:
        return detected_keypoints(photo)
    path, size = Path(file), photo_size(photo)
    with open_input(path, pipes=False) as content:
        head = content.read(len(SQLITE))
    if not head:
        raise ValueError(f"{path} is empty; give hloc's HDF5 file of keypoints, or a database of COLMAP")
    return (read_database if head == SQLITE else read_features)(path, name, size)


def detected_keypoints(photo: Path, *, most: int = MOST_DETECTED) -> Keypoints:
    """Detect SIFT keypoints (Lowe 2004, with OpenCV), one per position; the score is the scale in pixels.

    The contrast threshold is COLMAP's. Like COLMAP, the `most` largest keypoints are kept. Large keypoints are more
    often detected from other viewpoints and triangulated. So the scale predicts better than the response if a keypoint
    has a map point.
    """
    import cv2

    as_stored = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # as COLMAP reads photos
    unreadable = f"OpenCV cannot read the photo {photo}; give a JPEG or PNG file"
    try:
        image = cv2.imread(str(photo), as_stored)
    except cv2.error as error:  # over 2^30 pixels
        raise ValueError(unreadable) from error
    if image is None:
        raise ValueError(unreadable)
    points = cv2.SIFT.create(contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True).detect(image)
    rows = np.array([(*point.pt, point.size) for point in points], np.float64).reshape(-1, 3)
    rows = rows[np.argsort(-rows[:, 2], kind="stable")[:most]]
    pixels, first = np.unique(rows[:, :2], axis=0, return_index=True)
    if not len(pixels):
        raise ValueError(f"no keypoints were found in {photo}")
    return Keypoints(pixels + CENTRE, rows[first, 2], (image.shape[1], image.shape[0]))


def read_features(file: Path, photo: str, size: Size | None = None) -> Keypoints:
    """Read the keypoints of a photo from an HDF5 file of hloc: `<photo>/keypoints` (m, 2) and optional `scores` (m,).

    `size` of the photo, for a check, is by default `<photo>/image_size`, if the file has it. Raise ValueError, which
    names file and photo, if the photo is not in the file or has another size, or keypoints lie outside it
    (`outside_image`).
    """
    try:
        h5py = importlib.import_module("h5py")  # optional
    except ImportError as error:
        raise ValueError("HDF5 files need the package h5py; install it with `pip install h5py`") from error
    try:
        with h5py.File(file, "r") as content:
            if f"{photo}/keypoints" not in content:
                some = ", ".join(list(content)[:5])
                raise ValueError(f"{file} has no keypoints of {photo}, but of {some or 'no photo'}")
            group = content[photo]
            for part in set(group) & {"keypoints", "scores"}:
                check_size(f"{photo}/{part} in {file}", group[part].shape, group[part].dtype, MOST_TEXT)
            pixels = np.asarray(group["keypoints"], np.float64)
            scores = np.asarray(group["scores"], np.float64) if "scores" in group else np.ones(len(pixels))
            stored = tuple(int(value) for value in group["image_size"]) if "image_size" in group else None
    except OSError as error:
        raise ValueError(f"{file} is neither an HDF5 file of keypoints nor a database of COLMAP: {error}") from error
    if pixels.ndim != 2 or pixels.shape[1] != 2 or scores.shape != (len(pixels),):
        raise ValueError(
            f"{photo} in {file} has keypoints {pixels.shape} and scores {scores.shape}, not (m, 2) and (m,)"
        )
    return _check_keypoints(Keypoints(pixels + CENTRE, scores, stored), size, f"{photo} in {file}")  # type: ignore[arg-type]


def read_database(file: Path, photo: str, size: Size | None = None) -> Keypoints:
    """Read the keypoints of a photo from a COLMAP database, one per position; the score is the scale, if stored.

    The database is opened read-only; `pycolmap.Database` writes to every file that it opens. Raise ValueError, which
    names file and photo, if the photo is not in the database, has no keypoints or another size than `size` (None for no
    check), or its keypoints are damaged or outside it.
    """
    try:
        logged = file.with_name(f"{file.name}-wal").exists()
        mode = "mode=ro" if logged else "immutable=1"  # creates no journal file
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?{mode}", uri=True)) as content:
            row = content.execute(QUERY, (photo,)).fetchone()
            names = ", ".join(str(name) for (name,) in content.execute("SELECT name FROM images LIMIT 5"))
    except sqlite3.Error as error:
        raise ValueError(f"{file} is no database of COLMAP: {error}") from error
    if row is None or not row[0]:
        others = "" if row else f", but of {names}" if names else ": it has no images"
        raise ValueError(f"{file} has no keypoints of {photo}{others}")
    count, columns, data, *stored = row
    length, where = len(data) if isinstance(data, bytes) else 0, f"{photo} in {file}"
    if columns not in COLUMNS or not isinstance(count, int) or length != 4 * count * columns:
        stated = f"{count} rows of {columns} numbers in {length} bytes"
        raise ValueError(f"the keypoints of {where} are damaged: {stated}; they are rows of 2, 4 or 6, of 4 bytes each")
    rows = np.frombuffer(data, "<f4").reshape(count, columns).astype(np.float64)
    if not np.isfinite(rows).all():
        raise ValueError(f"{(~np.isfinite(rows)).any(1).sum()} keypoints of {where} are NaN or infinite")
    scores = rows[:, 2] if columns == 4 else np.ones(count)
    if columns == 6:  # the mean length of the columns of the shape
        scores = np.linalg.norm(rows[:, 2:].reshape(-1, 2, 2), axis=1).mean(1)
    pixels, first = np.unique(rows[:, :2], axis=0, return_index=True)
    image_size = None if None in stored else (int(stored[0]), int(stored[1]))
    return _check_keypoints(Keypoints(pixels, scores[first], image_size), size, where)


def _check_keypoints(keypoints: Keypoints, size: Size | None, where: str) -> Keypoints:
    """Return keypoints with the size of their photo; raise ValueError if sizes differ or keypoints lie outside it."""
    if None not in (keypoints.size, size) and keypoints.size != size:
        raise ValueError(
            f"the keypoints of {where} are those of a photo of size {keypoints.size}, but the photo has {size}"
        )
    full_size = size or keypoints.size
    if full_size is not None and (outside := outside_image(keypoints.pixels, full_size)).any():
        raise ValueError(
            f"{int(outside.sum())} keypoints are outside the {full_size[0]} x {full_size[1]} pixels of {where}, such "
            "as "
            f"{keypoints.pixels[outside][0].round(1).tolist()}; give features of a photo of this size"
        )
    return keypoints._replace(size=full_size)
