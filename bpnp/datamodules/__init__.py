"""Data modules: meshes and point clouds, COLMAP models, the authors' files, synthetic maps, and a store of problems."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # exports are in __init__.pyi
