"""The methods that BPnPNet is compared with: each maps a `Batch` to a `Prediction`."""

from bpnp.models.baselines.branch_and_bound.gopac import GOPAC
from bpnp.models.baselines.branch_and_bound.gosma import GOSMA
from bpnp.models.baselines.constellation import Constellation
from bpnp.models.baselines.hungarian import Hungarian
from bpnp.models.baselines.random_ransac import RandomRansac
from bpnp.models.baselines.softposit import SoftPOSIT

__all__ = ["GOPAC", "GOSMA", "Constellation", "Hungarian", "RandomRansac", "SoftPOSIT"]
