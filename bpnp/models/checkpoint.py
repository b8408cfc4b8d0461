"""Checkpoint files: read as data, never as code; matched with the solver that they are meant for."""

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

SHAPING = ("channels", "blocks", "batch_norm", "learn_mu")  # settings that the shapes of the weights depend on


def read_checkpoint(path: str | Path, *, map_location: Any = "cpu") -> dict[str, Any]:
    """Content of a checkpoint that `bpnp fit` wrote, restricted to tensors, numbers and plain containers.

    Raises FileNotFoundError if there is no such file, ValueError naming it if it is truncated, foreign or holds code.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(
            f"expected a checkpoint, got no file at {file}; try runs/<name>/checkpoints/last.ckpt"
        )  # fmt: skip
    try:
        content = torch.load(file, map_location=map_location, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError) as error:
        reason = str(error).splitlines()[0].split(". ")[0]
        raise ValueError(
            f"expected a checkpoint of `bpnp fit`, got a file that cannot be read: {file} ({reason})"
        ) from error
    if not isinstance(content, dict) or "state_dict" not in content:
        raise ValueError(f"expected a checkpoint of `bpnp fit`, got a file without a `state_dict`: {file}")
    return content


def check_solver(saved: Mapping[str, Any], name: str, settings: Mapping[str, Any]) -> None:
    """Raise ValueError, naming what differs, unless a checkpoint's solver has this class and these shapes."""
    if saved.get("class") != name:
        raise ValueError(f"expected a checkpoint of {name}, got one of {saved.get('class', 'another program')}")
    stored = saved.get("settings", {})
    differing = [k for k in SHAPING if k in settings and stored.get(k, settings[k]) != settings[k]]
    if differing:
        told = ", ".join(f"{k}={stored[k]}" for k in differing)
        raise ValueError(f"expected a checkpoint of the configured {name}, got one with {told}; try these settings")


def restored(path: str | Path, *classes: type[Any]) -> Any:
    """The network of a checkpoint that `bpnp fit` wrote, in evaluation mode: whichever of the classes it is of.

    Raises FileNotFoundError, or ValueError naming the file if it holds none of them.
    """
    content = read_checkpoint(path)
    solver = content.get("solver", {})
    known = {cls.__name__: cls for cls in classes}
    if solver.get("class") not in known:
        wanted = " or ".join(known)
        raise ValueError(f"expected a checkpoint of {wanted}, got {solver.get('class', 'another file')} in {path}")
    net = known[solver["class"]](**solver["settings"])
    prefix = "solver."
    state = {k.removeprefix(prefix): v for k, v in content["state_dict"].items() if k.startswith(prefix)}
    net.load_state_dict(state)
    return net.eval()
