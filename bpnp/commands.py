"""The plain commands around data and weights: `bpnp prepare` and `bpnp convert-weights`."""

import argparse
import logging
import math
import os
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
from rich.console import Console

from bpnp.datamodules.prepare import Prepared, prepare_colmap, prepare_meshes
from bpnp.datamodules.released.module import prepare_preprocessed
from bpnp.files import written_whole
from bpnp.models.released import load_released
from bpnp.training.task import BlindPnPTask

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
    task = BlindPnPTask(load_released(chosen.file, backend=chosen.ransac, method=chosen.pnp))
    checkpoint: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": lightning.__version__,
        "state_dict": task.state_dict(),
    }
    task.on_save_checkpoint(checkpoint)
    with written_whole(chosen.out) as temporary:
        torch.save(checkpoint, temporary)
    logger.info("wrote %s", chosen.out)


def prepare(arguments: list[str]) -> None:
    """`bpnp prepare DATASET SOURCE`: a data set as it was published, as one memory-mapped store.

    Raises ValueError or OSError as `prepare_meshes`, `prepare_colmap` and `prepare_preprocessed` do.
    """
    chosen = _prepare_parser().parse_args(arguments)
    if chosen.dataset == "modelnet40":
        prepared = prepare_meshes(
            chosen.source,
            chosen.output,
            points=chosen.points,
            normalisation=chosen.normalisation,
            processes=chosen.processes,
        )
    elif chosen.dataset == "preprocessed":
        prepared = prepare_preprocessed(chosen.source, chosen.output, dataset=chosen.name)
    else:
        prepared = prepare_colmap(
            chosen.source,
            chosen.output,
            min_points=chosen.min_points,
            clutter=chosen.clutter,
            processes=chosen.processes,
        )
    _show(prepared)


def _prepare_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bpnp prepare",
        description="Pack a data set, once. A run that was killed goes on where it was when it is started again.",
    )
    datasets = parser.add_subparsers(dest="dataset", required=True, metavar="DATASET")
    meshes = datasets.add_parser("modelnet40", help="ModelNet40, or any folder or zip of meshes in its layout")
    meshes.add_argument(
        "--points", type=partial(_at_least, 4), default=2048, help="surface samples of a mesh (default: 2048)"
    )
    meshes.add_argument("--normalisation", choices=("unit_sphere", "unit_cube", "none"), default="unit_sphere")
    colmap = datasets.add_parser("megadepth", help="MegaDepth, or any folder of COLMAP models")
    colmap.add_argument(
        "--min-points", type=partial(_at_least, 4), default=4, help="fewest true pairs of an image (default: 4)"
    )
    colmap.add_argument(
        "--clutter", type=_ratio, default=0.0, help="natural clutter to keep, as a ratio to the true pairs (default: 0)"
    )
    pickles = datasets.add_parser("preprocessed", help="the pickles that the authors of BPnPNet published")
    pickles.add_argument("--dataset", dest="name", help="where there are several, such as data61_2d3d")
    for command in (meshes, colmap):
        command.add_argument(
            "--processes", type=partial(_at_least, 1), default=os.cpu_count() or 1, help="(default: %(default)s)"
        )
    for name, command, what in (
        ("modelnet40", meshes, "ModelNet40.zip, its folder, or the folder of ply_data_*.h5"),
        ("megadepth", colmap, "the folder of scenes, <scene>/sparse/manhattan/<k>/{cameras,images,points3D}.bin"),
        ("preprocessed", pickles, "the folder with <dataset>_train and <dataset>_test"),
    ):
        command.add_argument("source", type=Path, metavar="SOURCE", help=what)
        command.add_argument(
            "--output", type=Path, default=Path("data", name), help="new folder (default: %(default)s)"
        )
    return parser


def _at_least(least: int, text: str) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number of {least} or more, got {text}")
    return int(text)


def _ratio(text: str) -> float:
    try:
        ratio = float(text)
    except ValueError:
        ratio = math.nan
    if not 0 <= ratio < math.inf:
        raise argparse.ArgumentTypeError(f"expected a ratio of 0 or more, 0.5 adds half as many points; got {text}")
    return ratio


def _show(prepared: Prepared) -> None:
    console = Console()
    counts = ", ".join(f"{count:,} {what}" for what, count in prepared.counts.items())
    console.print(f"{prepared.folder}: {counts}", highlight=False, soft_wrap=True)
    if prepared.skipped:
        listed = prepared.folder / "manifest.json"
        console.print(f"left out {len(prepared.skipped)}, all listed in {listed}; such as:", soft_wrap=True)
        for name, reason in list(prepared.skipped.items())[:10]:
            console.print(f"  {name}: {reason}", highlight=False, soft_wrap=True, markup=False)
