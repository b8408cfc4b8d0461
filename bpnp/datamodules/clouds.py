"""Point clouds: one file for each shape, or ModelNet40's HDF5 and `normal_resampled` archives."""

import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.bounded_files import MOST_TEXT, check_size, file_inside, read_npy, read_text
from bpnp.datamodules.shapes import (
    SUFFIXES,
    MeshError,
    Sampler,
    Shapes,
    mesh_shapes,
    open_mesh,
    parse_cloud,
    shape_files,
    training_meshes_first,
)
from bpnp.files import file_states, fingerprint, name_bytes, read_lines

TEXTS = (".txt", ".xyz")
CLOUD_SUFFIXES = (".npy", *TEXTS)
LAYOUT = f"<class>/{{train,test}}/*.{{{','.join(suffix[1:] for suffix in (*SUFFIXES, *CLOUD_SUFFIXES))}}}"
SPLITS = ("train", "test")


def read_cloud(path: Path) -> NDArray[np.float64]:
    """Read the points (k, 3) of a point cloud file.

    It is .ply without faces; .npy with an array (k, 3) or wider; .xyz or .txt with numbers separated by spaces, tabs or
    commas. Columns after the third (normals, colours) are ignored, `#` starts a comment. Raise MeshError, which names
    the file, if it is empty, truncated or holds something else.
    """
    if path.suffix.lower() == ".ply":
        with open_mesh(path) as (content, suffix):
            points, _ = parse_cloud(content, suffix)
        return _check_cloud(points, path)
    try:
        if path.suffix.lower() == ".npy":
            values = read_npy(path)
        else:
            text = read_text(path)
            values = np.loadtxt(text.replace(",", " ").splitlines(), np.float64, ndmin=2)
    except Exception as error:
        raise MeshError(f"{path}: not a point cloud ({' '.join(str(error).split())})") from error
    return _check_cloud(values, path)


def _check_cloud(values: NDArray[Any], source: object) -> NDArray[np.float64]:
    if values.ndim != 2 or values.shape[1] < 3 or not len(values) or values.dtype.kind not in "fiu":
        raise MeshError(f"{source}: rows of x, y, z are needed, the file has {values.dtype} of shape {values.shape}")
    points = values[:, :3].astype(np.float64)
    if not np.isfinite(points).all():
        raise MeshError(f"{source}: a coordinate is NaN or infinite")
    return points


def is_cloud(path: Path) -> bool:
    """Return True if `read_cloud` reads the file: by its suffix, or for a .ply file without faces in its header."""
    suffix = path.suffix.lower()
    if suffix != ".ply":
        return suffix in CLOUD_SUFFIXES
    with path.open("rb") as file:
        header = file.read(65536).partition(b"end_header")[0]
    return not any(
        line.split()[:2] in ([b"element", b"face"], [b"element", b"tristrips"]) and line.split()[2:3] != [b"0"]
        for line in header.splitlines()
    )


def draw_points(points: NDArray[np.float64], count: int, name: str) -> NDArray[np.float64]:
    """Return `count` points of a cloud in a random order that depends only on its name; all points if it has fewer."""
    order = np.random.default_rng(zlib.crc32(name_bytes(name))).permutation(len(points))
    return points[order[:count]]


def open_shapes(source: Path) -> Shapes:
    """Find the shapes of a folder, named ``<class>/<split>/<stem>``, training shapes first.

    It has meshes or point clouds in ModelNet40's layout, <class>/{train,test}/*, or is a folder of such folders; or one
    of the two archives of ModelNet40's point clouds: `modelnet40_ply_hdf5_2048` (HDF5) and
    `modelnet40_normal_resampled` (text). A name has the suffix of the file where several files of a folder have one
    stem, and begins with the folder where several folders have shapes. Raise ValueError if the folder is missing or has
    no shape, and ImportError if it has HDF5 files and h5py is not installed.
    """
    if not source.is_dir():
        raise ValueError(f"{source} is not a folder; a folder with {LAYOUT} is needed (unpack the archive first)")
    if found := _shapes_in(source):
        return found
    folders = {path.name: _shapes_in(path) for path in sorted(source.iterdir()) if path.is_dir()}
    parts = {name: shapes for name, shapes in folders.items() if shapes is not None}
    if not parts:
        raise ValueError(f"{source} has no shapes; a folder with {LAYOUT} is needed")
    if len(parts) == 1:
        return next(iter(parts.values()))
    samplers = {f"{folder}/{name}": make for folder, shapes in parts.items() for name, make in shapes.samplers.items()}
    ordered = {name: samplers[name] for name in sorted(samplers, key=training_meshes_first)}
    return Shapes(ordered, fingerprint([[folder, shapes.identity] for folder, shapes in parts.items()]))


