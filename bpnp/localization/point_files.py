"""Files of points and cameras, as arrays."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from bpnp.datamodules.colmap.model_files import ModelRecords

Array = npt.NDArray[np.float64]
TEXTS = (".csv", ".txt", ".xyz")
COLMAP_POINTS, COLMAP_CAMERAS = "points3D", "cameras"  # the files of a COLMAP model, .bin or .txt
NORMAL, LABEL = ("nx", "ny", "nz"), "label"


def read_points(path: Path, width: int | None = None, *, surface: int | None = None, seed: int = 0) -> Array:
    """The points (k, width) of a file; width None for image points, which have two columns, or three if they are rays.

    width 3: also a COLMAP model, its folder or its points3D. width None: of four and more columns the first two.
    .npy; .csv, .txt, .xyz with numbers in columns, separated by commas, semicolons, tabs or spaces, the first line may
    name them, and # starts a comment; for 3D points also .ply and meshes (.obj, .off, .stl, .glb): their different
    vertices, or `surface` points drawn from their triangles.
    Raises ValueError that names the file and what is wrong in it.
    """
    if width == 3 and (path.is_dir() or path.stem == COLMAP_POINTS):
        return _colmap(path).points3d
    if not path.is_file():
        raise ValueError(f"expected a file of points, got no file {path}")
    suffix = path.suffix.lower()
    meshes: tuple[str, ...] = ()
    if width == 3 and suffix not in (".npy", *TEXTS):
        from bpnp.datamodules.meshes.surfaces import SUFFIXES, read_mesh, read_vertices, sample_surface

        meshes = SUFFIXES
        if suffix in meshes:
            if surface is not None:
                return sample_surface(read_mesh(path), surface, np.random.default_rng(seed))
            return read_vertices(path)
    if surface is not None:
        raise ValueError(f"expected a mesh to draw {surface} points from, got {path}; try without --surface")
    if suffix == ".npy":
        points = _npy(path)
    elif suffix in TEXTS:
        points, _ = _columns(path)
    else:
        known = (".npy", *TEXTS, *meshes)
        raise ValueError(f"expected a file that ends in {', '.join(known)}, got {path}")
    widths = (2, 3) if width is None else (width,)
    if width is None and points.ndim == 2 and points.shape[1] > 3:
        return points[:, :2]  # keypoints: x, y, scale and more
    if points.ndim != 2 or points.shape[1] not in widths:
        columns = " or ".join(map(str, widths))
        hint = " (are the two files swapped?)" if points.ndim == 2 and points.shape[1] in (2, 3) else ""
        raise ValueError(f"expected points with {columns} columns in {path}, got shape {points.shape}{hint}")
    return points


def read_scene(
    path: Path, *, surface: int | None = None, seed: int = 0
) -> tuple[Array, Array | None, npt.NDArray[np.int64] | None]:
    """Points (n, 3) of a file, and their outward normals (n, 3) and labels (n,) where it has them.

    As `read_points`; a text may have columns nx, ny, nz and label beside x, y, z: by the names in its first line, or
    without names after the coordinates, in this order (4, 6 or 7 columns).
    """
    colmap = path.stem == COLMAP_POINTS
    if colmap or path.suffix.lower() not in TEXTS or surface is not None or not path.is_file():
        return read_points(path, 3, surface=surface, seed=seed), None, None
    return _annotated(path, ("x", "y", "z"))


def read_image(path: Path) -> tuple[Array, npt.NDArray[np.int64] | None]:
    """Image points (m, 2) or unit bearings (m, 3), and labels (m,) where a column of a text is named label."""
    if path.suffix.lower() not in TEXTS or not path.is_file() or LABEL not in (_columns(path)[1] or ()):
        return read_points(path), None
    points, _, labels = _annotated(path, ("x", "y"))
    return points, labels


def _annotated(
    path: Path, coordinates: tuple[str, ...]
) -> tuple[Array, Array | None, npt.NDArray[np.int64] | None]:  # fmt: skip
    values, names = _columns(path)
    if names is None:
        shapes = {3: (), 4: (LABEL,), 6: NORMAL, 7: (*NORMAL, LABEL)}
        if values.shape[1] not in shapes:
            known = "3 to 4 or 6 to 7 columns (x, y, z, normal, label)"
            raise ValueError(
                f"expected {known} in {path}, got shape {values.shape}"
                f"{' (are the two files swapped?)' if values.shape[1] == 2 else ''}"
            )
        names = [*coordinates, *shapes[values.shape[1]]]
    place = {name: column for column, name in enumerate(names)}
    if not set(coordinates) <= set(place):
        hint = " (are the two files swapped?)" if len(names) == 2 else ""
        raise ValueError(f"expected columns {', '.join(coordinates)} in {path}, got {', '.join(names)}{hint}")
    points = values[:, [place[name] for name in coordinates]]
    normals = values[:, [place[name] for name in NORMAL]] if set(NORMAL) <= set(place) else None
    if LABEL not in place:
        return points, normals, None
    labels = values[:, place[LABEL]]
    fractions = labels[labels != np.round(labels)]
    if len(fractions):
        raise ValueError(f"expected integers in the column label of {path}, got {fractions[0]:g}")
    return points, normals, labels.astype(np.int64)


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
        return _npy(path) if path.suffix.lower() == ".npy" else _columns(path)[0]
    words = text.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError:
        numbers = []
    if not numbers or not words[0].replace("_", "").isalnum() or words[0][0].isdigit():
        raise ValueError(
            f"expected --camera as a file with a 3x3 matrix or as MODEL,PARAMETERS such as SIMPLE_PINHOLE,800,320,240; "
            f"got {text!r}"
        )
    return _described(words[0].upper(), numbers)


def _colmap(path: Path) -> "ModelRecords":
    """The COLMAP model in a folder, or around one of its files."""
    from bpnp.datamodules.colmap.model_files import read_records

    return read_records(path if path.is_dir() else path.parent)


def _camera_of(path: Path, image: str | None) -> tuple[Any, ...]:
    """The camera of an image of a COLMAP model, or the only one that it has."""
    model = _colmap(path)
    used = {own.name: own.camera_id for own in sorted(model.images, key=lambda own: own.name)}
    some = ", ".join([*used][:8])
    if image is not None and used.get(image) not in model.cameras:
        raise ValueError(f"expected an image of {path}, got {image!r}; try one of {some}")
    if image is None and len(model.cameras) != 1:
        raise ValueError(f"expected one camera in {path}, got {len(model.cameras)}; try --image with one of {some}")
    camera = next(iter(model.cameras.values())) if image is None else model.cameras[used[image]]
    return camera.model, *camera.size, camera.params


def _described(model: str, numbers: list[float]) -> tuple[Any, ...]:
    """With width and height there are two numbers more than the model has parameters."""
    from bpnp.cameras import camera_models

    count = dict(camera_models().values()).get(model)
    if count is not None and len(numbers) == count + 2:
        return model, *numbers[:2], numbers[2:]
    return model, numbers


def _npy(path: Path) -> Array:
    try:
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise ValueError(f"{type(array).__name__} of {getattr(array, 'dtype', 'no numbers')}")
        return array.astype(np.float64)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"expected an array of numbers in {path}, got {error}") from error


def _columns(path: Path) -> tuple[Array, list[str] | None]:
    """The numbers of a text, and the names of its columns if the first line has one for each."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise ValueError(f"expected text with numbers in {path}, got {error}") from error
    rows: list[list[float]] = []
    names: list[str] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        content = line.partition("#")[0].strip()
        if not content:
            continue
        separator = next((mark for mark in (",", ";") if mark in content), None)
        words = content.split(separator)
        try:
            row = [float(word) for word in words]
        except ValueError:
            if not rows and not any(_is_number(word) for word in words):
                names = [word.strip().lower() for word in words]
                continue
            raise ValueError(f"expected numbers in line {number} of {path}, got {line[:60]!r}") from None
        if rows and len(row) != len(rows[0]):
            raise ValueError(f"expected {len(rows[0])} numbers in line {number} of {path}, got {len(row)}")
        rows.append(row)
    if not rows:
        raise ValueError(f"expected lines of numbers in {path}, got none")
    return np.array(rows), names if names is not None and len(names) == len(rows[0]) else None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
