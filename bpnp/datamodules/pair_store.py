"""Pairs of point sets of any size, packed into a few memory-mapped files: 50,000 of them open at once."""

import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.loader import Pair
from bpnp.datamodules.manifest import StoreError, new_store, read_manifest, write_manifest

KIND = "pairs"
RECORD = np.dtype(
    [
        ("start2d", "<i8"),
        ("start3d", "<i8"),
        ("count2d", "<i4"),
        ("count3d", "<i4"),
        ("matched", "<i4"),
        ("scene", "<i4"),
        ("name_start", "<i8"),
        ("name_size", "<i4"),
        ("crc32", "<u4"),
        ("focal", "<f8"),
        ("rotation", "<f8", (3, 3)),
        ("translation", "<f8", 3),
        ("origin", "<f8", 3),
    ]
)


class PairStore:
    """Random access to the pairs that `write_pairs` packed into `folder`.

    scenes: names of the scenes. scene (k,): position of each pair's scene among them. count2d, count3d, matched (k,):
    2D points, 3D points, and 3D points with a 2D point, of each pair. parameters, skipped: what the manifest says about
    how the store was made. Sent to another process, a store goes as its path and is opened there.

    Opening compares the sizes of all files and the digests of the small ones; the points of a pair are compared with
    their checksum whenever it is read. Raises StoreError that names the folder, file or pair.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        manifest = read_manifest(self.folder, kind=KIND)
        self.parameters: dict[str, Any] = manifest["parameters"]
        self.skipped: dict[str, str] = manifest["skipped"]
        self.scenes: tuple[str, ...] = tuple(manifest["scenes"])
        self._index = np.fromfile(self.folder / "index.bin", RECORD)
        self._names = (self.folder / "names.bin").read_bytes()
        self._points2d = self._map("points2d.bin", np.dtype("<f4")).reshape(-1, 2)
        self._points3d = self._map("points3d.bin", np.dtype("<f4")).reshape(-1, 3)
        self._match3d = self._map("match3d.bin", np.dtype("<i4"))
        self.count2d, self.count3d = self._column("count2d"), self._column("count3d")
        self.matched, self.scene = self._column("matched"), self._column("scene")

    def __len__(self) -> int:
        return len(self._index)

    def __reduce__(self) -> tuple[type["PairStore"], tuple[Path]]:
        return PairStore, (self.folder,)

    def pair(self, index: int) -> Pair:
        """Pair `index`; its points are views of the mapped files. StoreError if they are not what was written."""
        record = self._index[index]
        two = slice(record["start2d"], record["start2d"] + record["count2d"])
        three = slice(record["start3d"], record["start3d"] + record["count3d"])
        points2d, points3d, match3d = self._points2d[two], self._points3d[three], self._match3d[three]
        name_start = record["name_start"]
        name = self._names[name_start : name_start + record["name_size"]].decode()
        if _checksum(points2d, points3d, match3d) != record["crc32"]:
            raise StoreError(
                f"expected the points of {name!r} as they were written, got other bytes in {self.folder}; try copying "
                "or preparing it again"
            )
        return Pair(
            name=name,
            points2d=points2d,
            points3d=points3d,
            rotation=record["rotation"],
            translation=record["translation"],
            match3d=match3d.astype(np.int64),
            focal=float(record["focal"]),
            origin=record["origin"],
        )

    def _map(self, name: str, dtype: np.dtype) -> NDArray[Any]:
        path = self.folder / name
        if path.stat().st_size == 0:  # nothing to map
            return np.empty(0, dtype)
        return np.asarray(np.memmap(path, dtype, mode="r"))  # still mapped, no subclass

    def _column(self, name: str) -> NDArray[np.int64]:
        return self._index[name].astype(np.int64)


def write_pairs(
    folder: Path,
    pairs: Iterable[tuple[str, Pair]],
    *,
    parameters: Mapping[str, Any],
    skipped: Mapping[str, str],
) -> None:
    """Pack (scene, pair) after (scene, pair) into the new `folder`, in constant memory; complete or not there at all.

    parameters: kept in the manifest, must be JSON. skipped: what could not be used, and why.
    Raises StoreError if the folder exists, ValueError for a pair whose arrays do not fit each other.
    """
    with new_store(folder) as unfinished:
        totals = Counter[str]()
        scenes: dict[str, int] = {}
        per_scene = Counter[str]()
        names = ("points2d.bin", "points3d.bin", "match3d.bin", "index.bin", "names.bin")
        files = [(unfinished / name).open("wb") for name in names]
        try:
            for scene, pair in pairs:
                _check(pair)
                arrays = (
                    np.ascontiguousarray(pair.points2d, "<f4"),
                    np.ascontiguousarray(pair.points3d, "<f4"),
                    np.ascontiguousarray(pair.match3d, "<i4"),
                )
                name = pair.name.encode()
                record = np.zeros((), RECORD)
                record["start2d"], record["count2d"] = totals["points2d"], len(arrays[0])
                record["start3d"], record["count3d"] = totals["points3d"], len(arrays[1])
                record["matched"] = (arrays[2] >= 0).sum()
                record["scene"] = scenes.setdefault(scene, len(scenes))
                record["name_start"], record["name_size"] = totals["name bytes"], len(name)
                record["crc32"] = _checksum(*arrays)
                record["focal"], record["rotation"] = pair.focal, pair.rotation
                record["translation"] = pair.translation
                record["origin"] = 0 if pair.origin is None else pair.origin
                for file, part in zip(files, (*(a.tobytes() for a in arrays), record.tobytes(), name), strict=True):
                    file.write(part)
                per_scene[scene] += 1
                totals.update(points2d=len(arrays[0]), points3d=len(arrays[1]), matched=int(record["matched"]))
                totals["name bytes"] += len(name)
        finally:
            for file in files:
                file.close()
        counts = {"pairs": per_scene.total(), **{k: v for k, v in totals.items() if k != "name bytes"}}
        content = {
            "kind": KIND,
            "counts": counts,
            "scenes": dict(per_scene),
            "skipped": dict(skipped),
            "parameters": dict(parameters),
        }
        write_manifest(unfinished, content, digested=("index.bin", "names.bin"))


def _check(pair: Pair) -> None:
    """What nobody would notice later: other shapes, indices that are no integers or no 2D points, NaN."""
    m, n, match = len(pair.points2d), len(pair.points3d), np.asarray(pair.match3d)
    shapes = np.shape(pair.points2d), np.shape(pair.points3d), match.shape
    if shapes != ((m, 2), (n, 3), (n,)):
        raise ValueError(
            f"expected `points2d` (m, 2), `points3d` (n, 3) and `match3d` (n,), got {shapes} in {pair.name!r}"
        )
    if not np.issubdtype(match.dtype, np.integer):
        raise ValueError(
            f"expected `match3d` as integers, indices of 2D points, got {match.dtype} in {pair.name!r}; try "
            ".astype(int)"
        )
    if n and not -1 <= match.min() <= match.max() < m:
        raise ValueError(
            f"expected `match3d` between -1 and {m - 1}, got {match.min()} to {match.max()} in {pair.name!r}"
        )
    numbers = (pair.points2d, pair.points3d, pair.rotation, pair.translation, pair.focal)
    if not all(np.isfinite(values).all() for values in numbers):
        raise ValueError(f"expected finite points, pose and focal, got NaN or infinity in {pair.name!r}")


def _checksum(points2d: NDArray[Any], points3d: NDArray[Any], match3d: NDArray[Any]) -> int:
    return zlib.crc32(match3d.data, zlib.crc32(points3d.data, zlib.crc32(points2d.data)))
