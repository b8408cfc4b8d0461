"""The data sets as the authors of BPnPNet published them, pickles, converted once into a store of pairs.

``<dataset>_{train,test}/preprocessed/{p2d,p3d,R_gt,t_gt,W_gt,num_points_2d,num_points_3d}.pkl``, each a dict or a list
indexed by sample; or the form before that, ``<dataset>_{train,test}[/<scene>]/{matches,R,t}.pkl``, where a row of
`matches` (k, 5) is a 2D point and its 3D point. Points are normalised, camera = R p + t.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.pair import Pair
from bpnp.datamodules.prepare import Prepared, Recipe, prepare
from bpnp.datamodules.released.pickles import PickleError, load_pickle
from bpnp.datamodules.store import Store, StoreWriter
from bpnp.datamodules.stored_pairs import PAIRS, WIDTHS, add_pair, scene_rows
from bpnp.files import files_as_they_are, fingerprint
from bpnp.geometry import MIN_POINTS

SPLITS = ("train", "test")
PREPROCESSED = ("p2d", "p3d", "R_gt", "t_gt", "W_gt", "num_points_2d", "num_points_3d")
MATCHES = ("matches", "R", "t")
FOCAL = {"modelnet40": 800.0}  # pixels; for the others nothing is known
PROBED = 50  # samples that decide which side W_gt is indexed by
AGREEMENT = 0.1  # median distance of a projected 3D point to its 2D point, normalised


class SampleError(ValueError):
    """A sample that cannot be used."""


@dataclass(frozen=True)
class AuthorsPart:
    """The pickles of one folder."""

    scene: str  # train, test, or one of them and a scene
    folder: Path
    names: Sequence[str]

    @property
    def files(self) -> list[Path]:
        return [self.folder / f"{name}.pkl" for name in self.names]


def prepare_preprocessed(source: Path, output: Path, *, dataset: str | None = None) -> Prepared:
    """The authors' pickles below `source` (see `find_parts`) as a store with the scenes train and test.

    Samples that cannot be used are left out and listed. Raises ValueError, StoreError, OSError or PickleError: nothing
    to convert, a bad pickle, no usable sample, another `output`.
    """
    store = prepare(released_recipe(source, dataset), output)
    counts = {split: int(len(released_rows(store, split))) for split in SPLITS}
    return Prepared(output, counts, store.skipped)


def released_recipe(source: Path, dataset: str | None) -> Recipe:
    """How the store of the authors' files below `source` is made."""
    name, parts = find_parts(source, dataset)
    return Recipe(
        kind=PAIRS,
        widths=WIDTHS,
        parameters={"dataset": name, "source": fingerprint(files_as_they_are(f for part in parts for f in part.files))},
        jobs=[(part, FOCAL.get(name, 1.0)) for part in parts],
        work=convert_part,
        what="sample",
        source=str(source),
    )


def released_rows(store: Store, split: str) -> NDArray[np.int64]:
    """The pairs of a split's scenes, `train` or `train/...`."""
    rows = [rows for scene, rows in scene_rows(store).items() if scene.split("/")[0] == split]
    return np.sort(np.concatenate([*rows, np.empty(0, np.int64)]))


def find_parts(root: Path, dataset: str | None = None) -> tuple[str, list[AuthorsPart]]:
    """The name of the data set below `root` and its folders of pickles.

    Raises ValueError: nothing found, several data sets and no `dataset`, or a pickle of a folder missing.
    """
    if not root.is_dir():
        raise ValueError(f"expected a folder with <dataset>_train and <dataset>_test, got {root}, which is no folder")
    found = sorted({path.name.rpartition("_")[0] for split in SPLITS for path in root.glob(f"*_{split}")})
    if dataset is None and len(found) > 1:
        raise ValueError(f"expected one data set in {root}, got {', '.join(found)}; try --dataset {found[0]}")
    chosen = dataset or (found[0] if found else "")
    if chosen not in found or not chosen:
        raise ValueError(f"expected {dataset or '<dataset>'}_train and _test in {root}, got {found or 'none'}")
    parts = []
    for split in SPLITS:
        top = root / f"{chosen}_{split}"
        if (top / "preprocessed").is_dir():
            parts.append(AuthorsPart(split, top / "preprocessed", PREPROCESSED))
        elif (top / "matches.pkl").is_file():
            parts.append(AuthorsPart(split, top, MATCHES))
        else:
            folders = sorted(path.parent for path in top.glob("*/matches.pkl"))
            parts += [AuthorsPart(f"{split}/{folder.name}", folder, MATCHES) for folder in folders]
    if not parts:
        raise ValueError(f"expected preprocessed/*.pkl or matches.pkl in {root / chosen}_train and _test, got neither")
    missing = [str(file) for part in parts for file in part.files if not file.is_file()]
    if missing:
        raise ValueError(f"expected all pickles of {chosen}, got no {', '.join(missing[:4])}; try downloading it again")
    return chosen, parts


