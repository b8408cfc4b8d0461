"""LightningModule, losses and callbacks of a training."""

from bpnp.training.callbacks import PoseLossWarmup, ResultsWriter, TrainingMonitor
from bpnp.training.chamfer import ChamferLoss
from bpnp.training.checkpoints import BestCheckpoint, SafeCheckpointIO
from bpnp.training.monte_carlo import MonteCarloPoseLoss
from bpnp.training.muon import Muon
from bpnp.training.pose_loss import PoseLoss
from bpnp.training.predictions import PredictionWriter
from bpnp.training.reprojection import ReprojectionLoss
from bpnp.training.task import BlindPnPTask

__all__ = [
    "BestCheckpoint",
    "BlindPnPTask",
    "ChamferLoss",
    "MonteCarloPoseLoss",
    "Muon",
    "PoseLoss",
    "PoseLossWarmup",
    "PredictionWriter",
    "ReprojectionLoss",
    "ResultsWriter",
    "SafeCheckpointIO",
    "TrainingMonitor",
]
