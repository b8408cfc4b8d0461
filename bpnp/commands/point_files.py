"""Readers of files of points, cameras and poses."""

import csv
import re
import sys
from collections.abc import Callable, Collection, Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bpnp.argument_types import short_repr
from bpnp.arrays import Array, Labels
from bpnp.bounded_files import MOST_BINARY, MOST_TEXT, parse_json, parse_npy, read_bytes, read_stream
from bpnp.commands.calibration_files import is_calibration, parse_calibration

ARRAYS = (".npy", ".csv", ".txt", ".xyz")
CLOUD = ".pcd"
CALIBRATIONS = (".yaml", ".yml", ".json")
COLMAP_POINTS, COLMAP_CAMERAS = ("points3D.bin", "points3D.txt"), ("cameras.bin", "cameras.txt")
NORMAL, LABEL, SCORE = ("nx", "ny", "nz"), "label", "score"
# Columns after x, y, z in a file that does not name them, by the number of columns.
COLUMNS: dict[int, tuple[str, ...]] = {3: (), 4: (LABEL,), 6: NORMAL, 7: (*NORMAL, LABEL)}
NAME_COLUMNS = "remove it, or name the columns in the first line, such as"
IMAGE_COLUMNS = (("x", "y", "z"), ("x", "y"), ("u", "v"))
STANDARD_INPUT = Path("-")
NUMPY = b"\x93NUMPY"  # first bytes of a .npy file
FEW_ROWS = 3  # least number of rows of an index column
LARGEST_LABEL = 2**53  # larger integers are not exact in float64


class PointColumns(NamedTuple):
    """Points of a file and its other columns, None where it has none."""

    points: Array  # (k, 2) image points, (k, 3) unit bearings or scene points
    normals: Array | None = None  # (k, 3) outward normals of scene points
    labels: Labels | None = None  # (k,) labels
    scores: Array | None = None  # (k,) probabilities that a point has a correspondence


def read_points2d(path: Path) -> PointColumns:
    """Read image points (m, 2) or unit bearings (m, 3), and the columns label and score if they are named.

    The file is .npy or text as for `read_points3d`. Named columns x and y are read, and z if there is one, or u and v;
    of unnamed columns the first two, since a detector's rows continue with scale and angle; or three, unit bearings, or
    a count of the rows before x and y.
    """
    _check_suffix(path, ARRAYS)
    wanted = {LABEL, SCORE}.union(*IMAGE_COLUMNS)
    values, names = _columns(path, wanted, needs="x, y")
    if names:
        coordinates = next((columns for columns in IMAGE_COLUMNS if set(columns) <= set(names)), ("x", "y"))
        return _read_annotation(path, values, names, coordinates, hint=", or u, v")._replace(normals=None)
    if values.shape[1] < 2:
        raise ValueError(f"{_name(path)} needs points with 2 or 3 columns; its shape is {values.shape}")
    if values.shape[1] > 2 and _counts_rows(values[:, 0]):
        if values.shape[1] > 3:
            raise ValueError(f"the first column of {_name(path)} counts its rows; {NAME_COLUMNS} `index x y`")
        return PointColumns(values[:, 1:])
    if values.shape[1] == 3 and (values[:, 0] == np.round(values[:, 0])).all() and (abs(values) > 2).any():
        raise ValueError(
            f"{_name(path)} has 3 columns, which are read as unit bearings, but the first row is {values[0].tolist()} "
            f"(are the two files swapped?); if the first column is an index, {NAME_COLUMNS} `index x y`"
        )
    return PointColumns(values if values.shape[1] == 3 else values[:, :2])


