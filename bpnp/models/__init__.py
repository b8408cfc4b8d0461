"""Solvers: modules from a `Batch` to a `Prediction`."""

from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.evaluation import Refinement
from bpnp.models.matcher import Matcher
from bpnp.models.search_solver import Search
from bpnp.models.weights import TrainedNet

__all__ = ["BPnPNet", "Matcher", "Refinement", "Search", "TrainedNet"]
