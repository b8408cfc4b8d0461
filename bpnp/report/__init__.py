"""Results of a test on disk, on the terminal, as figures and as a page."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # exports are in __init__.pyi
