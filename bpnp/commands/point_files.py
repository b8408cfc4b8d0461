"""Files of points, cameras and rough poses, as arrays."""

import json
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


def read_points2d(path: Path) -> tuple[Array, Labels | None]:
    """Image points (m, 2) or unit bearings (m, 3), and labels (m,) where a column is named label.

    path: .npy or text as for `read_points3d`. The columns x and y are taken, and z if there is one, or the first two
    where they have no names: a detector's rows go on with scale and angle. Raises ValueError as `read_points3d`.
    """
    _check_suffix(path, ARRAYS)
    values, names = _columns(path)
    if names:
        points, _, labels = _read_annotation(path, values, names, ("x", "y", "z") if "z" in names else ("x", "y"))
        return points, labels
    if values.shape[1] < 2:
        raise ValueError(f"expected points with 2 or 3 columns in {path}, got shape {values.shape}")
    return values if values.shape[1] == 3 else values[:, :2], None


def read_points3d(
    path: Path, *, surface: int | None = None, seed: int = 0
) -> tuple[Array, Array | None, Labels | None]:
    """Points (n, 3) of a file, and their outward normals (n, 3) and labels (n,) where it has them.

    path: .npy; .csv, .txt, .xyz with numbers in columns, separated by commas, semicolons, tabs or spaces; the first
    line may name them, else they are x, y, z, then nx, ny, nz or label or both; # starts a comment. Also .ply and
    meshes (.obj, .off, .stl, .glb): their different vertices, or `surface` points drawn from their triangles; and a
    COLMAP model, its folder or its points3D. Raises ValueError that names the file and what is wrong in it.
    """
    if path.is_dir() or path.stem == COLMAP_POINTS:
        from bpnp.datamodules.colmap.model_files import read_records

        return read_records(path if path.is_dir() else path.parent).points3d, None, None
    if path.suffix.lower() not in ARRAYS:
        from bpnp.datamodules.shapes import SUFFIXES, read_mesh, read_vertices, sample_surface

        _check_suffix(path, (*ARRAYS, *SUFFIXES))
        if surface is None:
            return read_vertices(path), None, None
        return sample_surface(read_mesh(path), surface, np.random.default_rng(seed)), None, None
    _check_suffix(path, ARRAYS)
    if surface is not None:
        raise ValueError(f"expected a mesh to draw {surface} points from, got {path}; try without --surface")
    return _read_annotation(path, *_columns(path), ("x", "y", "z"))


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
    if path.is_file():
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

    if path.suffix.lower() != ".json":
        return path
    rotation, translation = read_pose(path)
    return PosePrior(rotation, translation, degrees, np.inf if distance is None else distance)


def read_pose(path: Path) -> tuple[Array, Array]:
    """Rotation and translation in a JSON file with both, such as that of a solution. Raises ValueError without them."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return np.array(content["rotation"], np.float64), np.array(content["translation"], np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else "no file" if not path.is_file() else error
        raise ValueError(f"expected JSON with `rotation` and `translation` in {path}, got {reason}") from error


def read_pairs(path: Path) -> Array:
    """Rows of two numbers, such as matches: .npy or text as for `read_points3d`."""
    _check_suffix(path, ARRAYS)
    values = _columns(path)[0]
    if values.shape[1] != 2:
        raise ValueError(f"expected two columns in {path}, got {values.shape[1]}")
    return values


def _check_suffix(path: Path, known: tuple[str, ...]) -> None:
    if not path.is_file():
        raise ValueError(f"expected a file of points, got no file {path}")
    if path.suffix.lower() not in known:
        raise ValueError(f"expected a file that ends in {', '.join(known)}, got {path}")


def _read_annotation(
    path: Path, values: Array, names: list[str], coordinates: tuple[str, ...]
) -> tuple[Array, Array | None, Labels | None]:
    hint = " (are the two files swapped?)" if values.shape[1] == 2 else ""
    if not names and values.shape[1] not in COLUMNS:
        known = "3 to 4 or 6 to 7 columns (x, y, z, normal, label)"
        raise ValueError(f"expected {known} in {path}, got shape {values.shape}{hint}")
    place = {name: column for column, name in enumerate(names or (*coordinates, *COLUMNS[values.shape[1]]))}
    if not set(coordinates) <= set(place):
        raise ValueError(f"expected columns {', '.join(coordinates)} in {path}, got {', '.join(names)}{hint}")
    points = values[:, [place[name] for name in coordinates]]
    normals = values[:, [place[name] for name in NORMAL]] if set(NORMAL) <= set(place) else None
    if LABEL not in place:
        return points, normals, None
    labels = values[:, place[LABEL]]
    if len(fractions := labels[labels != np.round(labels)]):
        raise ValueError(f"expected integers in the column label of {path}, got {fractions[0]:g}")
    return points, normals, labels.astype(np.int64)


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


def _columns(path: Path) -> tuple[Array, list[str]]:
    """The numbers (k, c) of a .npy or a text, and the names of its columns if its first line has one for each."""
    try:
        if path.suffix.lower() == ".npy":
            array = np.load(path, allow_pickle=False)
            array = array[:, 0] if array.ndim == 3 and array.shape[1] == 1 else array  # OpenCV's points are (k, 1, 2)
            if array.dtype.kind not in "fiu" or array.ndim != 2:
                raise ValueError(f"{array.dtype} of shape {array.shape}")
            return array.astype(np.float64), []
        text = path.read_text(encoding="utf-8-sig")
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"expected rows of numbers in {path}, got {error}") from error
    lines = [content for line in text.splitlines() if (content := line.partition("#")[0].strip())]
    names = _words(lines[0]) if lines else []
    names = [] if any(_number(name) is not None for name in names) else names
    rows = lines[1:] if names else lines
    if not rows:
        raise ValueError(f"expected lines of numbers in {path}, got none")
    try:
        values = np.loadtxt(rows, np.float64, delimiter=_separator(rows[0]), ndmin=2)
    except ValueError as error:
        count = len(_words(rows[0]))
        wrong = (row for row in rows if len(_words(row)) != count or None in map(_number, _words(row)))
        raise ValueError(f"expected rows of {count} numbers in {path}, got {next(wrong, rows[0])[:60]!r}") from error
    return values, names if len(names) == values.shape[1] else []


def _separator(line: str) -> str | None:
    """What separates the words of a line; None for spaces and tabs."""
    return next((mark for mark in ",;" if mark in line), None)


def _words(line: str) -> list[str]:
    return [word.strip().lower() for word in line.split(_separator(line))]


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
