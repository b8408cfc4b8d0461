"""COLMAP models in a folder, and the three files of one, binary or text, as plain numpy arrays.

pycolmap reads text files and rewrites them as binary ones. It does not read binary files here, because pycolmap 4.2
takes a truncated `cameras.bin` for a complete one (the parameters are then whatever was in memory), fills the memory on
a truncated `points3D.bin` and never returns from a truncated `frames.bin`. This reader checks every size against the
file before it reads. Poses are those of `images`, which COLMAP writes composed with the rig, so `rigs` and `frames` are
not needed.

Source: https://colmap.github.io/format.html
"""

import itertools
import mmap
import os
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import camera_models, read_text_model

FILES = {"cameras": 1, "images": 2, "points3D": 1}  # lines of a record in a text file
TRACK_ELEMENT = 8
KEYPOINT = np.dtype([("position", "<f8", 2), ("point_id", "<i8")])  # no point: 2^64 - 1 in the file, read as -1
POINT = np.dtype([("point_id", "<i8"), ("position", "<f8", 3)])
COLOUR_AND_ERROR = 3 + 8  # bytes between a POINT and the length of its track, which has 8 bytes an element
# Folders between a scene and its models: <scene>/sparse/0, <scene>/sparse/manhattan/0 (MegaDepth),
# <scene>/dense/0/sparse.
LAYOUT = re.compile(r"sparse|dense\d*")
INSIDE_LAYOUT = re.compile(r"sparse|dense\d*|manhattan|\d+")


class ColmapError(ValueError):
    """COLMAP folder or file that cannot be used. The message names it."""


class CameraRecord(NamedTuple):
    model: str
    params: NDArray[np.float64]  # parameters in COLMAP's order
    size: tuple[int, int]  # width and height of the image, pixels


@dataclass(frozen=True)
class ImageRecord:
    """Record of an image; the pose is cam_from_world."""

    name: str
    image_id: int
    camera_id: int
    quaternion: NDArray[np.float64]  # (w, x, y, z)
    translation: NDArray[np.float64]  # t (3,)
    keypoints: NDArray[np.float64]  # (k, 2), pixels
    point_ids: NDArray[np.int64]  # id of the 3D point of each keypoint (k,), -1 for none


@dataclass(frozen=True)
class ModelRecords:
    """Content of the three files."""

    cameras: dict[int, CameraRecord]
    images: list[ImageRecord]
    point_ids: NDArray[np.int64]  # ids of the points (n,)
    points3d: NDArray[np.float64]  # points (n, 3)


def model_format(folder: Path) -> str | None:
    """Return the suffix, "bin" or "txt", of the complete model in a folder ("bin" if there are both), or None."""
    whole = (suffix for suffix in ("bin", "txt") if all((folder / f"{name}.{suffix}").is_file() for name in FILES))
    return next(whole, None)


def read_records(folder: Path) -> ModelRecords:
    """Read the model in a folder.

    Raise ColmapError, which names the file, and the byte or line, if a file is missing, empty, truncated or too long,
    holds no record, or is not a COLMAP file.
    """
    suffix = model_format(folder)
    if suffix is None:
        files = ", ".join(sorted(path.name for path in folder.glob("*"))[:8])
        raise ColmapError(
            f"{folder} is no COLMAP model (cameras, images and points3D, all .bin or all .txt); it holds "
            f"{files or 'no files'}. Give a folder such as sparse/0 of a scene"
        )
    paths = [folder / f"{name}.{suffix}" for name in FILES]
    contents = [_content(path) for path in paths]
    with TemporaryDirectory() as rewritten:
        if suffix == "txt":
            _rewrite_text(paths, [content[:] for content in contents], rewritten)
            contents = [_content(Path(rewritten) / f"{name}.bin") for name in FILES]
        cursors = [_Cursor(path, content) for path, content in zip(paths, contents, strict=True)]
        cameras, images, points = dict(_cameras(cursors[0])), list(_images(cursors[1])), _points(cursors[2])
    for path, count in zip(paths, (len(cameras), len(images), len(points)), strict=True):
        if not count:
            raise ColmapError(f"{path} has no records; a COLMAP model needs cameras, images and points")
    return ModelRecords(cameras, images, points["point_id"].copy(), points["position"].copy())


def _content(path: Path) -> mmap.mmap:
    """Map the bytes of a file, to read only the used ones: most of images.bin are keypoints without a point."""
    try:
        with path.open("rb") as file:
            if path.stat().st_size:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise ColmapError(f"cannot read a COLMAP file: {error}") from error
    raise ColmapError(f"{path} is empty; copy the model again")


