"""Differentiable Sinkhorn and weighted PnP layers, and RANSAC for the initial pose.

Each is a function of tensors and a module around it. All return their results and per-sample `SolveStats`.
"""

from bpnp.layers.assignment import Sinkhorn, sinkhorn
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.pnp import WeightedPnP, weighted_pnp
from bpnp.layers.ransac.layer import RansacPnP, ransac_pnp

__all__ = ["BackwardStats", "RansacPnP", "Sinkhorn", "WeightedPnP", "ransac_pnp", "sinkhorn", "weighted_pnp"]