def read_points3d(path: Path, *, surface: int | None = None, seed: int = 0) -> PointColumns:
    """Read scene points (n, 3), their outward normals, labels and scores.

    The path is one of:

    - .npy; .csv, .txt or .xyz with columns of numbers separated by commas, semicolons, tabs or spaces (a comma is a
      decimal mark if the separator is a semicolon or a tab). The first line may name the columns; otherwise they are
      x, y, z, then nx, ny, nz or label or both; scores are read only of a column named score. # starts a comment.
    - .pcd, ASCII or binary.
    - .ply or a mesh (.obj, .off, .stl, .glb): its distinct vertices, or `surface` points drawn from its triangles. The
      normals of a .ply without faces are read unless all of them are zero.
    - A COLMAP model: its folder, or its points3D.bin or points3D.txt.
    - `-` or a pipe with the content of a .npy or of a text.

    Raise ValueError, which names the file and what is wrong in it.
    """
    if path.is_dir() or path.name in COLMAP_POINTS:
        from bpnp.datamodules.colmap.model_files import read_records

        return PointColumns(read_records(path if path.is_dir() else path.parent).points3d)
    if path.suffix.lower() not in (*ARRAYS, CLOUD) and not _is_stream(path):
        from bpnp.datamodules.shapes import SUFFIXES, read_mesh, read_vertices, sample_surface

        _check_suffix(path, (*ARRAYS, CLOUD, *SUFFIXES))
        if surface is not None:
            return PointColumns(sample_surface(read_mesh(path), surface, np.random.default_rng(seed)))
        points, columns = read_vertices(path)
        read = _annotated(path, points, columns.__getitem__, [*columns])
        return read if read.normals is None or read.normals.any() else read._replace(normals=None)
    _check_suffix(path, (*ARRAYS, CLOUD))
    if surface is not None:
        raise ValueError(f"--surface draws points from a mesh, and {path} is none; leave it out")
    if path.suffix.lower() == CLOUD:
        from bpnp.commands.pcd_files import parse_pcd

        try:
            points, columns = parse_pcd(_content(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return _annotated(path, points, columns.__getitem__, [*columns])
    values, names = _columns(path, {*"xyz", *NORMAL, LABEL, SCORE}, needs="x, y, z")
    return _read_annotation(path, values if names else _without_index(path, values), names, ("x", "y", "z"))


def read_camera(text: str, image: str | None = None, *, centre: float = 0.0) -> Any:
    """Read the camera that `--camera` names.

    It is a file with a 3x3 matrix; a YAML file of ROS (camera_info) or OpenCV, see `parse_calibration`; four numbers,
    "fx,fy,cx,cy"; a COLMAP camera model with its parameters, "PINHOLE 500 500 320 240" or
    "PINHOLE,640,480,500,500,320,240" (with width and height, as in cameras.txt); or a COLMAP model, its folder or its
    cameras.bin or cameras.txt. `image` names the image of the COLMAP model whose camera is read, by default its only
    camera. `centre` is the coordinate of the centre of the first pixel in the image points, for the camera of a YAML
    file: 0 as in OpenCV and ROS, or 0.5 as in COLMAP.
    """
    path = Path(text)
    if (text and path.is_dir()) or (path.name in COLMAP_CAMERAS and path.is_file()):
        return _camera_of(path, image)
    if image is not None:
        raise ValueError(f"--image needs a COLMAP model as --camera, which is {text!r}")
    if _is_stream(path) or (text and path.exists()):
        return _camera_in(path, centre)
    if "/" in text or path.suffix.lower() in (*ARRAYS, *CALIBRATIONS, ".bin"):
        raise ValueError(f"there is no file {text}, which --camera names")
    model, *words = text.replace(",", " ").split() or [""]
    numbers = [_number(word) for word in words]
    if len(numbers) == 3 and None not in (_number(model), *numbers):
        return _number(model), *numbers
    if not numbers or None in numbers or not model.replace("_", "").isalnum() or model[0].isdigit():
        raise ValueError(
            f"--camera {text!r} is neither a file with a 3x3 matrix or ROS's camera_info nor fx,fy,cx,cy nor "
            "MODEL,PARAMETERS such as SIMPLE_PINHOLE,800,320,240"
        )
    from bpnp.cameras import camera_models

    counts = dict(camera_models().values())
    sized = len(numbers) == counts.get(model.upper(), len(numbers)) + 2
    return (model.upper(), *numbers[:2], numbers[2:]) if sized else (model.upper(), numbers)


def read_prior(path: Path, degrees: float, distance: float | None) -> Any:
    """Read a rough pose from JSON with `rotation` and `translation`, or a pipe with it, as a prior.

    Standard deviations are in degrees and scene units, None if unknown. Another path, of a checkpoint, is returned
    unchanged. Raise ValueError if the JSON has no pose.
    """
    from bpnp.search.starts import PosePrior

    if path.suffix.lower() != ".json" and not _is_stream(path):
        return path
    rotation, translation = read_pose(path)
    return PosePrior(rotation, translation, degrees, np.inf if distance is None else distance)


def read_pose(path: Path) -> tuple[Array, Array]:
    """Read rotation and translation from a JSON file, such as that of a solution."""
    try:
        content = parse_json(_content(path))
        if not isinstance(content, dict):
            raise ValueError(f"it holds {short_repr(content)}")
        return np.array(content["rotation"], np.float64), np.array(content["translation"], np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, FileNotFoundError):
            raise ValueError(f"there is no file {path}") from error
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f'{path} is no JSON with "rotation" and "translation": {reason}') from error


def read_pairs(path: Path) -> Array:
    """Read rows of two numbers, such as matches, from a .npy or a text as for `read_points3d`."""
    _check_suffix(path, ARRAYS)
    values = _columns(path, needs="two indices, of a 2D and of a 3D point")[0]
    if values.shape[1] != 2:
        count = values.shape[1]
        raise ValueError(f"{_name(path)} needs two columns; it has {count}; give indices of a 2D and of a 3D point")
    return values


def _is_stream(path: Path) -> bool:
    """Return True for standard input and for pipes, which have no suffix: `-`, /dev/stdin, a process substitution."""
    return path == STANDARD_INPUT or path.is_fifo() or (not path.suffix and path.exists() and not path.is_dir())


def _content(path: Path) -> bytes:
    """Return the bytes of a file, of a pipe, or of standard input."""
    if path != STANDARD_INPUT:
        return read_bytes(path, MOST_BINARY if path.suffix.lower() in (".npy", CLOUD) else MOST_TEXT)
    if sys.stdin is None:  # as after `<&-`
        raise ValueError("standard input is closed")
    return read_stream(sys.stdin.buffer, _name(path))


def _name(path: Path) -> str:
    """Return the name of a file for messages."""
    return "standard input" if path == STANDARD_INPUT else str(path)


def _check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    if _is_stream(path):
        return
    if not path.is_file():
        kind = "folder" if path.is_dir() else "device" if path.exists() else ""
        raise ValueError(f"{path} is a {kind}; give a file" if kind else f"there is no file {path}")
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} has to end in {', '.join(suffixes)}")


