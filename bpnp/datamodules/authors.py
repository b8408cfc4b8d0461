"""The data sets as the authors of BPnPNet published them, pickles, converted once into a store of problems.

``<dataset>_{train,test}/preprocessed/{p2d,p3d,R_gt,t_gt,W_gt,num_points_2d,num_points_3d}.pkl``, each a dict or a list
indexed by sample; or the form before that, ``<dataset>_{train,test}[/<scene>]/{matches,R,t}.pkl``, where a row of
`matches` (k, 5) is a 2D point and its 3D point. Points are normalised, camera = R p + t.
"""

import math
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.loader import hold_out
from bpnp.datamodules.problem import Problem
from bpnp.datamodules.store import Made, Recipe, Row, Store, is_store, open_or_prepare, open_store
from bpnp.datamodules.stored import PROBLEMS, WIDTHS, StoredDataModule, problem_row, scene_rows
from bpnp.files import file_states, fingerprint
from bpnp.poses import MIN_POINTS

PREPROCESSED = ("p2d", "p3d", "R_gt", "t_gt", "W_gt", "num_points_2d", "num_points_3d")
MATCHES = ("matches", "R", "t")
FOCAL = {"modelnet40": 800.0}  # pixels; for the others nothing is known
PROBED = 50  # samples that decide which side W_gt is indexed by
AGREEMENT = 0.1  # median distance of a projected 3D point to its 2D point, normalised


class AuthorsDataModule(StoredDataModule):
    """The problems that Campbell et al. (ECCV 2020) published, with their split; some are held out for validation.

    Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: folder that `bpnp prepare authors` made, or the authors' folder with <dataset>_{train,test} in it,
            which is then converted once into cache_dir.
        dataset: modelnet40, megadepth or data61_2d3d; none for the only one that is there.
        val_fraction: share of the training problems that is held out for validation, at random.
        cache_dir: where the authors' files are converted to; none for BPNP_CACHE, else the user's cache folder.
        options: those of `StoredDataModule`.
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
        """Convert in one process, for `setup` to open in all."""
        self._open()

    def _open(self) -> dict[str, Any]:
        """The rows of each part. The problems are opened once, and converted now if they are not."""
        if not hasattr(self, "store"):
            if is_store(self.root):
                self.store = open_store(self.root, PROBLEMS)
            else:
                recipe = authors_recipe(Path(self.root), self.dataset)
                self.store = open_or_prepare(recipe, str(recipe.parameters["dataset"]), self.cache_dir)
        rows = split_rows(self.store, "train")
        training, held_out = hold_out(len(rows), self.held_out, seed=self.seed)
        return {"train": rows[training], "val": rows[held_out], "test": split_rows(self.store, "test")}


def authors_recipe(source: Path, dataset: str | None) -> Recipe:
    """How the store of the authors' files below `source` is made, with the scenes train and test.

    Raises ValueError where there is nothing to convert, or several data sets; `prepare` PickleError for a bad file.
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
    """The problems of a split's scenes, `train` or `train/...`."""
    rows = [rows for scene, rows in scene_rows(store).items() if scene.split("/")[0] == split]
    return np.sort(np.concatenate([*rows, np.empty(0, np.int64)]))


def _find_parts(root: Path, dataset: str | None) -> tuple[str, list[tuple[str, list[Path]]]]:
    """The name of the data set below `root`, and of each scene its pickles."""
    if not root.is_dir():
        raise ValueError(f"expected a folder with <dataset>_train and <dataset>_test, got {root}, which is no folder")
    names = sorted({path.name.rpartition("_")[0] for split in ("train", "test") for path in root.glob(f"*_{split}")})
    if dataset is None and len(names) > 1:
        raise ValueError(f"expected one data set in {root}, got {', '.join(names)}; try --dataset {names[0]}")
    chosen = dataset or (names[0] if names else "")
    if chosen not in names or not chosen:
        raise ValueError(f"expected {dataset or '<dataset>'}_train and _test in {root}, got {names or 'none'}")
    parts = []
    for split in ("train", "test"):
        top = root / f"{chosen}_{split}"
        if (top / "preprocessed").is_dir():
            parts.append((split, [top / "preprocessed" / f"{name}.pkl" for name in PREPROCESSED]))
            continue
        for first in sorted([*top.glob("matches.pkl"), *top.glob("*/matches.pkl")]):
            scene = "/".join((split, *first.parent.relative_to(top).parts))
            parts.append((scene, [first.with_name(f"{name}.pkl") for name in MATCHES]))
    if not parts:
        raise ValueError(f"expected preprocessed/*.pkl or matches.pkl in {root / chosen}_train and _test, got neither")
    missing = [str(file) for _, files in parts for file in files if not file.is_file()]
    if missing:
        raise ValueError(f"expected all pickles of {chosen}, got no {', '.join(missing[:4])}; try downloading it again")
    return chosen, parts


