"""Data sets in the form in which the authors of BPnPNet published them (pickles), converted once into a store.

The files are ``<dataset>_{train,test}/preprocessed/{p2d,p3d,R_gt,t_gt,W_gt,num_points_2d,num_points_3d}.pkl``, each a
dict or a list indexed by sample; or the form before that, ``<dataset>_{train,test}[/<scene>]/{matches,R,t}.pkl``, where
a row of `matches` (k, 5) is a 2D point and its 3D point. Points are normalised, camera = R p + t.

In the form of Liu et al. (2020), ``<dataset>_{train,valid}/``, these rows are not matched: a row of `inlier_matches`
(i, 2) is the index of a 3D point and that of its 2D point, and `focal` has the focal lengths. A file
``<dataset>_split_SIFT.pkl`` in the same folder names the scenes of each split, and others are left out.
"""

import logging
import math
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.bounded_files import open_input
from bpnp.datamodules.loader import hold_out
from bpnp.datamodules.problem import Problem
from bpnp.datamodules.store import JobResult, Recipe, Store, StoreError, StoreRow, is_store, open_or_prepare, open_store
from bpnp.datamodules.stored import PROBLEMS, WIDTHS, StoredDataModule, problem_row, scene_rows
from bpnp.files import file_states, fingerprint
from bpnp.poses import MIN_POINTS

PREPROCESSED = ("p2d", "p3d", "R_gt", "t_gt", "W_gt", "num_points_2d", "num_points_3d")
MATCHES = ("matches", "R", "t")
MATCHES_OF_LIU = (*MATCHES, "inlier_matches", "focal")
SPLITS = {"train": ("train",), "test": ("test", "valid")}  # names of the folders of each split
SPLIT_KEYS = {"train": "train", "test": "val"}  # in <dataset>_split_SIFT.pkl
FOCAL = {"modelnet40": 800.0}  # pixels; unknown for the other data sets
PROBED = 50  # number of samples that decide which side indexes W_gt
logger = logging.getLogger(__name__)
AGREEMENT = 0.1  # largest median distance of a projected 3D point to its 2D point, normalised


