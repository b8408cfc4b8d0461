"""The methods that BPnPNet is compared with: each maps a `Batch` to a `Prediction`."""

from bpnp.models.baselines.gopac import GOPAC
from bpnp.models.baselines.gosma import GOSMA
from bpnp.models.baselines.hungarian import Hungarian
from bpnp.models.baselines.local_solver import SoftPOSIT
from bpnp.models.baselines.random_ransac import RandomRansac

__all__ = ["GOPAC", "GOSMA", "Hungarian", "RandomRansac", "SoftPOSIT"]
