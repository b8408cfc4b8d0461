"""A trained network from its checkpoint, whichever it is."""

from pathlib import Path

from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.checkpoint import restored
from bpnp.models.matcher import Matcher
from bpnp.models.pretrained import pretrained_path

TrainedNet = BPnPNet | Matcher


def load_network(path: str | Path) -> TrainedNet:
    """The BPnPNet or Matcher of a checkpoint that `bpnp fit` wrote, in evaluation mode.

    Raises FileNotFoundError, or ValueError naming the file if it holds neither.
    """
    net: TrainedNet = restored(path, BPnPNet, Matcher)
    return net


def load_pretrained(name: str) -> TrainedNet:
    """The network of weights that come with the package. Raises ValueError that lists the names for any other."""
    return load_network(pretrained_path(name))