def convert_part(writer: StoreWriter, part: AuthorsPart, focal: float) -> None:
    """Write every sample of a folder, or the reason why it cannot be used.

    Copies that fill small sets up to 1000 points are dropped. W_gt may hold the 2D point of each 3D point or, as for
    Data61/2D3D, the 3D point of each 2D point: the one that agrees with the poses is taken. -1, or an index one past
    the end, is no point. Raises PickleError that names the file.
    """
    columns = {file.stem: _column(file) for file in part.files}
    keys = list(columns[part.names[0]])
    for name, column in columns.items():
        if column.keys() != set(keys):
            raise PickleError(
                f"expected the {len(keys)} samples of {part.names[0]}.pkl in {part.folder / name}.pkl too, got "
                f"{len(column)} or others"
            )
    samples = {f"{part.scene}/{key:06d}": {name: column[key] for name, column in columns.items()} for key in keys}
    by_2d = part.names == PREPROCESSED and _indexed_by_2d(part, list(samples.values())[:PROBED])
    for name, sample in samples.items():
        try:
            add_pair(writer, part.scene, _pair(name, sample, by_2d=by_2d, focal=focal))
        except SampleError as error:
            writer.skipped[name] = str(error)


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


def _indexed_by_2d(part: AuthorsPart, samples: Sequence[Mapping[str, Any]]) -> bool:
    """Whether W_gt is an m-vector: which reading projects the 3D points nearer to their 2D points."""
    errors: dict[bool, list[float]] = {False: [], True: []}
    for sample in samples:
        for by_2d, found in errors.items():
            try:
                pair = _pair("", sample, by_2d=by_2d, focal=1.0)
            except SampleError:
                found.append(np.inf)
                continue
            camera = pair.points3d[: pair.matched] @ pair.rotation.T + pair.translation
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = camera[:, :2] / camera[:, 2:] - pair.points2d[: pair.matched]
            found.append(float(np.median(np.linalg.norm(np.nan_to_num(distance, nan=np.inf), axis=-1))))
    direct, inverse = (float(np.median(errors[by_2d])) for by_2d in (False, True))
    if AGREEMENT < min(direct, inverse) < np.inf:
        raise PickleError(
            f"expected the poses in {part.folder} to project 3D points onto their 2D points, got a median distance of "
            f"{min(direct, inverse):.3g}; try normalised 2D points and poses with camera = R p + t"
        )
    return inverse < direct


def _pair(name: str, sample: Mapping[str, Any], *, by_2d: bool, focal: float) -> Pair:
    if "matches" in sample:
        matches = _numbers(sample["matches"], "matches", 5)
        points2d, points3d, match3d = matches[:, :2], matches[:, 2:], np.arange(len(matches))
        rotation, translation = sample["R"], sample["t"]
    else:
        points2d = _numbers(sample["p2d"], "p2d", 2)[: _count(sample["num_points_2d"])]
        points3d = _numbers(sample["p3d"], "p3d", 3)[: _count(sample["num_points_3d"])]
        rotation, translation = sample["R_gt"], sample["t_gt"]
        match3d = _match3d(sample["W_gt"], len(points2d), len(points3d), by_2d=by_2d)
    rotation, translation = _numbers(rotation, "R", 3), np.asarray(translation, np.float64).reshape(-1)
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise SampleError("expected a rotation matrix, got another matrix")
    if np.linalg.det(rotation) < 0 or translation.shape != (3,) or not np.isfinite(translation).all():
        raise SampleError("expected a rotation and a finite translation, got a reflection or something else")
    _, first = np.unique(match3d, return_index=True)  # of several 3D points that were seen as one 2D point
    once = np.full_like(match3d, -1)
    once[first] = match3d[first]
    if (once >= 0).sum() < MIN_POINTS:
        raise SampleError(f"expected {MIN_POINTS} or more true pairs, got {(once >= 0).sum()}")
    return Pair.from_matches(name, points2d, points3d, rotation, translation, once, focal)


def _numbers(value: Any, name: str, width: int) -> NDArray[np.float64]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise SampleError(f"expected numbers in {name}, got something else") from error
    if array.ndim != 2 or array.shape[1] != width or not len(array) or not np.isfinite(array).all():
        raise SampleError(f"expected finite {name} of shape (k, {width}), got {array.shape} or NaN")
    return array


def _count(value: Any) -> int:
    return int(np.asarray(value).reshape(-1)[0])


def _match3d(value: Any, m: int, n: int, *, by_2d: bool) -> NDArray[np.int64]:
    """The 2D point of each 3D point, -1 for none, from W_gt and its tiled copies."""
    length, other = (m, n) if by_2d else (n, m)
    index = np.asarray(value).reshape(-1)[:length]
    if len(index) < length or not np.issubdtype(index.dtype, np.number):
        raise SampleError(f"expected {length} indices in W_gt, got {len(index)}")
    if not ((index >= -1) & (index <= other) & (index % 1 == 0)).all():
        raise SampleError(f"expected W_gt as integers between -1 and {other}, got {index.min()} to {index.max()}")
    index = np.where(index == other, -1, index.astype(np.int64))
    if not by_2d:
        return index
    match3d = np.full(n, -1)
    match3d[index[index >= 0]] = np.flatnonzero(index >= 0)
    return match3d
