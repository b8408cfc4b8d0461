"""Blind Perspective-n-Point: camera pose from 2D and 3D points without correspondences."""

from importlib.metadata import PackageNotFoundError, version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # exports are in __init__.pyi

try:
    __version__ = version("bpnp")
except PackageNotFoundError:  # run from source, not installed
    __version__ = "unknown"
