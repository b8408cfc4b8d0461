"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from bpnp.models import BPnPNet, Matcher
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve, solve_many
from bpnp.types import Batch, Pose, Prediction, SolveStats

__all__ = [
    "BPnPNet", "Batch", "GravityPrior", "Matcher", "Pose", "PosePrior", "Prediction", "Solution", "SolveStats",
    "solve", "solve_many",
]  # fmt: skip
