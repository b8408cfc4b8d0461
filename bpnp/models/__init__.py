"""Solvers: modules from a `Batch` to a `Prediction`."""

from bpnp.models.bpnpnet import BPnPNet

__all__ = ["BPnPNet"]
