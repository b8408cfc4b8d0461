"""Sources of pairs: meshes and SfM-like scenes seen by virtual cameras, COLMAP models, and published pairs."""

from bpnp.datamodules.colmap.module import ColmapDataModule
from bpnp.datamodules.facades.module import SfmSceneDataModule
from bpnp.datamodules.loader import Pair, PairSource, pair_loader
from bpnp.datamodules.meshes.module import MeshDataModule
from bpnp.datamodules.outliers import Outliers
from bpnp.datamodules.released.module import PreprocessedDataModule

__all__ = [
    "ColmapDataModule",
    "MeshDataModule",
    "Outliers",
    "Pair",
    "PairSource",
    "PreprocessedDataModule",
    "SfmSceneDataModule",
    "pair_loader",
]
