"""What a user may say about the pose before it is solved."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from torch import nn

from bpnp.search.starts import GravityPrior, PosePrior

Prior = PosePrior | GravityPrior | nn.Module  # a TrainedNet
EXPECTED = "expected `prior` as PosePrior, GravityPrior, BPnPNet, Matcher, a checkpoint or 'learned'"


def checked_prior(given: Any) -> Prior | None:
    """A prior with its numbers as float64 arrays, or a net: itself, of a checkpoint, or "learned", the packaged one.

    Raises ValueError for anything else.
    """
    if given is None:
        return None
    if isinstance(given, (nn.Module, str, Path)):
        return _checked_net(given)
    if isinstance(given, PosePrior):
        rotation = _array("prior.rotation", given.rotation, (3, 3))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError(f"expected a rotation in `prior.rotation`, got {rotation.tolist()}")
        shift = None if given.translation is None else _array("prior.translation", given.translation, (3,))
        for name in ("rotation_sigma_deg", "translation_sigma"):
            if not getattr(given, name) > 0:
                raise ValueError(f"expected a positive `prior.{name}`, got {getattr(given, name)}")
        return given._replace(rotation=Rotation.from_matrix(rotation).as_matrix(), translation=shift)
    if isinstance(given, GravityPrior):
        camera = _array("prior.up_camera", given.up_camera, (3,))
        scene = _array("prior.up_scene", given.up_scene, (3,))
        if not (camera.any() and scene.any() and given.sigma_deg > 0):
            raise ValueError(f"expected directions and a positive sigma_deg in `prior`, got {given}")
        return GravityPrior(camera, scene, given.sigma_deg)
    raise ValueError(f"{EXPECTED}, got {given!r:.60}")


def _checked_net(given: nn.Module | str | Path) -> nn.Module:
    from bpnp.models.weights import LEARNED, TrainedNet  # where a network is asked for

    if isinstance(given, (str, Path)):
        learned = str(given) == "learned"
        return TrainedNet.from_pretrained(LEARNED) if learned else TrainedNet.from_checkpoint(given)
    if isinstance(given, TrainedNet):
        return given
    raise ValueError(f"{EXPECTED}, got {given!r:.60}")


def _array(name: str, values: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    array = np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite `{name}` of shape {shape}, got {array.tolist()}")
    return array
