"""Files of points, cameras and rough poses, as arrays."""

import csv
import io
import json
import re
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
ARRAYS = (".npy", ".csv", ".txt", ".xyz")
COLMAP_POINTS, COLMAP_CAMERAS = "points3D", "cameras"  # the files of a COLMAP model, .bin or .txt
NORMAL, LABEL = ("nx", "ny", "nz"), "label"
# After x, y, z in a file that does not name its columns, by their number.
COLUMNS: dict[int, tuple[str, ...]] = {3: (), 4: (LABEL,), 6: NORMAL, 7: (*NORMAL, LABEL)}
IMAGE_COLUMNS = (("x", "y", "z"), ("x", "y"), ("u", "v"))
STANDARD_INPUT = Path("-")
NUMPY = b"\x93NUMPY"  # the first bytes of a .npy file


def read_points2d(path: Path) -> tuple[Array, Labels | None]:
    """Read image points.

    Args:
        path: .npy or text as for `read_points3d`. Of named columns x and y are taken, and z if there is one, or u and
            v; of others the first two: a detector's rows go on with scale and angle.

    Returns:
        Points (m, 2) or unit bearings (m, 3); labels (m,) of a column named label, else None.

    Raises:
        ValueError: As `read_points3d`.
    """
    _check_suffix(path, ARRAYS)
    values, names = _columns(path, {name for known in IMAGE_COLUMNS for name in known} | {LABEL})
    if names:
        coordinates = next((known for known in IMAGE_COLUMNS if set(known) <= set(names)), ("x", "y"))
        points, _, labels = _read_annotation(path, values, names, coordinates, hint=", or u, v")
        return points, labels
    if values.shape[1] < 2:
        raise ValueError(f"expected points with 2 or 3 columns in {path}, got shape {values.shape}")
    return values if values.shape[1] == 3 else values[:, :2], None


def read_points3d(
    path: Path, *, surface: int | None = None, seed: int = 0
) -> tuple[Array, Array | None, Labels | None]:
    """Read scene points.

    Args:
        path: .npy; .csv, .txt, .xyz with numbers in columns, separated by commas, semicolons, tabs or spaces; beside
            semicolons and tabs a comma is a decimal mark. The first line may name the columns, else they are x, y, z,
            then nx, ny, nz or label or both; # starts a comment. Also .ply and meshes (.obj, .off, .stl, .glb): their
            different vertices, or `surface` points drawn from their triangles; a COLMAP model, its folder or its
            points3D; `-` or a pipe with the content of a .npy or of a text.
        surface: Number of points to draw from a mesh.
        seed: Of these.

    Returns:
        Points (n, 3); their outward normals (n, 3) and labels (n,), None where the file has none. The normals of a
        .ply without faces count, but not if all of them are zero.

    Raises:
        ValueError: The file cannot be read. The message names it and what is wrong in it.
    """
    if path.is_dir() or path.stem == COLMAP_POINTS:
        from bpnp.datamodules.colmap.model_files import read_records

        return read_records(path if path.is_dir() else path.parent).points3d, None, None
    if path.suffix.lower() not in ARRAYS and not _is_stream(path):
        from bpnp.datamodules.shapes import SUFFIXES, read_mesh, read_vertices, sample_surface

        _check_suffix(path, (*ARRAYS, *SUFFIXES))
        if surface is not None:
            return sample_surface(read_mesh(path), surface, np.random.default_rng(seed)), None, None
        points, columns = read_vertices(path)
        normals, labels = _normals_and_labels(path, columns.__getitem__, [*columns])
        return points, None if normals is None or not normals.any() else normals, labels
    _check_suffix(path, ARRAYS)
    if surface is not None:
        raise ValueError(f"expected a mesh to draw {surface} points from, got {path}; try without --surface")
    return _read_annotation(path, *_columns(path, {*"xyz", *NORMAL, LABEL}), ("x", "y", "z"))


