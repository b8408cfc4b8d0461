"""Index of a large map in the cache folder: one file with all that is computed when a COLMAP model is opened."""

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.bounded_files import read_npz
from bpnp.cameras import camera_from, camera_to_json
from bpnp.datamodules.colmap.model_files import FILES
from bpnp.files import cache_folder, file_states, fingerprint, lock_folder, write_atomically
from bpnp.maps.views import (
    DENSITY_CELLS,
    HALF_WIDTH,
    NARROW_SIGMA,
    REACH_FRACTION,
    VIEW_MARGIN_DEG,
    WIDE_SIGMA,
    Cones,
    Pictures,
    View,
)

FORMAT = 1  # version of the file [1; convention]
# Constants that the stored arrays depend on.
STORED_WITH = VIEW_MARGIN_DEG, DENSITY_CELLS, REACH_FRACTION, HALF_WIDTH, NARROW_SIGMA, WIDE_SIGMA


class Index(NamedTuple):
    """Parts of a `SceneMap`, with its density images and cones."""

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]
    pictures: Pictures
    cones: Cones


def model_stamp(folder: Path) -> str:
    """Return a fingerprint of the files of a model and of the constants of its index."""
    files = [folder / f"{name}.{suffix}" for name in FILES for suffix in ("bin", "txt")]
    model = file_states(file for file in files if file.is_file())
    return fingerprint([FORMAT, VIEW_MARGIN_DEG, *STORED_WITH, model])


def index_file(folder: Path) -> Path:
    """Return the index file of the model in a folder, in ``maps`` in `cache_folder`."""
    return cache_folder() / "maps" / fingerprint(str(folder.resolve())) / "index.npz"


def make_index(folder: Path, stamp: str, compute: Callable[[], Index]) -> Index:
    """Return the index of the model in a folder, and write it to the cache folder.

    One process computes it; others that open the same model wait. Nothing is written if the model has changed since
    `stamp`, its `model_stamp` from before it was read, or if the cache folder is not writable.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(index_file(folder).parent, wait=True))
        except (OSError, ValueError):
            return compute()
        index = read_index(folder)
        if index is None:
            index = compute()
            if stamp == model_stamp(folder):
                _write_index(folder, stamp, index)
        return index


def _write_index(folder: Path, stamp: str, index: Index) -> None:
    """Write the index of the model in a folder atomically; write nothing if that fails, such as on a full disk."""
    views = index.views
    cameras = list({id(view.camera): view.camera for view in views}.values())
    number = {id(camera): k for k, camera in enumerate(cameras)}
    texts = {"stamp": stamp, "cameras": json.dumps([camera_to_json(camera) for camera in cameras])}
    texts["names"] = json.dumps([view.name for view in views])
    arrays: dict[str, NDArray[Any]] = {name: np.frombuffer(text.encode(), np.uint8) for name, text in texts.items()}
    arrays |= index.pictures._asdict() | index.cones._asdict()
    arrays |= {"points3d": index.points3d, "point_ids": index.point_ids, "track_lengths": index.track_lengths}
    arrays |= {
        "rotations": np.stack([view.rotation for view in views]),
        "translations": np.stack([view.translation for view in views]),
        "camera": np.array([number[id(view.camera)] for view in views]),
        "seen": np.concatenate([view.points for view in views]),
        "counts": np.array([len(view.points) for view in views]),
    }
    try:
        with write_atomically(index_file(folder)) as temporary, temporary.open("wb") as file:
            np.savez(
                file,
                **arrays,  # type: ignore[arg-type]
            )
    except OSError:
        return


def read_index(folder: Path) -> Index | None:
    """Return the index of the model in a folder; None if there is none, or a damaged one, or if the model has changed.

    It is also None if the constants of the index have changed.
    """
    try:
        arrays = read_npz(index_file(folder))
        return _index_of(arrays) if arrays["stamp"].tobytes().decode() == model_stamp(folder) else None
    except Exception:  # noqa: BLE001 - zipfile and numpy have different errors for a damaged file; it is written again
        return None


def _index_of(arrays: Mapping[str, NDArray[Any]]) -> Index:
    cameras = [camera_from(plain) for plain in json.loads(arrays["cameras"].tobytes())]
    views = map(
        View,
        json.loads(arrays["names"].tobytes()),
        (cameras[k] for k in arrays["camera"].tolist()),
        arrays["rotations"],
        arrays["translations"],
        np.split(arrays["seen"], np.cumsum(arrays["counts"])[:-1]),
    )
    return Index(
        arrays["points3d"],
        arrays["point_ids"],
        arrays["track_lengths"],
        tuple(views),
        Pictures(arrays["contrasts"], arrays["reaches"]),
        Cones(arrays["axes"], arrays["cosines"]),
    )
