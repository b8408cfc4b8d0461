"""The LightningModule, its losses, and the callbacks of a training."""

from bpnp.training.callbacks import PoseLossWarmup, ResultsWriter, SafeCheckpointIO, TrainingMonitor
from bpnp.training.reprojection import ReprojectionLoss
from bpnp.training.task import BlindPnPTask

__all__ = [
    "BlindPnPTask",
    "PoseLossWarmup",
    "ReprojectionLoss",
    "ResultsWriter",
    "SafeCheckpointIO",
    "TrainingMonitor",
]
