"""Sources of problems: meshes and random scenes seen by virtual cameras, COLMAP models, the authors' files, a store."""

from typing import Any

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # the names are in __init__.pyi
# What YAML files of earlier versions call them.
RENAMED = {"PreprocessedDataModule": "AuthorsDataModule", "SfmSceneDataModule": "SyntheticMapDataModule"}


def __getattr__(name: str) -> Any:
    return _find(RENAMED.get(name, name))
