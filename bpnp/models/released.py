"""The weights that the authors of BPnPNet released (``*.pth.tar``), read into our network.

Source: Campbell, Liu, Gould, "Solving the Blind Perspective-n-Point Problem End-to-End with Robust Differentiable
Geometric Optimization", ECCV 2020; the names and shapes of the 185 tensors are those of its public code.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bpnp.layers.pnp import Method, WeightedPnP
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


@dataclass(frozen=True)
class TensorMap:
    """One tensor of the authors' file: its shape there, its name in BPnPNet, and its shape here."""

    shape: tuple[int, ...]
    ours: str
    our_shape: tuple[int, ...]


def tensor_maps() -> dict[str, TensorMap]:
    """The 185 tensors (1,992,841 parameters and the batch norms' buffers) by the authors' names.

    Their 1x1 convolutions (out, in, 1) are our linear maps (out, in). In a block, `preconv`, `conv1` and `conv2` are
    our linear_a, linear_b and linear_c. Both apply the input transform from the right, points @ T.
    """
    return dict(_feature_maps(2)) | dict(_feature_maps(3)) | dict(_transform_maps())


def _linear(theirs: str, ours: str, out: int, into: int, *, conv: bool) -> Iterator[tuple[str, TensorMap]]:
    shape = (out, into, 1) if conv else (out, into)
    yield f"{theirs}.weight", TensorMap(shape, f"{ours}.weight", (out, into))
    yield f"{theirs}.bias", TensorMap((out,), f"{ours}.bias", (out,))


def _feature_maps(coordinates: int) -> Iterator[tuple[str, TensorMap]]:
    theirs, ours = f"FeatureExtractor{coordinates}d", f"features{coordinates}d"
    yield from _linear(f"{theirs}.conv_in.0", f"{ours}.enter", 128, coordinates, conv=True)
    for block in range(12):
        for layer, name in (("preconv", "linear_a"), ("conv1", "linear_b"), ("conv2", "linear_c")):
            yield from _linear(
                f"{theirs}.conv_{block}.{layer}.0", f"{ours}.blocks.{block}.{name}", 128, 128, conv=True
            )  # fmt: skip


def _transform_maps() -> Iterator[tuple[str, TensorMap]]:
    widths = (3, 64, 128, 1024, 512, 256)
    layers = ("conv1", "conv2", "conv3", "fc1", "fc2")
    for i, layer in enumerate(layers):
        ours, conv = f"features3d.align.linears.{i}", layer.startswith("conv")
        yield from _linear(f"stn.{layer}", ours, widths[i + 1], widths[i], conv=conv)
        for name in ("weight", "bias", "running_mean", "running_var"):
            shape = (widths[i + 1],)
            yield f"stn.bn{i + 1}.{name}", TensorMap(shape, f"features3d.align.norms.{i}.{name}", shape)
        yield f"stn.bn{i + 1}.num_batches_tracked", TensorMap((), f"features3d.align.norms.{i}.num_batches_tracked", ())
    yield from _linear("stn.fc3", "features3d.align.out", 9, 256, conv=False)


def load_released(path: str | Path, *, backend: Backend = "auto", method: Method = "newton") -> BPnPNet:
    """The network of a ``*.pth.tar`` file in evaluation mode: the same assignment as the authors' for every pair.

    backend, method: of `bpnp.layers.RansacPnP` and `bpnp.layers.WeightedPnP`, which have no weights.
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
            f"expected the {len(maps)} tensors of BPnPNet's released code in {file}, got "
            f"{'; '.join(sorted(problems)[:3])}{more}; try the authors' file as it was downloaded"
        )
    net = BPnPNet(ransac=RansacPnP(backend=backend), pnp=WeightedPnP(method=method))
    net.load_state_dict({m.ours: state[key].reshape(m.our_shape) for key, m in maps.items()})
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
