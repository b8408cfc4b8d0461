"""The packaged weights `paper-lc` and `paper-lclp`: the paper's training on drawn shapes, which have no data licence.

    python -m benchmarks paper_weights                 # hours; a run that was stopped goes on
    python -m benchmarks paper_weights --steps 5000    # a longer training goes on from a shorter one

The training is configs/paper/modelnet40.yaml but for data, steps and learning rate: 40,000 fixed problems of 4,000
drawn shapes. `paper-lclp` goes on from `paper-lc` with the pose loss.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from paper_tables import Training
from record import ROOT

from bpnp.files import write_atomically
from bpnp.models.weights import PREFIX, WEIGHTS, read_checkpoint

PACKED = ("solver", "epoch", "global_step", "pytorch-lightning_version")  # the last three for `bpnp test --ckpt_path`


def pack(checkpoint: Path, out: Path) -> None:
    """Write the network of a checkpoint and its settings in half precision.

    Raises:
        ValueError: A weight is beyond the range of float16.
    """
    content = read_checkpoint(checkpoint)
    state: dict[str, Any] = {}
    for key, value in content["state_dict"].items():
        if key.startswith(PREFIX):
            state[key] = value.half() if value.is_floating_point() else value
            if not state[key].isfinite().all():
                raise ValueError(f"{key} of {checkpoint} has weights beyond the range of float16")
    with write_atomically(out) as temporary, temporary.open("wb") as file:  # a path would become part of the file
        torch.save({key: content[key] for key in PACKED if key in content} | {"state_dict": state}, file)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--run", type=Path, default=ROOT / "runs" / "paper_weights", help="(default: %(default)s)")
    options.add_argument("--steps", type=int, default=3000, help="with L_c (default: %(default)s)")
    options.add_argument("--pose_steps", type=int, default=600, help="with L_c + L_p (default: %(default)s)")
    options.add_argument("--epoch", type=int, default=100, help="steps between checkpoints (default: %(default)s)")
    options.add_argument("--learning_rate", type=float, default=1e-4, help="the paper has 1e-5 (default: %(default)s)")
    options.add_argument("--output", type=Path, default=Path(str(WEIGHTS)), help="folder (default: the package's)")
    chosen = options.parse_args()
    arguments = (
        "--config=paper/modelnet40", "--data.root=null", "--data.train_shapes=4000", "--data.val_shapes=48",
        f"--model.learning_rate={chosen.learning_rate}",
    )  # fmt: skip
    first = Training(chosen.run / "lc", arguments, chosen.steps, chosen.epoch)
    posed = (*arguments, f"--pose_loss.start_epoch={chosen.steps // chosen.epoch}")
    end = chosen.steps + chosen.pose_steps
    second = Training(chosen.run / f"lclp-from{chosen.steps}", posed, end, chosen.epoch, first.checkpoint)
    for name, training in {"paper-lc": first, "paper-lclp": second}.items():
        pack(training.run(), chosen.output / f"{name}.ckpt")
        print(f"wrote {chosen.output / name}.ckpt", flush=True)