def _rewrite_text(paths: list[Path], contents: list[bytes], target: str) -> None:
    """Write the model of three text files as binary files into a folder.

    Truncations that pycolmap does not notice are found here: between two records, or in the last number. The count in
    COLMAP's header, where there is one, and the line break at the end show them. Without a line break at the end, the
    header has to have the count, and the last track of a point and the keypoint that it names have to agree.
    """
    without_break = [path for path, content in zip(paths, contents, strict=True) if not content.endswith(b"\n")]
    for path, content in zip(paths, contents, strict=True):
        header = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
        records = sum(not line.startswith(b"#") for line in content.splitlines()) // FILES[path.stem]
        if path in without_break and (not header or int(header[1]) != records):
            raise _truncation_error(path, content)
        if header and int(header[1]) > records:
            raise ColmapError(
                f"{path} is truncated: it has {records} of the {int(header[1])} records in its header; copy the model "
                "again, or correct the header if records were removed on purpose"
            )
    try:
        model = read_text_model(paths[0].parent)
        names = dict(_names(contents[1]))
        for image_id, name in names.items():
            model.image(image_id).name = name
        for path in without_break:
            content = contents[paths.index(path)]
            if not _last_record_agrees(model, path.stem, list(names), content.splitlines()[-1].split()):
                raise _truncation_error(path, content)
        model.write_binary(target)
    except ValueError as error:
        if isinstance(error, ColmapError):
            raise
        files = f"{paths[0]}, {paths[1].name} and {paths[2].name}"
        raise ColmapError(f"pycolmap cannot read the model in {files}: {error}") from error


def _truncation_error(path: Path, content: bytes) -> "ColmapError":
    return ColmapError(
        f"{path} ends without a line break, at {content[-20:]!r}, and looks truncated; copy the model again, or add "
        "the line break if the file is whole"
    )


def _names(images: bytes) -> Iterator[tuple[int, str]]:
    """Yield the id and the name of each image of a text file, in its order."""
    lines = (line for line in images.splitlines() if not line.startswith(b"#"))
    for line in filter(bytes.strip, lines):
        image_id, *_, name = line.split(maxsplit=9)
        yield int(image_id), name.rstrip().decode(errors="backslashreplace")
        next(lines, None)  # its keypoints


def _last_record_agrees(model: Any, file: str, image_ids: list[int], fields: list[bytes]) -> bool:
    """Return True if the last line of a text file, split into fields, is complete.

    The keypoints of the last image and the tracks of the points have to name each other. Missing keypoints without a
    point at the end, and missing digits in the last parameter of a camera, cannot be noticed.
    """
    if file == "images":
        if len(fields) % 3 or not re.fullmatch(rb"-1|\d+", fields[-1]):
            return False
        tracks = (point.track.elements for point in model.points3D.values())
        named = {one.point2D_idx for track in tracks for one in track if one.image_id == image_ids[-1]}
        keypoints = model.image(image_ids[-1]).points2D
        return named == {k for k in range(len(keypoints)) if keypoints[k].has_point3D()}
    if file == "points3D":
        number, image_id, index = int(fields[0]), int(fields[-2]), int(fields[-1])
        keypoints = model.image(image_id).points2D if image_id in image_ids else []
        return index < len(keypoints) and keypoints[index].point3D_id == number
    return True


class _Cursor:
    """Reader of a binary file that never reads past its end."""

    def __init__(self, path: Path, content: mmap.mmap) -> None:
        self.path, self.content, self.offset = path, content, 0

    def skip(self, size: int) -> int:
        """Skip `size` bytes and return where they begin."""
        start, self.offset = self.offset, self.offset + size
        if self.offset > len(self.content):
            raise ColmapError(
                f"{self.path} is truncated or not a COLMAP file: {size} bytes are needed at byte {start}, but "
                f"{len(self.content) - start} are left; copy the model again"
            )
        return start

    def take(self, layout: struct.Struct) -> tuple:
        """Read one struct."""
        return layout.unpack_from(self.content, self.skip(layout.size))

    def array(self, dtype: np.dtype, count: int) -> NDArray:
        """Return a view of the next `count` items."""
        return np.frombuffer(self.content, dtype, count, self.skip(dtype.itemsize * count))

    def string(self) -> str:
        """Read a string that ends with a zero byte."""
        end = self.content.find(b"\0", self.offset)
        start = self.skip((end if end >= 0 else len(self.content)) - self.offset + 1)
        return self.content[start:end].decode(errors="backslashreplace")

    def records(self) -> Iterator[int]:
        """Yield the number of each record of the file, which has to end after the last."""
        yield from range(self.take(_COUNT)[0])
        if self.offset != len(self.content):
            raise ColmapError(
                f"{self.path} should end at byte {self.offset}, but has {len(self.content)} bytes: it is not a COLMAP "
                "file, or of an unknown version; convert it with `colmap model_converter`"
            )


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<Ii2Q")
_IMAGE = struct.Struct("<I7dI")