class AuthorsDataModule(StoredDataModule):
    """Problems that Campbell et al. (ECCV 2020) published, with their split; some are held out for validation.

    Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: Folder that `bpnp prepare authors` made, or the authors' folder that holds <dataset>_{train,test} (those
            of Liu et al. 2020: _{train,valid}), which is converted once into cache_dir.
        dataset: "modelnet40", "megadepth" or "data61_2d3d"; None if the folder holds only one data set.
        val_fraction: Fraction of the training problems held out for validation, at random.
        cache_dir: Folder for the converted files; None for BPNP_CACHE, else the user's cache folder.
        **options: Options of `StoredDataModule` except those of the split: min_points, max_points, fresh_subsets,
            eval_max_points, clutter, clutter_side and rotate, and those of `ProblemDataModule`.
    """

    def __init__(
        self,
        root: str,
        *,
        dataset: str | None = None,
        val_fraction: float = 0.05,
        cache_dir: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(root, train_scenes=["train"], val_scenes=["val"], test_scenes=["test"], **options)
        self.dataset, self.cache_dir, self.held_out = dataset, cache_dir, val_fraction

    def prepare_data(self) -> None:
        """Convert the files in one process, before `setup` opens them in all."""
        self._open()

    def _open(self) -> dict[str, Any]:
        """Return the rows of each part. The problems are opened once, and converted if necessary."""
        if not hasattr(self, "store"):
            if is_store(self.root):
                self.store = open_store(self.root, PROBLEMS)
                if self.dataset not in (None, stored := self.store.parameters.get("dataset")):
                    raise StoreError(
                        f"`dataset` is {self.dataset}, but {self.root} was made of {stored}; leave it out, or prepare "
                        f"it again with --dataset {self.dataset}"
                    )
            else:
                recipe = authors_recipe(Path(self.root), self.dataset)
                self.store = open_or_prepare(recipe, str(recipe.parameters["dataset"]), self.cache_dir)
        rows = split_rows(self.store, "train")
        training = held_out = np.arange(0)
        if len(rows):  # not if only the test problems were downloaded
            training, held_out = hold_out(len(rows), self.held_out, seed=self.seed)
        return {"train": rows[training], "val": rows[held_out], "test": split_rows(self.store, "test")}


def authors_recipe(source: Path, dataset: str | None) -> Recipe:
    """Return the recipe of the store of the authors' files, with the scenes train and test.

    Without a name, the folder has one data set; else, or without data, raise ValueError. `prepare` raises PickleError
    for a bad file.
    """
    name, parts = _find_parts(source, dataset)
    files = [file for _, part in parts for file in part]
    return Recipe(
        kind=PROBLEMS,
        widths=WIDTHS,
        parameters={"dataset": name, "source": fingerprint(file_states(files))},
        jobs=[(scene, part, FOCAL.get(name, 1.0)) for scene, part in parts],
        work=_convert,
        what="sample",
        source=str(source),
    )


def split_rows(store: Store, split: str) -> NDArray[np.int64]:
    """Return the rows of a split, whose scenes are `train` or `train/...`."""
    rows = [rows for scene, rows in scene_rows(store).items() if scene.split("/")[0] == split]
    return np.sort(np.concatenate([*rows, np.empty(0, np.int64)]))


def _find_parts(root: Path, dataset: str | None) -> tuple[str, list[tuple[str, list[Path]]]]:
    """Return the name of the data set below `root`, and the scenes with their pickles."""
    if not root.is_dir():
        raise ValueError(f"{root} is no folder; give one that holds <dataset>_train and <dataset>_test")
    every = [ending for endings in SPLITS.values() for ending in endings]
    names = sorted({path.name.rpartition("_")[0] for ending in every for path in root.glob(f"*_{ending}/")})
    if dataset is None and len(names) > 1:
        raise ValueError(
            f"{root} holds several data sets: {', '.join(names)}; choose one, such as --dataset {names[0]}"
        )
    chosen = dataset or (names[0] if names else "")
    if chosen not in names or not chosen:
        raise ValueError(
            f"{root} has no {dataset or '<dataset>'}_train and _test; its data sets: {', '.join(names) or 'none'}"
        )
    parts: list[tuple[str, list[Path]]] = []
    for split, endings in SPLITS.items():
        tops = [top for ending in endings if (top := root / f"{chosen}_{ending}").is_dir()]
        if len(tops) > 1:
            raise ValueError(f"{tops[0]} and {tops[1]} both have test problems; move one of them elsewhere")
        for top in tops:
            if (top / "preprocessed").is_dir():
                parts.append((split, [top / "preprocessed" / f"{name}.pkl" for name in PREPROCESSED]))
            else:
                parts += _scenes(split, top, _listed_scenes(root, chosen, split))
    if not parts:
        raise ValueError(f"{root / chosen}_train and _test have neither preprocessed/*.pkl nor matches.pkl")
    missing = [str(file) for _, files in parts for file in files if not file.is_file()]
    if missing:
        raise ValueError(f"pickles of {chosen} are missing: {', '.join(missing[:4])}; download the data set again")
    return chosen, parts


def _scenes(split: str, top: Path, listed: set[str] | None) -> list[tuple[str, list[Path]]]:
    """Return the scenes of a split's folder with their pickles; with a list, only those that it names."""
    found = {first.parent.relative_to(top): first for first in [*top.glob("matches.pkl"), *top.glob("*/matches.pkl")]}
    if listed is not None:
        if absent := listed - {folder.name for folder in found}:
            logger.warning("%d of the %s scenes that the split lists have no pickles in %s", len(absent), split, top)
        found = {folder: first for folder, first in found.items() if folder.name in listed}
    parts = []
    for folder, first in sorted(found.items()):
        pickles = MATCHES_OF_LIU if first.with_name("inlier_matches.pkl").is_file() else MATCHES
        parts.append(("/".join((split, *folder.parts)), [first.with_name(f"{name}.pkl") for name in pickles]))
    return parts


def _listed_scenes(root: Path, dataset: str, split: str) -> set[str] | None:
    """Return the scenes of a split by the file of the data set, whose names end in .pkl; None without this file."""
    file = root / f"{dataset}_split_SIFT.pkl"
    if not file.is_file():
        return None
    content = load_pickle(file)
    key = SPLIT_KEYS[split]
    names = content.get(key, content.get(key.encode())) if isinstance(content, dict) else None  # bytes of Python 2
    if not isinstance(names, (list, tuple, np.ndarray)):
        raise PickleError(f"{file} has no list of names under {key!r}")
    return {Path(name.decode() if isinstance(name, bytes) else str(name)).stem for name in names}


def _convert(scene: str, files: Sequence[Path], focal: float) -> JobResult:
    """Convert every sample of a scene, or record why it cannot be used.

    Copies that pad small sets to 1000 points are dropped. W_gt may hold the 2D point of each 3D point or, as for
    Data61/2D3D, the 3D point of each 2D point; the reading that agrees with the poses is taken. -1, or an index one
    past the end, means no point.
    """
    columns = {file.stem: _column(file) for file in files}
    keys = list(next(iter(columns.values())))
    for file in files:
        if columns[file.stem].keys() != set(keys):
            raise PickleError(f"{file} has other samples than {files[0].name}, which has {len(keys)}")
    samples = {f"{scene}/{key:06d}": {name: column[key] for name, column in columns.items()} for key in keys}
    by_2d = "W_gt" in columns and _index_by_2d(files[0].parent, list(samples.values())[:PROBED])
    rows: list[StoreRow] = []
    skipped = {}
    for name, sample in samples.items():
        try:
            rows.append(problem_row(scene, _problem(name, sample, by_2d=by_2d, focal=focal)))
        except ValueError as error:
            skipped[name] = str(error)
    return rows, skipped


def _column(file: Path) -> dict[int, Any]:
    content = load_pickle(file)
    if isinstance(content, Mapping) and all(type(key) is int for key in content):
        column = dict(sorted(content.items()))
    elif isinstance(content, (list, tuple)) or (isinstance(content, np.ndarray) and content.ndim):
        column = dict(enumerate(content))
    else:
        raise PickleError(f"{file} holds a {type(content).__name__}, not a dict or list with an entry per sample")
    if not column:
        raise PickleError(f"{file} has no samples")
    return column


def _index_by_2d(folder: Path, samples: Sequence[Mapping[str, Any]]) -> bool:
    """Return True if W_gt is indexed by 2D point: the reading that projects the 3D points nearer to their 2D points."""
    direct, inverse = (float(np.median([_error(sample, by_2d) for sample in samples])) for by_2d in (False, True))
    if AGREEMENT < min(direct, inverse) < np.inf:
        raise PickleError(
            f"the poses in {folder} do not project 3D points onto their 2D points: the median distance is "
            f"{min(direct, inverse):.3g}. 2D points have to be normalised, and poses camera = R p + t"
        )
    return inverse < direct


def _error(sample: Mapping[str, Any], by_2d: bool) -> float:
    """Return the median distance of the projected 3D points to their 2D points."""
    try:
        problem = _problem("", sample, by_2d=by_2d, focal=1.0)
    except ValueError:
        return np.inf
    camera = problem.points3d[: problem.matched] @ problem.rotation.T + problem.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = camera[:, :2] / camera[:, 2:] - problem.points2d[: problem.matched]
    return float(np.median(np.linalg.norm(np.nan_to_num(offset, nan=np.inf), axis=-1)))


def _problem(name: str, sample: Mapping[str, Any], *, by_2d: bool, focal: float) -> Problem:
    """Convert one sample; raise ValueError if it cannot be used."""
    if "matches" in sample:
        matches = _numbers(sample["matches"], "matches", 5)
        points2d, points3d, match3d = matches[:, :2], matches[:, 2:], np.arange(len(matches))
        if "inlier_matches" in sample:
            match3d = _match3d_of_pairs(sample["inlier_matches"], len(matches))
        if "focal" in sample:
            focal = float(np.asarray(sample["focal"], np.float64).reshape(-1)[0])
        rotation, translation = sample["R"], sample["t"]
    else:
        m, n = (int(np.asarray(sample[f"num_points_{d}d"]).reshape(-1)[0]) for d in (2, 3))
        points2d, points3d = _numbers(sample["p2d"], "p2d", 2)[:m], _numbers(sample["p3d"], "p3d", 3)[:n]
        match3d = _match3d(sample["W_gt"], len(points2d), len(points3d), by_2d=by_2d)
        rotation, translation = sample["R_gt"], sample["t_gt"]
    rotation, translation = _numbers(rotation, "R", 3), np.asarray(translation, np.float64).reshape(-1)
    proper = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not proper or np.linalg.det(rotation) < 0 or translation.shape != (3,):
        raise ValueError("the pose is no rotation matrix and translation vector")
    _, first = np.unique(match3d, return_index=True)  # keep one of several 3D points with the same 2D point
    once = np.full_like(match3d, -1)
    once[first] = match3d[first]
    if (once >= 0).sum() < MIN_POINTS:
        raise ValueError(f"it has {(once >= 0).sum()} matches; at least {MIN_POINTS} are needed")
    return Problem.from_matches(name, points2d, points3d, rotation, translation, once, focal)


def _numbers(value: Any, name: str, width: int) -> NDArray[np.float64]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is no array of numbers") from error
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise ValueError(f"{name} of shape {array.shape} is unusable; finite numbers of shape (k, {width}) are needed")
    return array


def _match3d(value: Any, m: int, n: int, *, by_2d: bool) -> NDArray[np.int64]:
    """Return the 2D point of each 3D point, -1 for none, from W_gt and its tiled copies."""
    length, other = (m, n) if by_2d else (n, m)
    index = np.asarray(value).reshape(-1)[:length]
    if len(index) < length or not np.issubdtype(index.dtype, np.number):
        raise ValueError(f"W_gt has {len(index)} indices, not {length}")
    if not ((index >= -1) & (index <= other) & (index % 1 == 0)).all():
        raise ValueError(f"W_gt goes from {index.min()} to {index.max()}; its indices are integers from -1 to {other}")
    index = np.where(index == other, -1, index.astype(np.int64))
    if not by_2d:
        return index
    match3d = np.full(n, -1)
    match3d[index[index >= 0]] = np.flatnonzero(index >= 0)
    return match3d


def _match3d_of_pairs(value: Any, size: int) -> NDArray[np.int64]:
    """Return the 2D point of each 3D point, -1 for none, from rows of a 3D and a 2D index."""
    pairs = np.asarray(value)
    whole = pairs.ndim == 2 and pairs.shape[1] == 2 and np.issubdtype(pairs.dtype, np.number)
    if not whole or not ((pairs >= 0) & (pairs < size) & (pairs % 1 == 0)).all():
        raise ValueError(
            f"inlier_matches of shape {pairs.shape} is unusable; rows of two indices below {size} are needed"
        )
    match3d = np.full(size, -1)
    match3d[pairs[:, 0].astype(np.int64)] = pairs[:, 1].astype(np.int64)
    return match3d


class PickleError(ValueError):
    """Pickle that is broken, or holds more than arrays, plain containers and numbers. The message names the file."""


def load_pickle(path: Path) -> Any:
    """Read a dict, list, tuple or array from a pickle of Python 2 or 3; raise PickleError for other content.

    Nothing else in the pickle is imported or called.
    """
    with open_input(path, pipes=False) as file:
        try:
            content = _Unpickler(file, encoding="bytes").load()
            if not isinstance(content, (dict, list, tuple, np.ndarray)):
                raise pickle.UnpicklingError(f"a bare {type(content).__name__} is refused")
        except Exception as error:
            raise PickleError(
                f"{path}: {error!r}; only numpy arrays, plain containers and numbers are unpickled. Use the "
                "authors' original file"
            ) from error
    return content


class _Unpickler(pickle._Unpickler):  # in Python: the memo of that in C is as large as the largest index in the file
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}".replace("_core.", "").replace("core.", "").replace("__builtin__", "builtins")
        if full not in ALLOWED:
            raise pickle.UnpicklingError(f"{full} is refused")
        return ALLOWED[full].__call__  # a bound slot, which the pickle can call but not change


