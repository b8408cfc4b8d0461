"""Data modules: meshes and point clouds, COLMAP models, the authors' files, synthetic maps, and a store of problems."""

from typing import Any

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # exports are in __init__.pyi
# Old names in YAML files of earlier versions.
RENAMED = {"PreprocessedDataModule": "AuthorsDataModule", "SfmSceneDataModule": "SyntheticMapDataModule"}


def __getattr__(name: str) -> Any:
    return _find(RENAMED.get(name, name))
