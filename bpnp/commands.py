"""The plain commands around data and weights: `bpnp convert-weights`."""

import argparse
import logging
import os
from pathlib import Path
from typing import Any

import lightning
import torch

from bpnp.models.released import load_released
from bpnp.task import BlindPnPTask

logger = logging.getLogger(__name__)


def convert_weights(arguments: list[str]) -> None:
    """`bpnp convert-weights FILE OUT`: the authors' ``*.pth.tar`` as a checkpoint of ours.

    OUT is for `BPnPNet.from_checkpoint` and ``bpnp test --ckpt_path``. Raises ValueError or OSError as `load_released`
    does, and leaves nothing half-written.
    """
    parser = argparse.ArgumentParser(
        prog="bpnp convert-weights",
        description="Turn the weights that the authors of BPnPNet released into a checkpoint of bpnp.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="the authors' file, *.pth.tar")
    parser.add_argument("out", type=Path, metavar="OUT", help="checkpoint to write, *.ckpt")
    parser.add_argument(
        "--ransac", choices=("poselib", "opencv"), default="poselib", help="opencv is the paper's (default: poselib)"
    )
    parser.add_argument(
        "--pnp", choices=("newton", "lbfgs"), default="newton", help="lbfgs is the paper's (default: newton)"
    )
    chosen = parser.parse_args(arguments)
    task = BlindPnPTask(load_released(chosen.file, ransac_backend=chosen.ransac, pnp_method=chosen.pnp))
    checkpoint: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": lightning.__version__,
        "state_dict": task.state_dict(),
    }
    task.on_save_checkpoint(checkpoint)
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    temporary = chosen.out.with_name(f".{chosen.out.name}.{os.getpid()}")
    try:
        torch.save(checkpoint, temporary)
        os.replace(temporary, chosen.out)
    finally:
        temporary.unlink(missing_ok=True)
    logger.info("wrote %s", chosen.out)
