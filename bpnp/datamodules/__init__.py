"""Sources of pairs: meshes seen by virtual cameras, COLMAP models, and the pairs that others published."""

from bpnp.datamodules.batching import Pair, PairSource, pair_loader
from bpnp.datamodules.colmap import ColmapDataModule
from bpnp.datamodules.meshes import MeshDataModule
from bpnp.datamodules.outliers import Outliers
from bpnp.datamodules.preprocessed import PreprocessedDataModule

__all__ = [
    "ColmapDataModule",
    "MeshDataModule",
    "Outliers",
    "Pair",
    "PairSource",
    "PreprocessedDataModule",
    "pair_loader",
]
