"""The LightningModule, its losses, and the callbacks of a training."""

from bpnp.training.feature_spread import FeatureSpread
from bpnp.training.monitor import OfflineWandbLogger, TrainingMonitor
from bpnp.training.plugins import CompileNets, SafeCheckpointIO
from bpnp.training.results_writer import ResultsWriter
from bpnp.training.schedules import LearningRateSchedule, PoseLossWarmup
from bpnp.training.task import BlindPnPTask

__all__ = [
    "BlindPnPTask", "CompileNets", "FeatureSpread", "LearningRateSchedule", "OfflineWandbLogger", "PoseLossWarmup",
    "ResultsWriter", "SafeCheckpointIO", "TrainingMonitor",
]  # fmt: skip
