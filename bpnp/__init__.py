"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bpnp.maps.scene_map import SceneMap
    from bpnp.models.bpnpnet import BPnPNet
    from bpnp.models.matcher import Matcher
    from bpnp.search.starts import GravityPrior, PosePrior
    from bpnp.solving.solution import Solution
    from bpnp.solving.solve import solve, solve_many
    from bpnp.types import Batch, Pose, Prediction, SolveStats

__all__ = [
    "BPnPNet", "Batch", "GravityPrior", "Matcher", "Pose", "PosePrior", "Prediction", "SceneMap", "Solution",
    "SolveStats", "solve", "solve_many",
]  # fmt: skip

_MODULES = {
    "bpnp.maps.scene_map": ("SceneMap",),
    "bpnp.models.bpnpnet": ("BPnPNet",),
    "bpnp.models.matcher": ("Matcher",),
    "bpnp.search.starts": ("GravityPrior", "PosePrior"),
    "bpnp.solving.solution": ("Solution",),
    "bpnp.solving.solve": ("solve", "solve_many"),
    "bpnp.types": ("Batch", "Pose", "Prediction", "SolveStats"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A public name at its first use, so that solving two arrays imports neither the networks nor Lightning."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


try:
    __version__ = version("bpnp")
except PackageNotFoundError:  # run from its source
    __version__ = "unknown"
