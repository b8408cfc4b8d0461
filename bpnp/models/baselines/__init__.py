"""Baselines that BPnPNet is compared with; each maps a `Batch` to a `Prediction`."""

from bpnp.models.baselines.blind_p3p import RandomRansac
from bpnp.models.baselines.branch_and_bound import GOPAC
from bpnp.models.baselines.gosma import GOSMA
from bpnp.models.baselines.hungarian import Hungarian
from bpnp.models.baselines.softposit import SoftPOSIT

__all__ = ["GOPAC", "GOSMA", "Hungarian", "RandomRansac", "SoftPOSIT"]
