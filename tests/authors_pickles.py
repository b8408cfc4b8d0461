"""Planted pairs in the layout of the authors' pickles."""

import os
import pickle
from pathlib import Path

import numpy as np
from planted import seen
from scipy.spatial.transform import Rotation

Sample = dict[str, np.ndarray]


class Exploit:
    """Run a command when unpickled."""

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, ("touch hacked",)


def sample(seed: int, *, tiled: int = 40) -> Sample:
    """A noise-free pair; 3D point j was seen as 2D point W_gt[j]; both sets are filled with copies up to `tiled`."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(5, tiled + 1))
    points3d = rng.normal(size=(count, 3))
    rotation, translation = Rotation.from_quat(rng.normal(size=4)).as_matrix(), np.array([0.1, 0.2, 8.0])
    w = rng.permutation(count)
    points2d = np.empty((count, 2))
    points2d[w] = seen(points3d, rotation, translation)
    copies = np.resize(np.arange(count), tiled)
    sizes = {"num_points_2d": np.array([count]), "num_points_3d": np.array([count])}
    return {"p2d": points2d[copies], "p3d": points3d[copies], "W_gt": w[copies], "R_gt": rotation} | {
        "t_gt": translation, **sizes
    }  # fmt: skip


def dump(folder: Path, samples: list[Sample], *, protocol: int = 4) -> None:
    folder.mkdir(parents=True)
    for name in samples[0]:
        values = [s[name] for s in samples]
        content = values if name in ("R_gt", "t_gt") else dict(enumerate(values))
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(content, protocol))


def write(root: Path, samples: list[Sample], dataset: str = "modelnet40") -> Path:
    for split in ("train", "test"):
        dump(root / f"{dataset}_{split}" / "preprocessed", samples)
    return root
