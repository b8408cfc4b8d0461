"""The weights that come with the package: found by name, without a download."""

from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from bpnp.files import written_whole
from bpnp.models.checkpoint import read_checkpoint, restored

WEIGHTS = resources.files("bpnp") / "weights"
LEARNED = "procedural-so3"  # what `solve(prior="learned")` asks
KEPT = ("solver", "epoch", "global_step", "pytorch-lightning_version")  # the last three for `bpnp test --ckpt_path`
Net = TypeVar("Net", bound=nn.Module)


def pretrained_names() -> list[str]:
    """Names that `Restorable.from_pretrained` knows."""
    return sorted(file.name.removesuffix(".ckpt") for file in WEIGHTS.iterdir() if file.name.endswith(".ckpt"))


def pretrained_path(name: str) -> Path:
    """The checkpoint of packaged weights. Raises ValueError that lists the names there are."""
    if name not in pretrained_names():
        raise ValueError(
            f"expected the name of packaged weights, got {name!r}; try {', '.join(pretrained_names()) or 'training'}"
        )
    return Path(str(WEIGHTS / f"{name}.ckpt"))


class Restorable(nn.Module):
    """A network that comes back from its checkpoint, in evaluation mode."""

    @classmethod
    def from_checkpoint(cls: type[Net], path: str | Path) -> Net:
        """The network of a checkpoint that `bpnp fit` wrote.

        Raises FileNotFoundError, or ValueError naming the file if it holds another network or none.
        """
        net: Net = restored(path, cls)
        return net

    @classmethod
    def from_pretrained(cls: type[Net], name: str) -> Net:
        """A network with weights of this package; `docs/model-card.md` has the names and what each can do.

        Raises ValueError that lists the names for any other. Nothing is downloaded.
        """
        net: Net = restored(pretrained_path(name), cls)
        return net


def pack(checkpoint: str | Path, out: str | Path) -> None:
    """A checkpoint of `bpnp fit` with nothing but the net and its settings, in half precision: what the package holds.

    `Restorable.from_checkpoint` and ``bpnp test --ckpt_path`` read it like any other.

    Weights beyond float16's range are a ValueError.
    """
    content = read_checkpoint(checkpoint)
    state: dict[str, Any] = {}
    for key, value in content["state_dict"].items():
        if key.startswith("solver."):
            state[key] = value.half() if value.is_floating_point() else value
            if not state[key].isfinite().all():
                raise ValueError(f"expected weights within float16's range, got others in {key} of {checkpoint}")
    with written_whole(Path(out)) as temporary:
        torch.save({key: content[key] for key in KEPT if key in content} | {"state_dict": state}, temporary)
