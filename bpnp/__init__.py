"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from bpnp.maps.scene_map import SceneMap
    from bpnp.models.bpnpnet import BPnPNet
    from bpnp.models.matcher import Matcher
    from bpnp.search.starts import GravityPrior, PosePrior
    from bpnp.search.warm_up import warm_up
    from bpnp.solving.solution import Solution
    from bpnp.solving.solve import solve, solve_many
    from bpnp.solving.verify import verify
    from bpnp.types import Batch, Pose, Prediction, SolveStats

__all__ = [
    "BPnPNet",
    "Batch",
    "GravityPrior",
    "Matcher",
    "Pose",
    "PosePrior",
    "Prediction",
    "SceneMap",
    "Solution",
    "SolveStats",
    "solve",
    "solve_many",
    "verify",
    "warm_up",
]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "maps.scene_map": ["SceneMap"],
        "models.bpnpnet": ["BPnPNet"],
        "models.matcher": ["Matcher"],
        "search.starts": ["GravityPrior", "PosePrior"],
        "search.warm_up": ["warm_up"],
        "solving.solution": ["Solution"],
        "solving.solve": ["solve", "solve_many"],
        "solving.verify": ["verify"],
        "types": ["Batch", "Pose", "Prediction", "SolveStats"],
    },
)

try:
    __version__ = version("bpnp")
except PackageNotFoundError:  # run from its source
    __version__ = "unknown"
