"""The three files of a COLMAP model, binary or text, as plain numpy arrays.

Read here and not by pycolmap, because pycolmap 4.2 takes a truncated `cameras.bin` for a whole one (the parameters are
then whatever was in memory), fills the memory on a truncated `points3D.bin` and never returns from a truncated
`frames.bin`. Every size is checked against the file before anything is read. Poses are those of `images`, which
COLMAP writes composed with the rig, so `rigs` and `frames` are not needed.

Source: https://colmap.github.io/format.html
"""

import operator
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FILES = ("cameras", "images", "points3D")
KEYPOINT = np.dtype([("position", "<f8", 2), ("point_id", "<i8")])  # no point: 2^64 - 1 in the file, so -1 here


class ColmapError(ValueError):
    """A COLMAP folder or file that cannot be used; the message names it."""


@dataclass(frozen=True)
class CameraRecord:
    model: str
    params: NDArray[np.float64]


@dataclass(frozen=True)
class ImageRecord:
    """quaternion (w, x, y, z) and translation are cam_from_world; keypoints (k, 2) pixels; point_ids (k,), -1: none."""

    name: str
    image_id: int
    camera_id: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    point_ids: NDArray[np.int64]


@dataclass(frozen=True)
class ModelRecords:
    """What the three files hold. points3d (n, 3) has the ids `point_ids` (n,)."""

    cameras: dict[int, CameraRecord]
    images: list[ImageRecord]
    point_ids: NDArray[np.int64]
    points3d: NDArray[np.float64]


def model_format(folder: Path) -> str | None:
    """The suffix, "bin" or "txt", of the whole model in a folder, "bin" if there are two; None if there is no model."""
    whole = (suffix for suffix in ("bin", "txt") if all((folder / f"{name}.{suffix}").is_file() for name in FILES))
    return next(whole, None)


def read_records(folder: Path, *, camera_models: Mapping[int, tuple[str, int]]) -> ModelRecords:
    """Read the model in `folder`. `camera_models`: name and number of parameters of each COLMAP camera model id.

    Raises ColmapError, naming the file and the byte or line, if a file is missing, empty, truncated or too long, holds
    no record, or is not a COLMAP file.
    """
    suffix = model_format(folder)
    if suffix is None:
        found = ", ".join(sorted(path.name for path in folder.glob("*"))[:8])
        raise ColmapError(
            f"expected a COLMAP model (cameras, images and points3D, all .bin or all .txt) in {folder}, got "
            f"{found or 'no file'}; try the folder sparse/0 of a scene"
        )
    paths = [folder / f"{name}.{suffix}" for name in FILES]
    contents = [_content(path) for path in paths]
    if suffix == "bin":
        cameras = dict(_binary_cameras(_Cursor(paths[0], contents[0]), camera_models))
        images = list(_binary_images(_Cursor(paths[1], contents[1])))
        points = list(_binary_points(_Cursor(paths[2], contents[2])))
    else:
        names = dict(camera_models.values())
        cameras = dict(_records(paths[0], contents[0], lambda line, _: _text_camera(line, names)))
        images = list(_records(paths[1], contents[1], _text_image))
        points = list(_records(paths[2], contents[2], _text_point))
    for path, records in zip(paths, (cameras, images, points), strict=True):
        if not records:
            raise ColmapError(f"expected cameras, images and points in a COLMAP model, got none in {path}; try another")
    return ModelRecords(
        cameras=cameras,
        images=images,
        point_ids=np.array([p[0] for p in points], dtype=np.int64),
        points3d=np.array([p[1:] for p in points], dtype=np.float64).reshape(-1, 3),
    )


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ColmapError(f"expected a readable COLMAP file, got {error}; try its permissions") from error
    if not content:
        raise ColmapError(f"expected a COLMAP file, got {path} of 0 bytes; try copying the model again")
    return content


class _Cursor:
    """Walks a binary file; no read goes past its end."""

    def __init__(self, path: Path, content: bytes) -> None:
        self.path, self.content, self.offset = path, content, 0

    def skip(self, size: int) -> int:
        """Where the next `size` bytes begin."""
        start, self.offset = self.offset, self.offset + size
        if self.offset > len(self.content):
            raise ColmapError(
                f"expected {size} more bytes at byte {start} of {self.path}, got {len(self.content) - start}: it is "
                "truncated or not a COLMAP file; try copying the model again"
            )
        return start

    def take(self, layout: struct.Struct) -> tuple:
        return layout.unpack_from(self.content, self.skip(layout.size))

    def array(self, dtype: np.dtype, count: int) -> NDArray:
        return np.frombuffer(self.content, dtype, count, self.skip(dtype.itemsize * count))

    def string(self) -> str:
        end = self.content.find(b"\0", self.offset)
        start = self.skip((end if end >= 0 else len(self.content)) - self.offset + 1)
        return self.content[start:end].decode(errors="backslashreplace")

    def records(self) -> range:
        return range(self.take(_COUNT)[0])

    def finish(self) -> None:
        if self.offset != len(self.content):
            raise ColmapError(
                f"expected {self.path} to end at byte {self.offset}, got {len(self.content)} bytes: it is not a COLMAP "
                "file or of an unknown version; try `colmap model_converter`"
            )


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<Ii2Q")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<q3d3BdQ")


