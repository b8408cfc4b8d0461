"""How the weights of the package are made of a checkpoint: `python examples/pack_weights.py CHECKPOINT OUT`."""

import sys
from pathlib import Path

import torch

from bpnp.files import write_atomically
from bpnp.models.weights import PREFIX, read_checkpoint

PACKED = ("solver", "epoch", "global_step", "pytorch-lightning_version")  # the last three for `bpnp test --ckpt_path`


def pack(checkpoint: str | Path, out: str | Path) -> None:
    """A checkpoint of `bpnp fit` with nothing but the net and its settings, in half precision: what the package holds.

    `TrainedNet.from_checkpoint` and ``bpnp test --ckpt_path`` read it like any other. Raises ValueError for weights
    beyond float16's range.
    """
    content = read_checkpoint(checkpoint)
    state = {key: value for key, value in content["state_dict"].items() if key.startswith(PREFIX)}
    for key, value in state.items():
        state[key] = value.half() if value.is_floating_point() else value
        if not state[key].isfinite().all():
            raise ValueError(f"expected weights within float16's range, got others in {key} of {checkpoint}")
    with write_atomically(Path(out)) as temporary, temporary.open("wb") as file:  # a path would be part of the file
        torch.save({key: content[key] for key in PACKED if key in content} | {"state_dict": state}, file)


if __name__ == "__main__":
    pack(*sys.argv[1:])
