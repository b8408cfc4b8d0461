"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from bpnp.models import BPnPNet, Matcher
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve, solve_many
from bpnp.types import Batch, Pose, Prediction, SolveStats

if TYPE_CHECKING:
    from bpnp.maps.scene_map import SceneMap

__all__ = [
    "BPnPNet", "Batch", "GravityPrior", "Matcher", "Pose", "PosePrior", "Prediction", "SceneMap", "Solution",
    "SolveStats", "solve", "solve_many",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """`SceneMap` at its first use: it reads COLMAP models, which imports Lightning."""
    if name == "SceneMap":
        from bpnp.maps.scene_map import SceneMap

        return SceneMap
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


try:
    __version__ = version("bpnp")
except PackageNotFoundError:  # run from its source
    __version__ = "unknown"
