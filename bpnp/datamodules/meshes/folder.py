"""Surface samples of a folder of meshes in ModelNet40's layout."""

import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.meshes.pools import SurfacePools, open_pools
from bpnp.datamodules.meshes.surfaces import SUFFIXES, Normalisation, normalise, read_mesh, sample_surface

LAYOUT = f"<class>/{{train,test}}/*.{{{','.join(suffix[1:] for suffix in SUFFIXES)}}}"


def mesh_files(root: Path, split: str) -> list[Path]:
    """The meshes ``<root>/<class>/<split>/*.{off,...}``, sorted; hidden files are no meshes.

    Raises ValueError that names the folder if it is missing or has none.
    """
    if not root.is_dir():
        raise ValueError(f"expected a folder with {LAYOUT}, got {root}, which is no folder; try another `root`")
    found = (path for path in root.glob(f"*/{split}/*") if path.suffix.lower() in SUFFIXES)
    files = sorted(path for path in found if path.is_file() and not path.name.startswith("."))
    if not files:
        raise ValueError(f"expected meshes {LAYOUT} in {root}, got none for {split!r}; try another `root`")
    return files


def folder_pools(
    root: Path, split: str, *, pool_size: int, normalisation: Normalisation, cache_dir: Path
) -> SurfacePools:
    """Surface samples of the meshes of a split, each a function of its file alone, named ``<class>/<split>/<stem>``.

    Raises ValueError as `mesh_files` and `open_pools` do.
    """
    files = mesh_files(root, split)
    names = [path.relative_to(root).with_suffix("").as_posix() for path in files]

    def sample(i: int) -> NDArray[np.float64]:
        rng = np.random.default_rng(zlib.crc32(names[i].encode()))
        return normalise(sample_surface(read_mesh(files[i]), pool_size, rng), normalisation)

    stats = [(path.suffix, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return open_pools(
        cache_dir,
        label=f"{root.resolve().name}-{split}",
        inputs={"files": stats, "normalisation": normalisation},
        names=names,
        sample=sample,
        pool_size=pool_size,
    )
