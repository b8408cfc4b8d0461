"""Sources of pairs: meshes seen by virtual cameras, and COLMAP models."""

from bpnp.datamodules.batching import Pair, PairSource, pair_loader
from bpnp.datamodules.colmap import ColmapDataModule
from bpnp.datamodules.meshes import MeshDataModule

__all__ = ["ColmapDataModule", "MeshDataModule", "Pair", "PairSource", "pair_loader"]