def _read_annotation(
    path: Path, values: Array, names: list[str], coordinates: tuple[str, ...], *, hint: str = ""
) -> PointColumns:
    """Take points and the columns beside them from columns (k, c), whose names are empty if the file has none.

    `hint` follows the coordinates in the message that they are missing.
    """
    swapped = " (are the two files swapped?)" if values.shape[1] == 2 else ""
    if not names and values.shape[1] not in COLUMNS:
        expected = "3 to 4 or 6 to 7 columns (x, y, z, normal, label)"
        raise ValueError(f"{_name(path)} needs {expected}; its shape is {values.shape}{swapped}")
    names = names or [*coordinates, *COLUMNS[values.shape[1]]]
    if not set(coordinates) <= set(names):
        raise ValueError(
            f"{_name(path)} needs columns {', '.join(coordinates)}{hint}; its columns are {', '.join(names)}{swapped}"
        )
    index = {name: column for column, name in enumerate(names)}
    points = values[:, [index[name] for name in coordinates]]
    return _annotated(path, points, lambda name: values[:, index[name]], names)


def _annotated(path: Path, points: Array, column: Callable[[str], Array], names: Collection[str]) -> PointColumns:
    """Return points with the normals, labels and scores of a file with columns of these names."""
    normals = np.stack([column(name) for name in NORMAL], -1) if set(NORMAL) <= set(names) else None
    scores = column(SCORE) if SCORE in names else None
    if scores is not None and len(wrong := scores[~((scores > 0) & (scores <= 1))]):
        raise ValueError(
            f"the column score of {_name(path)} holds {wrong[0]:g}; scores are above 0 and at most 1: divide by the "
            "largest, or give the column another name"
        )
    if LABEL not in names:
        return PointColumns(points, normals, None, scores)
    labels = column(LABEL)
    if len(wrong := labels[(labels != np.round(labels)) | (abs(labels) > LARGEST_LABEL)]):
        raise ValueError(
            f"the column label of {path} holds {wrong[0]:g}; labels are integers; if a column without a name is an "
            f"index or something else, {NAME_COLUMNS} `x y z`"
        )
    return PointColumns(points, normals, labels.astype(np.int64), scores)