def _convert(scene: str, files: Sequence[Path], focal: float) -> Made:
    """Every sample of a scene, or the reason why it cannot be used.

    Copies that fill small sets up to 1000 points are dropped. W_gt may hold the 2D point of each 3D point or, as for
    Data61/2D3D, the 3D point of each 2D point: the one that agrees with the poses is taken. -1, or an index one past
    the end, is no point. Raises PickleError that names the file.
    """
    columns = {file.stem: _column(file) for file in files}
    keys = list(next(iter(columns.values())))
    for file in files:
        if columns[file.stem].keys() != set(keys):
            raise PickleError(f"expected the {len(keys)} samples of {files[0].name} in {file} too, got others")
    samples = {f"{scene}/{key:06d}": {name: column[key] for name, column in columns.items()} for key in keys}
    by_2d = "W_gt" in columns and _index_by_2d(files[0].parent, list(samples.values())[:PROBED])
    rows: list[Row] = []
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
        raise PickleError(f"expected a dict or list indexed by sample in {file}, got a {type(content).__name__}")
    if not column:
        raise PickleError(f"expected at least one sample in {file}, got none")
    return column


def _index_by_2d(folder: Path, samples: Sequence[Mapping[str, Any]]) -> bool:
    """Whether W_gt is an m-vector: which reading projects the 3D points nearer to their 2D points."""
    direct, inverse = (float(np.median([_error(sample, by_2d) for sample in samples])) for by_2d in (False, True))
    if AGREEMENT < min(direct, inverse) < np.inf:
        raise PickleError(
            f"expected the poses in {folder} to project 3D points onto their 2D points, got a median distance of "
            f"{min(direct, inverse):.3g}; try normalised 2D points and poses with camera = R p + t"
        )
    return inverse < direct


def _error(sample: Mapping[str, Any], by_2d: bool) -> float:
    """Median distance of the projected 3D points to their 2D points."""
    try:
        problem = _problem("", sample, by_2d=by_2d, focal=1.0)
    except ValueError:
        return np.inf
    camera = problem.points3d[: problem.matched] @ problem.rotation.T + problem.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = camera[:, :2] / camera[:, 2:] - problem.points2d[: problem.matched]
    return float(np.median(np.linalg.norm(np.nan_to_num(offset, nan=np.inf), axis=-1)))


def _problem(name: str, sample: Mapping[str, Any], *, by_2d: bool, focal: float) -> Problem:
    """Raises ValueError for a sample that cannot be used."""
    if "matches" in sample:
        matches = _numbers(sample["matches"], "matches", 5)
        points2d, points3d, match3d = matches[:, :2], matches[:, 2:], np.arange(len(matches))
        rotation, translation = sample["R"], sample["t"]
    else:
        m, n = (int(np.asarray(sample[f"num_points_{d}d"]).reshape(-1)[0]) for d in (2, 3))
        points2d, points3d = _numbers(sample["p2d"], "p2d", 2)[:m], _numbers(sample["p3d"], "p3d", 3)[:n]
        match3d = _match3d(sample["W_gt"], len(points2d), len(points3d), by_2d=by_2d)
        rotation, translation = sample["R_gt"], sample["t_gt"]
    rotation, translation = _numbers(rotation, "R", 3), np.asarray(translation, np.float64).reshape(-1)
    proper = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not proper or np.linalg.det(rotation) < 0 or translation.shape != (3,):
        raise ValueError("expected a rotation and a translation, got another matrix, a reflection or something else")
    _, first = np.unique(match3d, return_index=True)  # of several 3D points that were seen as one 2D point
    once = np.full_like(match3d, -1)
    once[first] = match3d[first]
    if (once >= 0).sum() < MIN_POINTS:
        raise ValueError(f"expected {MIN_POINTS} or more matches, got {(once >= 0).sum()}")
    return Problem.from_matches(name, points2d, points3d, rotation, translation, once, focal)