def read_camera(text: str, image: str | None = None) -> Any:
    """The camera that `--camera` names: a file with a 3x3 matrix, or a COLMAP model with its parameters.

    Also a camera of a COLMAP reconstruction, named by its folder or by its file of cameras: its only one, or that of
    an `image`.
    "PINHOLE 500 500 320 240" and "PINHOLE,640,480,500,500,320,240" (with width and height, as in cameras.txt) are both
    understood. Raises ValueError for anything else.
    """
    path = Path(text)
    if (text and path.is_dir()) or (path.stem == COLMAP_CAMERAS and path.is_file()):
        return _camera_of(path, image)
    if image is not None:
        raise ValueError(f"expected --image with a COLMAP model as --camera, got it with {text!r}")
    if path.is_file() or _is_stream(path):
        return _columns(path)[0]
    model, *words = text.replace(",", " ").split() or [""]
    numbers = [_number(word) for word in words]
    if not numbers or None in numbers or not model.replace("_", "").isalnum() or model[0].isdigit():
        raise ValueError(
            f"expected --camera as a file with a 3x3 matrix or as MODEL,PARAMETERS such as SIMPLE_PINHOLE,800,320,240; "
            f"got {text!r}, which is neither"
        )
    from bpnp.cameras import camera_models

    counts = dict(camera_models().values())
    sized = len(numbers) == counts.get(model.upper(), len(numbers)) + 2
    return (model.upper(), *numbers[:2], numbers[2:]) if sized else (model.upper(), numbers)


def read_prior(path: Path, degrees: float, distance: float | None) -> Any:
    """The rough pose in a JSON file with `rotation` and `translation`, as wide as `degrees` and `distance`; the path of
    anything else, a checkpoint. Raises ValueError for JSON without a pose."""
    from bpnp.search.starts import PosePrior

    if path.suffix.lower() != ".json" and not _is_stream(path):
        return path
    rotation, translation = read_pose(path)
    return PosePrior(rotation, translation, degrees, np.inf if distance is None else distance)