def _camera_of(path: Path, image: str | None) -> tuple[Any, ...]:
    """Return the camera of an image of a COLMAP model, or its only camera."""
    from bpnp.datamodules.colmap.model_files import read_records

    model = read_records(path if path.is_dir() else path.parent)
    used = {record.name: record.camera_id for record in sorted(model.images, key=lambda record: record.name)}
    some = ", ".join([*used][:8])
    if image is not None and used.get(image) not in model.cameras:
        raise ValueError(f"{path} has no image {image!r} with a camera; its images are {some}")
    if image is None and len(model.cameras) != 1:
        raise ValueError(f"{path} has {len(model.cameras)} cameras; choose one by --image, such as {some}")
    camera = next(iter(model.cameras.values())) if image is None else model.cameras[used[image]]
    return camera.model, *camera.size, camera.params


def _camera_in(path: Path, centre: float) -> Any:
    """Return the camera in a file with a matrix, or in a YAML file."""
    content = _content(path)
    if not content.startswith(NUMPY) and path.suffix.lower() != ".npy":
        text = content.decode("utf-8", errors="replace")
        if path.suffix.lower() in CALIBRATIONS or is_calibration(text):
            try:
                return parse_calibration(text, centre=centre)
            except ValueError as error:
                raise ValueError(f"--camera {_name(path)}: {error}") from error
    return _parse_columns(path, content, needs="the numbers of a 3x3 matrix")[0]


def _counts_rows(column: Array) -> bool:
    """Return True for the numbers 0, 1, 2, ... or 1, 2, 3, ..., as of an index."""
    return len(column) >= FEW_ROWS and any((column == np.arange(len(column)) + first).all() for first in (0, 1))


def _without_index(path: Path, values: Array) -> Array:
    """Return columns without names, of scene points, without a first one that counts the rows.

    Raise ValueError if the first column may also be x.
    """
    count = values.shape[1]
    if count - 1 not in COLUMNS or not _counts_rows(values[:, 0]):
        return values
    is_label = (values[:, -1] == np.round(values[:, -1])).all()
    if count not in COLUMNS or (LABEL in COLUMNS[count] and not is_label):
        return values[:, 1:]
    first, second = (" ".join(("x", "y", "z", *COLUMNS[c])) for c in (count, count - 1))
    raise ValueError(
        f"the first column of {_name(path)} counts its rows, and may be x or an index; {NAME_COLUMNS} `{first}` or "
        f"`index {second}`"
    )


def _columns(path: Path, wanted: Set[str] = frozenset(), *, needs: str) -> tuple[Array, list[str]]:
    """Read columns of numbers from a .npy or a text, as `_parse_columns`."""
    try:
        content = _content(path)
    except OSError as error:
        raise ValueError(f"cannot read rows of numbers from {_name(path)}: {error}") from error
    return _parse_columns(path, content, wanted, needs=needs)


