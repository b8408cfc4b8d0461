"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from importlib.metadata import PackageNotFoundError, version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # the names are in __init__.pyi

try:
    __version__ = version("bpnp")
except PackageNotFoundError:  # run from its source
    __version__ = "unknown"