def read_pose(path: Path) -> tuple[Array, Array]:
    """Rotation and translation in a JSON file with both, such as that of a solution. Raises ValueError without them."""
    try:
        content = json.loads(_content(path))
        return np.array(content["rotation"], np.float64), np.array(content["translation"], np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        missing = "no file" if isinstance(error, FileNotFoundError) else error
        reason = f"no {error}" if isinstance(error, KeyError) else missing
        raise ValueError(f"expected JSON with `rotation` and `translation` in {path}, got {reason}") from error


def read_pairs(path: Path) -> Array:
    """Rows of two numbers, such as matches: .npy or text as for `read_points3d`."""
    _check_suffix(path, ARRAYS)
    values = _columns(path)[0]
    if values.shape[1] != 2:
        raise ValueError(f"expected two columns in {path}, got {values.shape[1]}")
    return values


def _is_stream(path: Path) -> bool:
    """Return True for standard input and for pipes, which have no suffix: `-`, /dev/stdin, a process substitution."""
    return path == STANDARD_INPUT or (not path.suffix and path.exists() and not path.is_dir())


def _content(path: Path) -> bytes:
    """Return the bytes of a file, of a pipe, or of standard input."""
    return sys.stdin.buffer.read() if path == STANDARD_INPUT else path.read_bytes()


def _check_suffix(path: Path, known: tuple[str, ...]) -> None:
    if _is_stream(path):
        return
    if not path.is_file():
        raise ValueError(f"expected a file of points, got no file {path}")
    if path.suffix.lower() not in known:
        raise ValueError(f"expected a file that ends in {', '.join(known)}, got {path}")


def _read_annotation(
    path: Path, values: Array, names: list[str], coordinates: tuple[str, ...], *, hint: str = ""
) -> tuple[Array, Array | None, Labels | None]:
    """Take points, normals and labels from columns; `hint` follows the coordinates in the message that misses them."""
    swapped = " (are the two files swapped?)" if values.shape[1] == 2 else ""
    if not names and values.shape[1] not in COLUMNS:
        known = "3 to 4 or 6 to 7 columns (x, y, z, normal, label)"
        raise ValueError(f"expected {known} in {path}, got shape {values.shape}{swapped}")
    names = names or [*coordinates, *COLUMNS[values.shape[1]]]
    if not set(coordinates) <= set(names):
        raise ValueError(f"expected columns {', '.join(coordinates)}{hint} in {path}, got {', '.join(names)}{swapped}")
    place = {name: column for column, name in enumerate(names)}
    points = values[:, [place[name] for name in coordinates]]
    return points, *_normals_and_labels(path, lambda name: values[:, place[name]], names)


def _normals_and_labels(
    path: Path, column: Callable[[str], Array], names: Collection[str]
) -> tuple[Array | None, Labels | None]:
    """Return normals (n, 3) and labels (n,) of a file with columns of these names, None without them."""
    normals = np.stack([column(name) for name in NORMAL], -1) if set(NORMAL) <= set(names) else None
    if LABEL not in names:
        return normals, None
    labels = column(LABEL)
    if len(fractions := labels[labels != np.round(labels)]):
        raise ValueError(f"expected integers in the column label of {path}, got {fractions[0]:g}")
    return normals, labels.astype(np.int64)


def _camera_of(path: Path, image: str | None) -> tuple[Any, ...]:
    """The camera of an image of a COLMAP model, or the only one that it has."""
    from bpnp.datamodules.colmap.model_files import read_records

    model = read_records(path if path.is_dir() else path.parent)
    used = {record.name: record.camera_id for record in sorted(model.images, key=lambda record: record.name)}
    some = ", ".join([*used][:8])
    if image is not None and used.get(image) not in model.cameras:
        raise ValueError(f"expected an image of {path}, got {image!r}; try one of {some}")
    if image is None and len(model.cameras) != 1:
        raise ValueError(f"expected one camera in {path}, got {len(model.cameras)}; try --image with one of {some}")
    camera = next(iter(model.cameras.values())) if image is None else model.cameras[used[image]]
    return camera.model, *camera.size, camera.params


def _columns(path: Path, wanted: Collection[str] = ()) -> tuple[Array, list[str]]:
    """Read columns of numbers from a .npy or a text.

    Args:
        path: File, pipe or standard input.
        wanted: Names of the columns that have to be numbers, where the first line names them; all by default. A column
            of another name is NaN. Rows may have one more word than the first line, before the others, as R writes
            their names.

    Returns:
        Numbers (k, c), and the names of the c columns; no name if the first line has none.
    """
    try:
        content = _content(path)
        if path.suffix.lower() == ".npy" or content.startswith(NUMPY):
            array = np.load(io.BytesIO(content), allow_pickle=False)
            array = array[:, 0] if array.ndim == 3 and array.shape[1] == 1 else array  # OpenCV's points are (k, 1, 2)
            if array.dtype.kind not in "fiu" or array.ndim != 2:
                raise ValueError(f"{array.dtype} of shape {array.shape}")
            return array.astype(np.float64), []
        text = content.decode("utf-8-sig")
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"expected rows of numbers in {path}, got {error}") from error
    lines = [line for commented in text.splitlines() if (line := commented.partition("#")[0].strip())]
    names = _words(lines[0]) if lines else []
    names = [] if any(_number(name) is not None for name in names) else names
    rows = lines[1:] if names else lines
    if not rows:
        raise ValueError(f"expected lines of numbers in {path}, got none")
    mark, count = _separator(rows[0]), len(_words(rows[0]))
    if names and count == len(names) + 1:
        names = ["", *names]
    names = names if len(names) == count else []
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
        raise ValueError(f"expected rows of {count} numbers in {path}, got {next(wrong, rows[0])[:60]!r}") from error
    return values, names


def _separator(line: str) -> str | None:
    """Return what separates the words of a line, None for spaces and tabs, beside which a comma is a decimal mark."""
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
