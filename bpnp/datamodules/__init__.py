"""Sources of pairs: meshes and SfM-like scenes seen by virtual cameras, COLMAP models, and published pairs."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from bpnp.datamodules.augment import Outliers
    from bpnp.datamodules.colmap.module import ColmapDataModule
    from bpnp.datamodules.meshes.module import MeshDataModule
    from bpnp.datamodules.module import PairDataModule
    from bpnp.datamodules.pair import Pair, PairSource
    from bpnp.datamodules.released.module import PreprocessedDataModule
    from bpnp.datamodules.stored_pairs import write_pairs
    from bpnp.datamodules.synthetic_maps.module import SfmSceneDataModule

__all__ = [
    "ColmapDataModule", "MeshDataModule", "Outliers", "Pair", "PairDataModule", "PairSource", "PreprocessedDataModule",
    "SfmSceneDataModule", "write_pairs",
]  # fmt: skip

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "augment": ["Outliers"],
        "colmap.module": ["ColmapDataModule"],
        "meshes.module": ["MeshDataModule"],
        "module": ["PairDataModule"],
        "pair": ["Pair", "PairSource"],
        "released.module": ["PreprocessedDataModule"],
        "stored_pairs": ["write_pairs"],
        "synthetic_maps.module": ["SfmSceneDataModule"],
    },
)
