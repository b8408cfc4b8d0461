"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from bpnp.api import solve, solve_many
from bpnp.layers.starts import GravityPrior, PosePrior
from bpnp.models import BPnPNet, Matcher
from bpnp.solving.solution import Solution
from bpnp.types import Batch, Pose, Prediction, SolveStats

__all__ = [
    "BPnPNet", "Batch", "GravityPrior", "Matcher", "Pose", "PosePrior", "Prediction", "Solution", "SolveStats",
    "solve", "solve_many",
]  # fmt: skip