def _binary_cameras(cursor: _Cursor, models: Mapping[int, tuple[str, int]]) -> Iterator[tuple[int, CameraRecord]]:
    for _ in cursor.records():
        camera_id, model_id, _, _ = cursor.take(_CAMERA)
        if model_id not in models:
            raise ColmapError(
                f"expected a camera model among {', '.join(name for name, _ in models.values())}, got id {model_id} in "
                f"{cursor.path}: it is not a COLMAP file, or newer than this pycolmap"
            )
        name, count = models[model_id]
        yield camera_id, CameraRecord(name, cursor.array(np.dtype("<f8"), count))
    cursor.finish()


def _binary_images(cursor: _Cursor) -> Iterator[ImageRecord]:
    for _ in cursor.records():
        image_id, *pose, camera_id = cursor.take(_IMAGE)
        name = cursor.string()
        keypoints = cursor.array(KEYPOINT, cursor.take(_COUNT)[0])
        quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
        yield ImageRecord(
            name, image_id, camera_id, quaternion, translation, keypoints["position"], keypoints["point_id"]
        )
    cursor.finish()


def _binary_points(cursor: _Cursor) -> Iterator[tuple[int, float, float, float]]:
    for _ in cursor.records():
        point_id, x, y, z, _, _, _, _, track_length = cursor.take(_POINT)
        cursor.skip(8 * track_length)
        yield point_id, x, y, z
    cursor.finish()


def _records(path: Path, content: bytes, parse: Callable[[bytes, Iterator[bytes]], Any]) -> Iterator[Any]:
    """Every record of a text file. `parse` gets its first line, and the lines after it to draw from.

    Comments and blank lines between records are skipped. The count in COLMAP's header, where there is one, and the
    line break at the end are what shows that a text file was cut.
    """
    if not content.endswith(b"\n"):
        raise ColmapError(
            f"expected {path} to end with a line break, got {content[-20:]!r}: it looks truncated; try copying the "
            "model again, or add the line break if it is whole"
        )
    lines = content.splitlines()
    rest = iter(lines)
    found = 0
    for line in rest:
        if line.startswith(b"#") or not line.strip():
            continue
        try:
            record = parse(line, rest)
        except (ValueError, OverflowError, StopIteration) as error:
            number = len(lines) - operator.length_hint(rest)
            raise ColmapError(
                f"expected a COLMAP record, got {line[:40]!r} at line {number} of {path} ({error or 'cut short'}); "
                "try copying the model again"
            ) from error
        found += 1
        yield record
    header = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
    if header and int(header[1]) > found:
        raise ColmapError(
            f"expected {int(header[1])} records in {path} as its header says, got {found}: it is truncated; try "
            "copying the model again, or correct the header if records were removed on purpose"
        )


def _text_camera(line: bytes, models: Mapping[str, int]) -> tuple[int, CameraRecord]:
    camera_id, name, _, _, *params = line.split()
    model = name.decode(errors="backslashreplace")
    if len(params) != models.get(model):
        raise ValueError(f"{len(params)} parameters, camera model {model} has {models.get(model, 'never been known')}")
    return int(camera_id), CameraRecord(model, np.array(params, dtype=np.float64))


def _text_image(line: bytes, rest: Iterator[bytes]) -> ImageRecord:
    image_id, *numbers, camera_id, name = line.split(maxsplit=9)  # a name may have spaces
    pose = np.array(numbers, dtype=np.float64)
    fields = next(rest).split()
    keypoints = np.array(fields, dtype=np.float64).reshape(-1, 3)[:, :2]
    point_ids = np.array(fields[2::3], dtype=np.int64)
    shown = name.rstrip().decode(errors="backslashreplace")
    return ImageRecord(shown, int(image_id), int(camera_id), pose[:4], pose[4:], keypoints, point_ids)


def _text_point(line: bytes, rest: Iterator[bytes]) -> tuple[int, float, float, float]:
    del rest
    point_id, x, y, z, _, _, _, _, *track = line.split()
    if len(track) % 2:
        raise ValueError(f"a track of {len(track)} numbers, should be pairs")
    return int(np.int64(int(point_id))), float(x), float(y), float(z)
