"""Differentiable layers: pure tensors in, tensors and per-sample stats out; and the RANSAC that starts the last one."""

from bpnp.layers.assignment import Sinkhorn, sinkhorn
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.pnp import WeightedPnP, weighted_pnp
from bpnp.layers.ransac import RansacPnP, ransac_pnp

__all__ = ["BackwardStats", "RansacPnP", "Sinkhorn", "WeightedPnP", "ransac_pnp", "sinkhorn", "weighted_pnp"]
