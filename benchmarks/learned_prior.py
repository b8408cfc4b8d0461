"""What a trained network buys the search: `solve` without and with it as a prior, on the same pairs.

    python benchmarks/learned_prior.py --root path/to/meshes --points 256 --pairs 16
    python benchmarks/learned_prior.py --root path/to/meshes --rotation euler --ratio 0.5 --prior matcher.ckpt
    python benchmarks/learned_prior.py --scene path/to/scene --ratio 0.5 --prior matcher.ckpt

Without --root and --scene the shapes are procedural test shapes. --ratio adds clutter to both sides, a number for each
true pair: uniform outliers to shapes; to photos of a scene keypoints without a point and points that they do not see.
Prints the quartiles of the rotation error, the share within 5 degrees, the confident verdicts, those of them that are
wrong, and processor seconds a pair.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from bpnp import Batch, solve
from bpnp.datamodules import ColmapDataModule, MeshDataModule, Outliers
from bpnp.metrics import rotation_error
from bpnp.models import TrainedNet
from bpnp.models.weights import LEARNED

RIGHT_DEG = 5.0


def measured(batch: Batch, net: TrainedNet | None) -> list[str]:
    """A row of the table."""
    assert batch.rotation is not None
    errors, seconds, confident = [], [], []
    for i in range(len(batch)):
        start = time.process_time()
        solution = solve(batch.points2d[i][batch.mask2d[i]], batch.points3d[i][batch.mask3d[i]], prior=net)
        seconds.append(time.process_time() - start)
        rotation = torch.as_tensor(solution.rotation)[None]
        errors.append(float(rotation_error(rotation, batch.rotation[i : i + 1].double())))
        confident.append(solution.verdict == "confident")
    wrong = sum(c and not error <= RIGHT_DEG for c, error in zip(confident, errors, strict=True))
    quartiles = np.nanquantile(errors, [0.25, 0.5, 0.75])
    return [
        " / ".join(f"{q:.3g}" for q in quartiles),
        f"{np.mean(np.array(errors) <= RIGHT_DEG):.2f}",
        str(sum(confident)),
        str(wrong),
        f"{np.mean(seconds):.2f}",
    ]


def test_batch(chosen: argparse.Namespace) -> Batch:
    """The pairs, in one batch."""
    count, points, ratio = chosen.pairs, chosen.points, chosen.ratio
    data: MeshDataModule | ColmapDataModule
    if chosen.scene is None:
        data = MeshDataModule(
            chosen.root,
            rotation=chosen.rotation,
            num_points=points,
            test_shapes=count,
            test_pairs=count,
            test_outliers=Outliers(ratio=ratio),
            batch_size=count,
        )
    else:
        data = ColmapDataModule(
            chosen.scene, test_fraction=1.0, eval_max_points=points, clutter=ratio, rotate=True, batch_size=1
        )
    data.setup("test")
    loader = data.test_dataloader()
    if chosen.scene is None:
        return next(iter(loader))
    every = max(1, len(loader) // count)
    found = [batch for i, batch in enumerate(loader) if i % every == 0][:count]
    fields = ("points2d", "points3d", "rotation", "translation", "match3d")
    return Batch.from_arrays(*([getattr(batch, name)[0] for batch in found] for name in fields))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", help="meshes in ModelNet40's layout")
    parser.add_argument("--scene", help="a COLMAP scene, instead of meshes; its frame is turned at random")
    parser.add_argument("--prior", default=LEARNED, help="packaged weights or a checkpoint")
    parser.add_argument("--rotation", choices=("so3", "euler"), default="so3")
    parser.add_argument("--ratio", type=float, default=0.0)
    parser.add_argument("--points", type=int, default=256)
    parser.add_argument("--pairs", type=int, default=16)
    chosen = parser.parse_args(arguments)
    load = TrainedNet.from_checkpoint if Path(chosen.prior).is_file() else TrainedNet.from_pretrained
    net = load(chosen.prior)
    batch = test_batch(chosen)
    table = Table("prior", "rotation deg", "within 5 deg", "confident", "of them wrong", "CPU s")
    table.add_row("none", *measured(batch, None))
    table.add_row("learned", *measured(batch, net))
    Console().print(table)


if __name__ == "__main__":
    main()
