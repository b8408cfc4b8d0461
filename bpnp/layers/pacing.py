"""How long iterations run: on a CPU until every sample is done, on a GPU for a fixed number of masked steps.

Asking a GPU whether its samples are done makes the host wait for it, at every step, while finished samples cost nothing
there that would not be spent anyway.
"""

import torch
from jaxtyping import Bool
from torch import Tensor


def waits(device: torch.device) -> bool:
    """Whether reading a value from this device makes the host wait."""
    return device.type == "cuda"


def unfinished(active: Bool[Tensor, " b"]) -> bool:
    """Whether to take another step: while a sample is active, or always where asking would cost a wait."""
    return waits(active.device) or bool(active.any())


def steps(limit: int, device: torch.device, fixed: int) -> int:
    """The bound on the iterations: `limit`, and no more than `fixed` where none is left out."""
    return min(limit, fixed) if waits(device) else limit
