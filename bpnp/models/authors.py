"""The weights of BPnPNet's authors (``*.pth.tar``), read into our network.

Source: Campbell, Liu, Gould, "Solving the Blind Perspective-n-Point Problem End-to-End with Robust Differentiable
Geometric Optimization", ECCV 2020; the names and shapes of the 185 tensors are those of its public code.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bpnp.layers.ransac import Backend, RansacPnP
from bpnp.models.bpnpnet import BPnPNet

# A checkpoint may hold its best error as a numpy scalar. The function that makes one has two names, by numpy's version.
_NUMPY_SCALAR = np.float64(0).__reduce__()[0]
_NUMPY_GLOBALS: list[Any] = [
    (_NUMPY_SCALAR, "numpy.core.multiarray.scalar"),
    (_NUMPY_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    *(type(np.dtype(kind)) for kind in ("f2", "f4", "f8", "i4", "i8", "?")),
]
# Our module names, as patterns, and theirs.
_THEIRS = {
    r"features(\d)d\.enter": r"FeatureExtractor\1d.conv_in.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_a": r"FeatureExtractor\1d.conv_\2.preconv.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_b": r"FeatureExtractor\1d.conv_\2.conv1.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_c": r"FeatureExtractor\1d.conv_\2.conv2.0",
    **{f"features3d.align.norms.{i}": f"stn.bn{i + 1}" for i in range(5)},
    **{f"features3d.align.linears.{i}": f"stn.conv{i + 1}" for i in range(3)},
    "features3d.align.linears.3": "stn.fc1",
    "features3d.align.linears.4": "stn.fc2",
    "features3d.align.out": "stn.fc3",
}


class TensorMap(NamedTuple):
    """One tensor of the authors' file: its shape there, and its name in BPnPNet."""

    shape: tuple[int, ...]
    ours: str


def tensor_maps() -> dict[str, TensorMap]:
    """The 185 tensors (1,992,841 parameters and the batch norms' buffers) by the authors' names.

    Their 1x1 convolutions (out, in, 1) are our linear maps (out, in). Both apply the input transform from the right,
    points @ T.
    """
    with torch.device("meta"):
        weights = BPnPNet().state_dict()
    maps = {}
    for ours, value in weights.items():
        module, _, kind = ours.rpartition(".")
        theirs = next(re.sub(old, new, module) for old, new in _THEIRS.items() if re.fullmatch(old, module))
        convolution = "conv" in theirs and kind == "weight"
        maps[f"{theirs}.{kind}"] = TensorMap((*value.shape, 1) if convolution else tuple(value.shape), ours)
    return maps


def load_authors_weights(path: str | Path, *, backend: Backend = "auto") -> BPnPNet:
    """The network of a ``*.pth.tar`` file in evaluation mode: the same assignment as the authors' for every problem.

    backend: of `bpnp.layers.RansacPnP`, which has no weights.
    Only tensors, plain containers and numbers are unpickled. Raises FileNotFoundError, or ValueError that names the
    file and, where one tensor is wrong (missing, unexpected, of another shape, not finite), its key.
    """
    file = Path(path)
    state = _read_state(file)
    maps = tensor_maps()
    problems = [f"no {key!r}" for key in maps.keys() - state.keys()]
    problems += [f"an unexpected {key!r}" for key in state.keys() - maps.keys()]
    for key in maps.keys() & state.keys():
        value = state[key]
        if not isinstance(value, Tensor):
            problems.append(f"{key!r} as a {type(value).__name__}, not a tensor")
        elif tuple(value.shape) != maps[key].shape:
            problems.append(f"{key!r} of shape {tuple(value.shape)}, not {maps[key].shape}")
        elif not value.isfinite().all():
            problems.append(f"{key!r} with NaN or infinity")
    if problems:
        more = f" and {len(problems) - 3} more problems" if len(problems) > 3 else ""
        raise ValueError(
            f"expected the {len(maps)} tensors of the authors' BPnPNet in {file}, got "
            f"{'; '.join(sorted(problems)[:3])}{more}; try the authors' file as it was downloaded"
        )
    net = BPnPNet(ransac=RansacPnP(backend=backend))
    shapes = {name: value.shape for name, value in net.state_dict().items()}
    net.load_state_dict({m.ours: state[key].reshape(shapes[m.ours]) for key, m in maps.items()})
    return net.eval()


def _read_state(file: Path) -> Mapping[str, Any]:
    """The `state_dict` of a checkpoint of either of torch's file formats."""
    if not file.is_file():
        raise FileNotFoundError(f"expected the authors' weights, got no file at {file}; try its path")
    try:
        with torch.serialization.safe_globals(_NUMPY_GLOBALS):
            content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        refused = re.search(r"GLOBAL (\S+)", str(error))
        reason = f"{refused[1]} in it" if refused else f"{type(error).__name__} while reading"
        raise ValueError(
            f"expected a checkpoint of tensors, numbers and plain containers, got {reason} {file}; try downloading it "
            "again"
        ) from error
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, Mapping):
        found = ", ".join(map(repr, list(content)[:6])) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"expected a dict with `state_dict` in {file}, got {found or 'an empty one'}")
    # DataParallel puts this before every name
    return {str(key).removeprefix("module."): value for key, value in state.items()}
