"""The LightningModule, its losses, and the callbacks of a training."""

from bpnp.training.callbacks import PoseLossWarmup, ResultsWriter, SafeCheckpointIO, TrainingMonitor
from bpnp.training.task import BlindPnPTask

__all__ = ["BlindPnPTask", "PoseLossWarmup", "ResultsWriter", "SafeCheckpointIO", "TrainingMonitor"]
