"""Solvers: modules that map a `Batch` to a `Prediction`."""

from bpnp.models.batch_search import Search
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.knn_features import KnnFeatures
from bpnp.models.least_squares import LeastSquares
from bpnp.models.matcher import Matcher
from bpnp.models.refinement import Refinement
from bpnp.models.weights import TrainedNet

__all__ = ["BPnPNet", "KnnFeatures", "LeastSquares", "Matcher", "Refinement", "Search", "TrainedNet"]