def _shapes_in(folder: Path) -> Shapes | None:
    """Find the shapes of one folder in any of the layouts of `open_shapes`; None if it has none."""
    if found := _hdf5_shapes(folder) or _read_shape_list(folder):
        return found
    files = shape_files(folder, (*SUFFIXES, *CLOUD_SUFFIXES))
    meshes = {name: path for name, path in files.items() if not is_cloud(path)}
    clouds = {name: partial(_cloud_samples, name, files[name]) for name in files.keys() - meshes.keys()}
    samplers = mesh_shapes(meshes) | clouds
    return Shapes({name: samplers[name] for name in files}, _identity(files)) if files else None


def _identity(files: Mapping[str, Path]) -> str:
    return fingerprint([list(files), file_states(files.values())])


def _cloud_samples(name: str, path: Path, count: int) -> NDArray[np.float64]:
    return draw_points(read_cloud(path), count, name)


def _read_shape_list(folder: Path) -> Shapes | None:
    """Find the shapes of `modelnet40_normal_resampled`: <class>/<name>.txt, and lists of the names in each split."""
    samplers: dict[str, Sampler] = {}
    files: dict[str, Path] = {}
    for split in SPLITS:
        lists = [folder / f"modelnet{size}_{split}.txt" for size in (40, 10)]
        names = next((read_lines(path) for path in lists if path.is_file()), [])
        for stem in sorted(names):
            label = stem.rpartition("_")[0]
            name, path = f"{label}/{split}/{stem}", file_inside(folder, f"{label}/{stem}.txt")
            if path is None:
                raise ValueError(f"the lists of {folder} name the shape {stem!r}, which leads out of the folder")
            files[name], samplers[name] = path, partial(_cloud_samples, name, path)
    present = [path for path in files.values() if path.is_file()]  # a missing one is left out, with a warning
    return Shapes(samplers, fingerprint([list(files), file_states(present)])) if present else None


def _hdf5_shapes(folder: Path) -> Shapes | None:
    """Find the shapes of `modelnet40_ply_hdf5_2048`: each file has `data` (shapes, 2048, 3) and `label` (shapes, 1)."""
    files = {split: sorted(folder.glob(f"*{split}*.h5")) for split in SPLITS}
    if not any(files.values()):
        return None
    h5py = _h5py(folder)
    class_list = folder / "shape_names.txt"
    classes = read_lines(class_list) if class_list.is_file() else []
    samplers: dict[str, Sampler] = {}
    for split, paths in files.items():
        for path in paths:
            try:
                with h5py.File(path, "r") as file:
                    check_size(f"{path}, label,", file["label"].shape, file["label"].dtype, MOST_TEXT)
                    labels, count = np.asarray(file["label"]).reshape(-1), len(file["data"])
            except (OSError, KeyError) as error:
                raise ValueError(f"{path} is not a file of ModelNet40's HDF5 archive ({error})") from error
            if len(labels) != count or labels.dtype.kind not in "iu" or labels.min(initial=0) < 0:
                raise ValueError(
                    f"{path} has {len(labels)} labels of type {labels.dtype} for {count} shapes; one class number from "
                    "0 for each shape is needed"
                )
            for row, label in enumerate(labels.tolist()):
                title = classes[label] if label < len(classes) else f"class{label:02d}"
                name = f"{title}/{split}/{path.stem}_{row:04d}"
                samplers[name] = partial(_hdf5_samples, name, path, row)
    every = {str(path): path for paths in files.values() for path in paths}
    return Shapes(samplers, _identity(every))


def _hdf5_samples(name: str, path: Path, row: int, count: int) -> NDArray[np.float64]:
    with _h5py(path).File(path, "r") as file:
        check_size(f"{path}, data,", file["data"].shape[1:], file["data"].dtype, MOST_TEXT)
        return draw_points(_check_cloud(np.asarray(file["data"][row]), f"{path}, shape {row}"), count, name)


def _h5py(needed_for: Path) -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f"h5py is needed to read {needed_for}; install it with `pip install h5py`") from error
    return h5py
