"""Solvers: modules from a `Batch` to a `Prediction`."""

from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.loading import TrainedNet, load_network, load_pretrained
from bpnp.models.matcher import Matcher
from bpnp.models.search_solver import Search

__all__ = ["BPnPNet", "Matcher", "Search", "TrainedNet", "load_network", "load_pretrained"]