class _Type:
    def __init__(self, text: Any, *_: Any) -> None:
        if type(text) not in (str, bytes) or np.dtype(text).kind not in "biufO":
            raise pickle.UnpicklingError(f"the array type {text!r} is refused")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])  # only the byte order: fields could alias pointers and numbers


class _Array(np.ndarray[Any, Any]):
    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        form, size = (list, 1) if kind.dtype.hasobject else (bytes, kind.dtype.itemsize)
        if min(shape, default=0) < 0 or not isinstance(content, form) or len(content) != math.prod(shape) * size:
            raise pickle.UnpicklingError(f"an array of shape {shape} made of a {type(content).__name__} is refused")
        super().__setstate__((1, shape, kind.dtype, fortran, content))


ALLOWED: dict[str, Any] = {
    "numpy.ndarray": lambda: None,  # argument of _reconstruct
    "numpy.multiarray._reconstruct": lambda *_: np.ndarray.__new__(_Array, (0,)),
    "numpy.multiarray.scalar": lambda kind, content: np.frombuffer(content, kind.dtype).item(),
    "numpy.numeric._frombuffer": lambda a, kind, shape, order: np.frombuffer(a, kind.dtype).reshape(shape, order=order),
    "numpy.dtype": _Type,
    "_codecs.encode": lambda text, encoding: text.encode({"latin1": "latin1"}[encoding]),
    "builtins.bytes": lambda: b"",
    "builtins.set": set,
    "collections.OrderedDict": dict,
}