def _parse_columns(
    path: Path, content: bytes, wanted: Set[str] = frozenset(), *, needs: str
) -> tuple[Array, list[str]]:
    """Parse columns of numbers (k, c) of a .npy or a text, and their names; no name if the first line has none.

    `wanted` columns have to be numbers, where the first line names them; all by default. A column of another name is
    NaN. Rows may have one more word than the first line, before the others, as R writes their names. Raise ValueError
    if the file cannot be read, or its first line names another number of columns than its rows have, or two wanted
    columns alike. `needs`, what a row has to hold, is for messages.
    """
    try:
        if path.suffix.lower() == ".npy" or content.startswith(NUMPY):
            array = parse_npy(content)
            array = array[:, 0] if array.ndim == 3 and array.shape[1] == 1 else array  # OpenCV points are (k, 1, 2)
            if array.dtype.kind not in "fiu" or array.ndim != 2:
                raise ValueError(f"it holds {array.dtype} of shape {array.shape}; rows of real numbers are needed")
            return array.astype(np.float64), []
        text = content.decode("utf-8-sig")
    except ValueError as error:
        raise ValueError(f"cannot read rows of numbers from {_name(path)}: {error}") from error
    lines = [line for commented in text.splitlines() if (line := commented.partition("#")[0].strip())]
    names = _words(lines[0]) if lines else []
    names = [] if any(_number(name) is not None for name in names) else names
    rows = lines[1:] if names else lines
    if not rows:
        raise ValueError(f"{_name(path)} has no lines of numbers")
    mark, count = _separator(rows[0]), len(_words(rows[0]))
    if names and count == len(names) + 1:
        names = ["", *names]
    if len(names) != count and wanted & {*names}:
        raise ValueError(f"{_name(path)} names {len(names)} columns in its first line; its rows have {count}")
    names = names if len(names) == count else []
    if repeated := next((name for name in names if name in wanted and names.count(name) > 1), None):
        count = names.count(repeated)
        raise ValueError(f"{_name(path)} names {count} columns {repeated} in its first line; keep one of them")
    others = [i for i, name in enumerate(names) if wanted and name not in wanted]
    decimals = rows if mark == "," else [row.replace(",", ".") for row in rows]
    converters: Any = {i: lambda _: np.nan for i in others}
    try:
        values = np.loadtxt(decimals, np.float64, delimiter=mark, quotechar='"', converters=converters, ndmin=2)
    except ValueError as error:
        needed = sorted({*range(count)} - {*others})
        wrong = (
            row for row in rows if len(words := _words(row)) != count or None in [_number(words[i]) for i in needed]
        )
        row = next(wrong, rows[0])
        if (other := len(_words(row))) != count:
            raise ValueError(
                f"{_name(path)} has rows of {count} and of {other} columns, such as {rows[0][:40]!r} and {row[:40]!r}; "
                f"each row needs the same, {needs}"
            ) from error
        raise ValueError(f"{_name(path)} needs rows of numbers, {needs}; it has {row[:60]!r}") from error
    return values, names


def _separator(line: str) -> str | None:
    """Return the separator of the words of a line, None for spaces and tabs, where a comma is a decimal mark."""
    if ";" in line:
        return ";"
    decimal_commas = "\t" in line and not re.search(r",(?!\d)", line)
    return "," if "," in line and not decimal_commas else None


def _words(line: str) -> list[str]:
    mark = _separator(line)
    quoted = re.findall(r'"[^"]*"|\S+', line) if mark is None else next(csv.reader([line], delimiter=mark))
    return [word.strip(' "').lower() for word in quoted]


def _number(word: str) -> float | None:
    try:
        return float(word.replace(",", "."))
    except ValueError:
        return None
