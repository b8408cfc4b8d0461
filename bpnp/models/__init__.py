"""Solvers: modules that map a `Batch` to a `Prediction`."""

from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.evaluation import Refinement, Search
from bpnp.models.matcher import Matcher
from bpnp.models.weights import TrainedNet

__all__ = ["BPnPNet", "Matcher", "Refinement", "Search", "TrainedNet"]
