"""What the packaged network buys the search: `solve` without and with prior="learned", on the same pairs.

    python benchmarks/learned_prior.py --root path/to/meshes --points 256 --pairs 16

Rotations are uniform over SO(3). Without --root the shapes are procedural test shapes. Prints the quartiles of the
rotation error, the share within 5 degrees, the confident verdicts, those of them that are wrong, and processor seconds
a pair.
"""

import argparse
import time
from collections.abc import Sequence

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from bpnp import Batch, BPnPNet, solve
from bpnp.datamodules import MeshDataModule
from bpnp.metrics import rotation_error
from bpnp.models.pretrained import LEARNED

RIGHT_DEG = 5.0


def measured(batch: Batch, net: BPnPNet | None) -> list[str]:
    """A row of the table."""
    assert batch.rotation is not None
    errors, seconds, confident = [], [], []
    for i in range(len(batch)):
        start = time.process_time()
        solution = solve(batch.points2d[i], batch.points3d[i], prior=net)
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


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", help="meshes in ModelNet40's layout")
    parser.add_argument("--points", type=int, default=256)
    parser.add_argument("--pairs", type=int, default=16)
    chosen = parser.parse_args(arguments)
    data = MeshDataModule(
        chosen.root,
        rotation="so3",
        num_points=chosen.points,
        test_shapes=chosen.pairs,
        test_pairs=chosen.pairs,
        batch_size=chosen.pairs,
    )
    data.setup("test")
    batch = next(iter(data.test_dataloader()))
    table = Table("prior", "rotation deg", "within 5 deg", "confident", "of them wrong", "CPU s")
    table.add_row("none", *measured(batch, None))
    table.add_row("learned", *measured(batch, BPnPNet.from_pretrained(LEARNED)))
    Console().print(table)


if __name__ == "__main__":
    main()
