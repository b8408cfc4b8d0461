"""The arguments of `solve_many`, one entry a pair. Every function raises ValueError for what is not usable."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from bpnp.cameras import Camera, camera_from


def source_from(solver: str | Path | nn.Module) -> nn.Module | None:
    """The module that solves, None for the search."""
    if isinstance(solver, nn.Module):
        return solver
    if solver == "search":
        return None
    from bpnp.models.weights import TrainedNet, pretrained_names  # the networks, where one is asked for

    path = Path(str(solver))
    if not isinstance(solver, (str, Path)) or not (path.suffix or path.is_file() or str(solver) in pretrained_names()):
        raise ValueError(
            f'expected `solver` "search", a module from Batch to Prediction, a checkpoint, or packaged weights '
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
