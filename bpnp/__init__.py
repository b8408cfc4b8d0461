"""Blind Perspective-n-Point: a camera's pose from 2D and 3D points that nobody has matched."""

from bpnp.models import BPnPNet
from bpnp.types import Batch, Pose, Prediction, SolveStats

__all__ = ["BPnPNet", "Batch", "Pose", "Prediction", "SolveStats"]
