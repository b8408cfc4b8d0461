"""Sources of problems: meshes and random scenes seen by virtual cameras, COLMAP models, the authors' files, a store."""

from typing import TYPE_CHECKING, Any

import lazy_loader

if TYPE_CHECKING:
    from bpnp.datamodules.augment import Outliers
    from bpnp.datamodules.authors import AuthorsDataModule
    from bpnp.datamodules.colmap.module import ColmapDataModule
    from bpnp.datamodules.loader import ProblemDataModule
    from bpnp.datamodules.meshes import MeshDataModule
    from bpnp.datamodules.problem import Problem, ProblemSource
    from bpnp.datamodules.stored import StoredDataModule, write_problems
    from bpnp.datamodules.synthetic_maps.maps import SyntheticMapDataModule

__all__ = [
    "AuthorsDataModule",
    "ColmapDataModule",
    "MeshDataModule",
    "Outliers",
    "Problem",
    "ProblemDataModule",
    "ProblemSource",
    "StoredDataModule",
    "SyntheticMapDataModule",
    "write_problems",
]

_find, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "augment": ["Outliers"],
        "authors": ["AuthorsDataModule"],
        "colmap.module": ["ColmapDataModule"],
        "meshes": ["MeshDataModule"],
        "loader": ["ProblemDataModule"],
        "problem": ["Problem", "ProblemSource"],
        "stored": ["StoredDataModule", "write_problems"],
        "synthetic_maps.maps": ["SyntheticMapDataModule"],
    },
)
# What YAML files of earlier versions call them.
RENAMED = {"PreprocessedDataModule": "AuthorsDataModule", "SfmSceneDataModule": "SyntheticMapDataModule"}


def __getattr__(name: str) -> Any:
    return _find(RENAMED.get(name, name))
