"""The index of a large map in the cache folder: what opening a COLMAP model computes, in one file."""

import json
import zipfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import camera_from, camera_to_json
from bpnp.datamodules.colmap.model_files import FILES
from bpnp.files import cache_folder, file_states, fingerprint, lock_folder, write_atomically
from bpnp.maps.views import MARGIN_DEG, RANK, Array, Cones, Pictures, View

LARGE = 200_000  # points of a map from which on it has an index: smaller ones are opened in two seconds without
FORMAT = 1


class Index(NamedTuple):
    """The parts of a `SceneMap`, and what it computes of them when they are first asked for."""

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]
    pictures: Pictures
    cones: Cones


def _stamp(folder: Path) -> str:
    """Of the files of a model, and of the constants with which its index is computed."""
    files = [folder / f"{name}.{suffix}" for name in FILES for suffix in ("bin", "txt")]
    model = file_states(file for file in files if file.is_file())
    return fingerprint([FORMAT, MARGIN_DEG, repr(RANK), model])


def index_file(folder: Path) -> Path:
    """Return the file for the index of the model in a folder, in ``maps`` in `cache_folder`."""
    return cache_folder() / "maps" / fingerprint(str(folder.resolve())) / "index.npz"


def make_index(folder: Path, compute: Callable[[], Index]) -> Index:
    """Return the index of the model in a folder, and keep it.

    One process computes; others that open the same model wait for it. Where the cache folder cannot be written to,
    nothing is kept.

    Args:
        folder: COLMAP model.
        compute: Makes the index from the model.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(index_file(folder).parent, wait=True))
        except (OSError, ValueError):
            return compute()
        index = read_index(folder)
        if index is None:
            index = compute()
            _write_index(folder, index)
        return index


def _write_index(folder: Path, index: Index) -> None:
    """Write the index of the model in a folder whole; nothing where the disk is full."""
    views = index.views
    cameras = list({id(view.camera): view.camera for view in views}.values())
    number = {id(camera): k for k, camera in enumerate(cameras)}
    texts = {"stamp": _stamp(folder), "cameras": json.dumps([camera_to_json(camera) for camera in cameras])}
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
    """The index of the model in a folder; None if it has none, or one of other files or other constants."""
    try:
        with index_file(folder).open("rb") as opened, np.load(opened) as file:
            if file["stamp"].tobytes().decode() != _stamp(folder):
                return None
            arrays = dict(file)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
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
