"""The arguments of `solve_many`, one entry a pair. Every function raises ValueError for what is not usable."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from bpnp.cameras import Camera, camera_from
from bpnp.search.starts import GravityPrior, PosePrior

Prior = PosePrior | GravityPrior | nn.Module  # a TrainedNet
ROUNDING = 1e-12  # of R R^T: a rotation in float64; others are made orthonormal
EXPECTED = "expected `prior` as PosePrior, GravityPrior, BPnPNet, Matcher, a checkpoint or 'learned'"


def source_from(solver: str | Path | nn.Module) -> nn.Module | None:
    """The module that solves, None for the search, alone or not."""
    if isinstance(solver, nn.Module):
        return solver
    if isinstance(solver, str) and solver in ("auto", "search"):
        return None
    from bpnp.models.weights import TrainedNet, pretrained_names  # the networks, where one is asked for

    path = Path(str(solver))
    if not isinstance(solver, (str, Path)) or not (path.suffix or path.is_file() or str(solver) in pretrained_names()):
        raise ValueError(
            f'expected `solver` "auto", "search", a module from Batch to Prediction, a checkpoint, or packaged weights '
            f"({', '.join(pretrained_names())}), got {solver!r}"
        )
    return TrainedNet.from_checkpoint(solver)


def device_from(wanted: str | torch.device | None) -> torch.device | None:
    """The device that a user names, if it can be used."""
    if wanted is None:
        return None
    try:
        device = torch.device(wanted)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"expected a `device` of this machine, got {wanted}: {str(error).splitlines()[0]}") from error
    return device


def each_set(name: str, values: Any, size: int | None, axes: int = 2) -> list[Any]:
    """The arrays of the pairs, of `axes` axes each; one array is shared by all where their number is known.

    None, for what is not known of any pair, is shared too.
    """
    if size is not None and (values is None or getattr(values, "ndim", 0) == axes):
        return [values] * size
    wanted = f"expected `{name}` as a sequence of arrays, one a pair"
    if getattr(values, "ndim", axes + 1) != axes + 1:
        raise ValueError(f"{wanted}, got shape {tuple(values.shape)}")
    try:
        found = list(values)
    except TypeError as error:
        raise ValueError(f"{wanted}, got {values!r:.60}") from error
    if not found or (size is not None and len(found) != size):
        count = "one array a pair" if size is None else f"{size} arrays as in `points2d`"
        raise ValueError(f"expected {count} in `{name}`, got {len(found)}")
    return found


def each_of(name: str, given: Any, size: int) -> list[Any]:
    """A list has one each; anything else is for all."""
    if not isinstance(given, list):
        return [given] * size
    if len(given) != size:
        raise ValueError(f"expected {size} of `{name}`, one a pair, got {len(given)}")
    return given


def each_camera(given: Any, size: int) -> list[Camera | None]:
    """One camera for all, or a list or stack of them. A 3x3 matrix as a list of lists is one camera."""
    if getattr(given, "ndim", 2) == 3:
        given = list(given)
    elif isinstance(given, list) and given and not isinstance(given[0], tuple):
        rows = isinstance(given[0], str) or np.ndim(given[0]) == 1  # (model, parameters), or the rows of one matrix
        given = tuple(given) if rows else given
    return [None if one is None else camera_from(one) for one in each_of("camera", given, size)]


def checked_prior(given: Any) -> Prior | None:
    """A prior with its numbers as float64 arrays, or a net: itself, of a checkpoint, or "learned", the packaged one."""
    if given is None:
        return None
    if isinstance(given, (nn.Module, str, Path)):
        return _checked_net(given)
    if isinstance(given, PosePrior):
        rotation = _array("prior.rotation", given.rotation, (3, 3))
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if off > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError(f"expected a rotation in `prior.rotation`, got {rotation.tolist()}")
        shift = None if given.translation is None else _array("prior.translation", given.translation, (3,))
        for name in ("rotation_sigma_deg", "translation_sigma"):
            if not getattr(given, name) > 0:
                raise ValueError(f"expected a positive `prior.{name}`, got {getattr(given, name)}")
        if off > ROUNDING:
            rotation = Rotation.from_matrix(rotation).as_matrix()
        return given._replace(rotation=rotation, translation=shift)
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
