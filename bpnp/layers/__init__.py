"""Declarative layers: pure tensors in, tensors and per-sample stats out."""

from bpnp.layers.pnp import WeightedPnP, weighted_pnp
from bpnp.layers.ransac import RansacPnP, ransac_pnp
from bpnp.layers.sinkhorn import Sinkhorn, sinkhorn

__all__ = ["RansacPnP", "Sinkhorn", "WeightedPnP", "ransac_pnp", "sinkhorn", "weighted_pnp"]
