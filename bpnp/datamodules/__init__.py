"""Sources of pairs: meshes and SfM-like scenes seen by virtual cameras, COLMAP models, and published pairs."""

from bpnp.datamodules.batching import Pair, PairSource, pair_loader
from bpnp.datamodules.colmap import ColmapDataModule
from bpnp.datamodules.meshes import MeshDataModule
from bpnp.datamodules.outliers import Outliers
from bpnp.datamodules.preprocessed import PreprocessedDataModule
from bpnp.datamodules.sfm_scene_module import SfmSceneDataModule

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