def _cameras(cursor: _Cursor) -> Iterator[tuple[int, CameraRecord]]:
    models = camera_models()
    for _ in cursor.records():
        camera_id, model_id, width, height = cursor.take(_CAMERA)
        if model_id not in models:
            raise ColmapError(
                f"{cursor.path} has a camera of the unknown model {model_id}: it is not a COLMAP file, or newer than "
                f"this pycolmap, whose models are {', '.join(name for name, _ in models.values())}"
            )
        name, count = models[model_id]
        yield camera_id, CameraRecord(name, cursor.array(np.dtype("<f8"), count), (width, height))


def _images(cursor: _Cursor) -> Iterator[ImageRecord]:
    for _ in cursor.records():
        image_id, *numbers, camera_id = cursor.take(_IMAGE)
        name, pose = cursor.string(), np.array(numbers)
        keypoints = cursor.array(KEYPOINT, cursor.take(_COUNT)[0])
        yield ImageRecord(name, image_id, camera_id, pose[:4], pose[4:], keypoints["position"], keypoints["point_id"])


def _points(cursor: _Cursor) -> NDArray[Any]:
    points = bytearray()
    for _ in cursor.records():
        start = cursor.skip(POINT.itemsize + COLOUR_AND_ERROR)
        points += cursor.content[start : start + POINT.itemsize]
        (track_length,) = cursor.take(_COUNT)
        cursor.skip(TRACK_ELEMENT * track_length)
    return np.frombuffer(bytes(points), POINT)


def find_scenes(roots: str | Path | Sequence[str | Path]) -> dict[str, dict[str, Path]]:
    """Return every COLMAP model at or below some folders as {scene: {name of the model: folder}}, sorted.

    A scene is named by its path below the root, up to `sparse` or `dense`. All models below it (`sparse/0`, `sparse/1`,
    `sparse/manhattan/0`) belong to it. The only model of a scene has the scene's name; of several, each has its path
    added. A folder that lacks one of the three files is skipped with a warning if there are complete ones. Raise
    ColmapError if a root is not a folder, holds no model, two scenes have one name, or a model is in two scenes.
    """
    scenes: dict[str, dict[str, Path]] = {}
    homes: dict[str, Path] = {}
    scene_of: dict[Path, str] = {}
    for root in [roots] if isinstance(roots, (str, Path)) else roots:
        top = Path(root).absolute()
        for folder in _find_models(top):
            home = _scene_folder(top, folder)
            scene = home.relative_to(top).as_posix() if top in home.parents else home.name
            if homes.setdefault(scene, home) != home:
                raise ColmapError(
                    f"{homes[scene]} and {home} are both named {scene!r}; give their common parent folder as `root`"
                )
            if (other := scene_of.setdefault(folder.resolve(), scene)) != scene:
                raise ColmapError(
                    f"{folder} is in two folders of `root`, and would be in the scenes {other!r} and {scene!r}; give "
                    "only one of them"
                )
            scenes.setdefault(scene, {})["/".join((scene, *folder.relative_to(home).parts))] = folder
    return {
        scene: {scene: next(iter(models.values()))} if len(models) == 1 else dict(sorted(models.items()))
        for scene, models in sorted(scenes.items())
    }


def _find_models(top: Path) -> list[Path]:
    if not top.is_dir():
        raise ColmapError(f"{top} is no folder; give a folder of COLMAP models as `root`")
    whole, incomplete, visited = [], [], set[Path]()
    for name, children, files in os.walk(top, followlinks=True):
        folder = Path(name)
        children.sort()
        if folder.resolve() in visited:  # reached again through a link
            children.clear()
            continue
        visited.add(folder.resolve())
        if model_format(folder):
            whole.append(folder)
        elif max(sum(f"{part}.{suffix}" in files for part in FILES) for suffix in ("bin", "txt")) > 1:
            incomplete.append(folder)
    if incomplete:
        message = (
            f"{len(incomplete)} folders lack cameras, images or points3D of a COLMAP model "
            f"({', '.join(map(str, incomplete[:4]))}); copy them again"
        )
        if not whole:
            raise ColmapError(message)
        warnings.warn(f"skipped: {message}", stacklevel=4)
    if not whole:
        raise ColmapError(
            f"{top} has no COLMAP models; give a folder that holds <scene>/sparse/0/cameras.bin (or .txt), images and "
            "points3D"
        )
    return whole


def _scene_folder(top: Path, folder: Path) -> Path:
    """Return the folder that holds the first `sparse` or `dense` of a path to a model, else the model's folder itself.

    The search starts below the root, or above it if the root is inside a scene, such as `castle/sparse`.
    """
    start = len(top.parts)
    if all(INSIDE_LAYOUT.fullmatch(part) for part in folder.relative_to(top).parts):
        start -= len(list(itertools.takewhile(INSIDE_LAYOUT.fullmatch, reversed(top.parts))))
    for depth in range(max(start, 1), len(folder.parts)):
        if LAYOUT.fullmatch(folder.parts[depth]):
            return Path(*folder.parts[:depth])
    return folder
