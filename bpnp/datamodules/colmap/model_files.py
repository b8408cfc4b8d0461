"""COLMAP models below a folder, and the three files of one, binary or text, as plain numpy arrays.

pycolmap rewrites text files as binary ones. It does not read binary ones, because pycolmap 4.2 takes a truncated
`cameras.bin` for a whole one (the parameters are then whatever was in memory), fills the memory on a truncated
`points3D.bin` and never returns from a truncated `frames.bin`: here every size is checked against the file before
anything is read. Poses are those of `images`, which COLMAP writes composed with the rig, so `rigs` and `frames` are not
needed.

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
KEYPOINT = np.dtype([("position", "<f8", 2), ("point_id", "<i8")])  # no point: 2^64 - 1 in the file, so -1 here
POINT = np.dtype([("point_id", "<i8"), ("position", "<f8", 3)])
COLOUR_AND_ERROR = 3 + 8  # bytes after these, before the length of a point's track; it follows, 8 bytes an element
# What lies between the folder of a scene and its models: <scene>/sparse/0, <scene>/sparse/manhattan/0 (MegaDepth),
# <scene>/dense/0/sparse.
LAYOUT = re.compile(r"sparse|dense\d*")
INSIDE_LAYOUT = re.compile(r"sparse|dense\d*|manhattan|\d+")


class ColmapError(ValueError):
    """A COLMAP folder or file that cannot be used; the message names it."""


class CameraRecord(NamedTuple):
    model: str
    params: NDArray[np.float64]
    size: tuple[int, int]  # width and height of the image, pixels


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
    """What the three files hold. points3d (n, 3) has the ids `point_ids`."""

    cameras: dict[int, CameraRecord]
    images: list[ImageRecord]
    point_ids: NDArray[np.int64]
    points3d: NDArray[np.float64]


def model_format(folder: Path) -> str | None:
    """The suffix, "bin" or "txt", of the whole model in a folder, "bin" if there are two; None if there is no model."""
    whole = (suffix for suffix in ("bin", "txt") if all((folder / f"{name}.{suffix}").is_file() for name in FILES))
    return next(whole, None)


def read_records(folder: Path) -> ModelRecords:
    """Read the model in `folder`.

    Raises ColmapError, naming the file and the byte or line, if a file is missing, empty, truncated or too long, holds
    no record, or is not a COLMAP file.
    """
    suffix = model_format(folder)
    if suffix is None:
        files = ", ".join(sorted(path.name for path in folder.glob("*"))[:8])
        raise ColmapError(
            f"expected a COLMAP model (cameras, images and points3D, all .bin or all .txt) in {folder}, got "
            f"{files or 'no file'}; try the folder sparse/0 of a scene"
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
            raise ColmapError(f"expected cameras, images and points in a COLMAP model, got none in {path}; try another")
    return ModelRecords(cameras, images, points["point_id"].copy(), points["position"].copy())


def _content(path: Path) -> mmap.mmap:
    """The bytes of a file, read as they are used: most of images.bin are keypoints without a point."""
    try:
        with path.open("rb") as file:
            if path.stat().st_size:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise ColmapError(f"expected a readable COLMAP file, got {error}; try its permissions") from error
    raise ColmapError(f"expected a COLMAP file, got {path} of 0 bytes; try copying the model again")


def _rewrite_text(paths: list[Path], contents: list[bytes], target: str) -> None:
    """Write the model of three text files as binary files into a folder.

    Notices what pycolmap does not: that a file was cut between two records, or in the last number. The count in
    COLMAP's header, where there is one, and the line break at the end show it. Where the line break lacks, the header
    has to have the count, and the last track of a point has to agree with the keypoint that it names, and the reverse.
    """
    unended = [path for path, content in zip(paths, contents, strict=True) if not content.endswith(b"\n")]
    for path, content in zip(paths, contents, strict=True):
        header = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
        records = sum(not line.startswith(b"#") for line in content.splitlines()) // FILES[path.stem]
        if path in unended and (not header or int(header[1]) != records):
            raise _truncated(path, content)
        if header and int(header[1]) > records:
            raise ColmapError(
                f"expected {int(header[1])} records in {path} as its header says, got {records}: it is truncated; try "
                "copying the model again, or correct the header if records were removed on purpose"
            )
    try:
        model = read_text_model(paths[0].parent)
        names = dict(_names(contents[1]))
        for image_id, name in names.items():
            model.image(image_id).name = name
        for path in unended:
            content = contents[paths.index(path)]
            if not _last_record_agrees(model, path.stem, list(names), content.splitlines()[-1].split()):
                raise _truncated(path, content)
        model.write_binary(target)
    except ValueError as error:
        if isinstance(error, ColmapError):
            raise
        files = f"{paths[0]}, {paths[1].name} and {paths[2].name}"
        raise ColmapError(f"expected a COLMAP model in {files}, got one that pycolmap refuses: {error}") from error


def _truncated(path: Path, content: bytes) -> "ColmapError":
    return ColmapError(
        f"{path} ends without a line break, at {content[-20:]!r}, and looks truncated; copy the model again, or add "
        "the line break if the file is whole"
    )


def _names(images: bytes) -> Iterator[tuple[int, str]]:
    """Yield the id and name of each image of a text file, in its order."""
    lines = (line for line in images.splitlines() if not line.startswith(b"#"))
    for line in filter(bytes.strip, lines):
        image_id, *_, name = line.split(maxsplit=9)
        yield int(image_id), name.rstrip().decode(errors="backslashreplace")
        next(lines, None)  # its keypoints


def _last_record_agrees(model: Any, file: str, image_ids: list[int], fields: list[bytes]) -> bool:
    """Return whether the last line of a text file, split into fields, is whole.

    The keypoints of the last image and the tracks of the points have to name each other. Keypoints without a point that
    are missing at the end, and digits that are missing in the last parameter of a camera, cannot be noticed.
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
    """Walks a binary file; no read goes past its end."""

    def __init__(self, path: Path, content: mmap.mmap) -> None:
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

    def records(self) -> Iterator[int]:
        """The number of each record of the file, which has to end after the last."""
        yield from range(self.take(_COUNT)[0])
        if self.offset != len(self.content):
            raise ColmapError(
                f"expected {self.path} to end at byte {self.offset}, got {len(self.content)} bytes: it is not a COLMAP "
                "file or of an unknown version; try `colmap model_converter`"
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
                f"expected a camera model among {', '.join(name for name, _ in models.values())}, got id {model_id} in "
                f"{cursor.path}: it is not a COLMAP file, or newer than this pycolmap"
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
    """Every COLMAP model at or below `roots`, as {scene: {name of the model: folder}}, sorted.

    A scene is named by its path below the root, without what follows from `sparse` or `dense` on; all models below it
    (`sparse/0`, `sparse/1`, `sparse/manhattan/0`) belong to it. A scene's only model has the scene's name, others have
    their path added.

    Raises ColmapError if a root is not a folder, holds no model, or two scenes have one name. A folder that lacks one
    of the three files is skipped with a warning if there are whole ones.
    """
    scenes: dict[str, dict[str, Path]] = {}
    homes: dict[str, Path] = {}
    for root in [roots] if isinstance(roots, (str, Path)) else roots:
        top = Path(root).absolute()
        for folder in _find_models(top):
            home = _scene_folder(top, folder)
            scene = home.relative_to(top).as_posix() if top in home.parents else home.name
            if homes.setdefault(scene, home) != home:
                raise ColmapError(
                    f"expected scenes of different names, got {homes[scene]} and {home} for {scene!r}; try their "
                    "common parent folder as `root`"
                )
            scenes.setdefault(scene, {})["/".join((scene, *folder.relative_to(home).parts))] = folder
    return {
        scene: {scene: next(iter(models.values()))} if len(models) == 1 else dict(sorted(models.items()))
        for scene, models in sorted(scenes.items())
    }


def _find_models(top: Path) -> list[Path]:
    if not top.is_dir():
        raise ColmapError(f"expected a folder of COLMAP models, got {top}, which is no folder; try another `root`")
    whole, incomplete, visited = [], [], set[Path]()
    for name, children, files in os.walk(top, followlinks=True):
        folder = Path(name)
        children.sort()
        if folder.resolve() in visited:  # a link
            children.clear()
            continue
        visited.add(folder.resolve())
        if model_format(folder):
            whole.append(folder)
        elif max(sum(f"{part}.{suffix}" in files for part in FILES) for suffix in ("bin", "txt")) > 1:
            incomplete.append(folder)
    if incomplete:
        message = (
            f"expected cameras, images and points3D in a COLMAP model, got {len(incomplete)} folders without one of "
            f"them ({', '.join(map(str, incomplete[:4]))}); try copying them again"
        )
        if not whole:
            raise ColmapError(message)
        warnings.warn(f"skipped: {message}", stacklevel=4)
    if not whole:
        raise ColmapError(
            f"expected COLMAP models below {top}, got none; try a folder that holds <scene>/sparse/0/cameras.bin (or "
            ".txt), images and points3D"
        )
    return whole


def _scene_folder(top: Path, folder: Path) -> Path:
    """Where the path to a model first meets `sparse` or `dense`; else the model's folder itself.

    Looked for below the root, or from above it if the root is inside a scene, `castle/sparse` say.
    """
    start = len(top.parts)
    if all(INSIDE_LAYOUT.fullmatch(part) for part in folder.relative_to(top).parts):
        start -= len(list(itertools.takewhile(INSIDE_LAYOUT.fullmatch, reversed(top.parts))))
    for depth in range(max(start, 1), len(folder.parts)):
        if LAYOUT.fullmatch(folder.parts[depth]):
            return Path(*folder.parts[:depth])
    return folder
