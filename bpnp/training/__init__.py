"""The LightningModule, its losses, and the callbacks of a training."""

from bpnp.training.callbacks import CompileNets, LearningRateSchedule, PoseLossWarmup, ResultsWriter, SafeCheckpointIO
from bpnp.training.monitors import FeatureSpread, OfflineWandbLogger, TrainingMonitor
from bpnp.training.task import BlindPnPTask

__all__ = [
    "BlindPnPTask", "CompileNets", "FeatureSpread", "LearningRateSchedule", "OfflineWandbLogger", "PoseLossWarmup",
    "ResultsWriter", "SafeCheckpointIO", "TrainingMonitor",
]  # fmt: skip
