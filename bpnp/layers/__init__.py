"""Declarative layers: pure tensors in, tensors and per-sample stats out."""

from bpnp.layers.pnp import WeightedPnP, weighted_pnp
from bpnp.layers.ransac import RansacPnP, ransac_pnp
from bpnp.layers.refine import Refine, refine
from bpnp.layers.search import Candidates, Search, search, search_candidates
from bpnp.layers.sinkhorn import Sinkhorn, sinkhorn

__all__ = [
    "Candidates", "RansacPnP", "Refine", "Search", "Sinkhorn", "WeightedPnP",
    "ransac_pnp", "refine", "search", "search_candidates", "sinkhorn", "weighted_pnp",
]  # fmt: skip
