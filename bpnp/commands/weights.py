"""`bpnp convert-weights`: the authors' weights as a checkpoint."""

from pathlib import Path
from typing import Any, Literal

from bpnp.commands.output import say
from bpnp.files import written_whole


def convert_weights(
    file: Path,
    out: Path,
    *,
    ransac: Literal["poselib", "opencv"] = "poselib",
    pnp: Literal["newton", "lbfgs"] = "newton",
) -> None:
    """Convert the weights of the authors of BPnPNet into a checkpoint of bpnp.

    The checkpoint is for `BPnPNet.from_checkpoint` and `bpnp test --ckpt_path`. Raises ValueError or OSError as
    `load_authors_weights` does, and leaves no file that is half written.

    Args:
        file: the authors' file, *.pth.tar.
        out: checkpoint to write, *.ckpt.
        ransac: backend of the RANSAC step; opencv is the paper's.
        pnp: solver of the weighted PnP; lbfgs is the paper's.
    """
    import lightning
    import torch

    from bpnp.models.authors import load_authors_weights
    from bpnp.training.task import BlindPnPTask

    task = BlindPnPTask(load_authors_weights(file, backend=ransac, method=pnp))
    checkpoint: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": lightning.__version__,
        "state_dict": task.state_dict(),
    }
    task.on_save_checkpoint(checkpoint)
    with written_whole(out) as temporary:
        torch.save(checkpoint, temporary)
    say(f"wrote {out}")