def _numbers(value: Any, name: str, width: int) -> NDArray[np.float64]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected numbers in {name}, got something else") from error
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise ValueError(f"expected finite {name} of shape (k, {width}), got {array.shape} or NaN")
    return array


def _match3d(value: Any, m: int, n: int, *, by_2d: bool) -> NDArray[np.int64]:
    """The 2D point of each 3D point, -1 for none, from W_gt and its tiled copies."""
    length, other = (m, n) if by_2d else (n, m)
    index = np.asarray(value).reshape(-1)[:length]
    if len(index) < length or not np.issubdtype(index.dtype, np.number):
        raise ValueError(f"expected {length} indices in W_gt, got {len(index)}")
    if not ((index >= -1) & (index <= other) & (index % 1 == 0)).all():
        raise ValueError(f"expected W_gt as integers between -1 and {other}, got {index.min()} to {index.max()}")
    index = np.where(index == other, -1, index.astype(np.int64))
    if not by_2d:
        return index
    match3d = np.full(n, -1)
    match3d[index[index >= 0]] = np.flatnonzero(index >= 0)
    return match3d


class PickleError(ValueError):
    """A pickle that is broken or holds more than arrays, plain containers and numbers. The message names the file."""


def load_pickle(path: Path) -> Any:
    """The dict, list, tuple or array in a pickle of Python 2 or 3; nothing else in it is ever imported or called.

    Raises PickleError; OSError if the file cannot be read.
    """
    with path.open("rb") as file:
        try:
            content = _Unpickler(file, encoding="bytes").load()
            if not isinstance(content, (dict, list, tuple, np.ndarray)):
                raise pickle.UnpicklingError(f"a bare {type(content).__name__} is refused")
        except Exception as error:
            got = f"{path}: {error!r}; try the authors' file as it was downloaded"
            raise PickleError(f"expected a pickle of numpy arrays, plain containers and numbers, got {got}") from error
    return content


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}".replace("_core.", "").replace("core.", "").replace("__builtin__", "builtins")
        if full not in ALLOWED:
            raise pickle.UnpicklingError(f"{full} is refused")
        return ALLOWED[full].__call__  # a bound slot: can be called, not changed


class _Type:
    def __init__(self, text: Any, *_: Any) -> None:
        if type(text) not in (str, bytes) or np.dtype(text).kind not in "biufO":
            raise pickle.UnpicklingError(f"the array type {text!r} is refused")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])  # not the fields: they could lay pointers over numbers


class _Array(np.ndarray[Any, Any]):
    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        form, size = (list, 1) if kind.dtype.hasobject else (bytes, kind.dtype.itemsize)
        if min(shape, default=0) < 0 or not isinstance(content, form) or len(content) != math.prod(shape) * size:
            raise pickle.UnpicklingError(f"an array of shape {shape} made of a {type(content).__name__} is refused")
        super().__setstate__((1, shape, kind.dtype, fortran, content))


ALLOWED: dict[str, Any] = {
    "numpy.ndarray": lambda: None,  # what the next one is asked for
    "numpy.multiarray._reconstruct": lambda *_: np.ndarray.__new__(_Array, (0,)),
    "numpy.multiarray.scalar": lambda kind, content: np.frombuffer(content, kind.dtype).item(),
    "numpy.numeric._frombuffer": lambda a, kind, shape, order: np.frombuffer(a, kind.dtype).reshape(shape, order=order),
    "numpy.dtype": _Type,
    "_codecs.encode": lambda text, encoding: text.encode({"latin1": "latin1"}[encoding]),
    "builtins.bytes": lambda: b"",
    "builtins.set": set,
    "collections.OrderedDict": dict,
}
