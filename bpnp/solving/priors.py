"""What a user may say about the pose before it is solved."""

from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch

from bpnp.models import TrainedNet, load_network, load_pretrained
from bpnp.models.pretrained import LEARNED
from bpnp.search.starts import GravityPrior, PosePrior

Prior = PosePrior | GravityPrior | TrainedNet


def checked_prior(given: Any) -> Prior | None:
    """A prior with its numbers as float64 tensors, or a net: itself, of a checkpoint, or "learned", the packaged one.

    Raises ValueError for anything else.
    """
    if given is None or isinstance(given, TrainedNet):
        return given
    if isinstance(given, (str, Path)):
        learned = str(given) == "learned"
        return load_pretrained(LEARNED) if learned else load_network(given)
    if isinstance(given, PosePrior):
        rotation = _tensor("prior.rotation", given.rotation, (3, 3))
        if (rotation @ rotation.mT - torch.eye(3)).abs().max() > 1e-3 or torch.linalg.det(rotation) < 0:
            raise ValueError(f"expected a rotation in `prior.rotation`, got {rotation.tolist()}")
        shift = None if given.translation is None else _tensor("prior.translation", given.translation, (3,))
        for name in ("rotation_sigma_deg", "translation_sigma"):
            if not getattr(given, name) > 0:
                raise ValueError(f"expected a positive `prior.{name}`, got {getattr(given, name)}")
        return given._replace(rotation=roma.special_procrustes(rotation), translation=shift)
    if isinstance(given, GravityPrior):
        camera = _tensor("prior.up_camera", given.up_camera, (3,))
        scene = _tensor("prior.up_scene", given.up_scene, (3,))
        if not (camera.norm() > 0 and scene.norm() > 0 and given.sigma_deg > 0):
            raise ValueError(f"expected directions and a positive sigma_deg in `prior`, got {given}")
        return GravityPrior(camera, scene, given.sigma_deg)
    raise ValueError(
        f"expected `prior` as PosePrior, GravityPrior, BPnPNet, Matcher, a checkpoint or 'learned', got {given!r:.60}"
    )


def _tensor(name: str, values: Any, shape: tuple[int, ...]) -> torch.Tensor:
    tensor = torch.as_tensor(np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, np.float64))
    if tensor.shape != shape or not tensor.isfinite().all():
        raise ValueError(f"expected finite `{name}` of shape {shape}, got {tensor.tolist()}")
    return tensor
