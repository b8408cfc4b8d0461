"""The weights that come with the package: found by name, without a download."""

from importlib import resources
from pathlib import Path
from typing import Any

import torch

from bpnp.files import written_whole
from bpnp.models.checkpoint import read_checkpoint

WEIGHTS = resources.files("bpnp") / "weights"
LEARNED = "procedural-so3"  # what `solve(prior="learned")` asks
KEPT = ("solver", "epoch", "global_step", "pytorch-lightning_version")  # the last three for `bpnp test --ckpt_path`


def pretrained_names() -> list[str]:
    """Names that `BPnPNet.from_pretrained` knows."""
    return sorted(file.name.removesuffix(".ckpt") for file in WEIGHTS.iterdir() if file.name.endswith(".ckpt"))


def pretrained_path(name: str) -> Path:
    """The checkpoint of packaged weights. Raises ValueError that lists the names there are."""
    if name not in pretrained_names():
        raise ValueError(
            f"expected the name of packaged weights, got {name!r}; try {', '.join(pretrained_names()) or 'training'}"
        )
    return Path(str(WEIGHTS / f"{name}.ckpt"))


def pack(checkpoint: str | Path, out: str | Path) -> None:
    """A checkpoint of `bpnp fit` with nothing but the net and its settings, in half precision: what the package holds.

    `BPnPNet.from_checkpoint` and ``bpnp test --ckpt_path`` read it like any other.

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
