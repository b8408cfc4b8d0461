"""`bpnp prepare`, which packs a published data set as a memory-mapped store, and `bpnp convert-weights`."""

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bpnp.commands.parser import at_least
from bpnp.files import check_outputs, write_atomically
from bpnp.report.terminal import say

if TYPE_CHECKING:
    from bpnp.datamodules.store import Store

# CPUs that this process may use, such as those of a cluster job
PROCESSES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare_modelnet40(
    source: Path,
    *,
    output: Path = Path("data/modelnet40"),
    points: int = 2048,
    normalisation: Literal["unit_sphere", "unit_cube", "none"] = "unit_sphere",
    processes: int = PROCESSES,
) -> None:
    """Pack ModelNet40, or any folder of meshes in its layout. An interrupted run leaves no files.

    Args:
        source: folder of <class>/{train,test}/*.{off,obj,ply,stl,glb}, or of point clouds (docs/data.md).
        output: new folder.
        points: surface samples of each mesh, or random points of each cloud.
        normalisation: frame of each mesh: unit_sphere, the mean at the origin and the farthest sample at distance 1;
            unit_cube, the bounding box centred with a longest side of 1; none, the units of the file.
        processes: number of worker processes.
    """
    from bpnp.datamodules.clouds import open_shapes
    from bpnp.datamodules.meshes import surfaces_recipe
    from bpnp.datamodules.store import prepare

    at_least(4, points=points)
    at_least(1, processes=processes)
    recipe = surfaces_recipe(open_shapes(source), points=points, normalisation=normalisation, label=str(source))
    store = prepare(recipe, output, processes=processes)
    _show(store, Counter(store.name(row).split("/")[-2] for row in range(len(store))))


def prepare_megadepth(
    source: Path,
    *,
    output: Path = Path("data/megadepth"),
    min_points: int = 4,
    clutter: float = 0.0,
    processes: int = PROCESSES,
) -> None:
    """Pack MegaDepth, or any folder of COLMAP models. An interrupted run leaves no files.

    Args:
        source: folder of scenes, <scene>/sparse/manhattan/<k>/{cameras,images,points3D}.bin.
        output: new folder.
        min_points: least number of matches of an image.
        clutter: natural clutter to keep, as a ratio to the matches; 0.5 adds half as many points.
        processes: number of worker processes.
    """
    from bpnp.datamodules.colmap.module import colmap_recipe
    from bpnp.datamodules.store import prepare
    from bpnp.datamodules.stored import scene_rows

    at_least(4, min_points=min_points)
    at_least(1, processes=processes)
    at_least(0, clutter=clutter)
    store = prepare(colmap_recipe(source, min_points=min_points, clutter=clutter), output, processes=processes)
    _show(store, {"scenes": len(scene_rows(store)), "images": len(store)})


def prepare_authors(source: Path, *, output: Path = Path("data/authors"), dataset: str | None = None) -> None:
    """Pack the pickles that the authors of BPnPNet published.

    Args:
        source: folder with <dataset>_train and <dataset>_test, or those of Liu et al. (2020), _train and _valid.
        output: new folder.
        dataset: name of the data set if there are several, such as data61_2d3d.
    """
    from bpnp.datamodules.authors import authors_recipe, split_rows
    from bpnp.datamodules.store import prepare

    store = prepare(authors_recipe(source, dataset), output)
    _show(store, {split: len(split_rows(store, split)) for split in ("train", "test")})


def _show(store: "Store", counts: Mapping[str, int]) -> None:
    say(f"{store.folder}: {', '.join(f'{count:,} {what}' for what, count in counts.items())}")
    if store.skipped:
        say(f"left out {len(store.skipped)}, all listed in {store.folder / 'manifest.json'}; such as:")
        for name, reason in list(store.skipped.items())[:10]:
            say(f"  {name}: {reason}")


def convert_weights(file: Path, out: Path, *, ransac: Literal["poselib", "opencv"] = "poselib") -> None:
    """Convert the weights of the authors of BPnPNet to a checkpoint of bpnp.

    The checkpoint is for `BPnPNet.from_checkpoint` and `bpnp test --ckpt_path`. An interrupted run leaves no file.

    Args:
        file: the authors' file, *.pth.tar.
        out: checkpoint to write, *.ckpt.
        ransac: backend of the RANSAC step; opencv is the paper's.
    """
    check_outputs([out], [file])
    import lightning
    import torch

    from bpnp.models.bpnpnet import load_authors_weights
    from bpnp.training.task import BlindPnPTask

    task = BlindPnPTask(load_authors_weights(file, backend=ransac))
    checkpoint: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": lightning.__version__,
        "state_dict": task.state_dict(),
    }
    task.on_save_checkpoint(checkpoint)
    with write_atomically(out) as temporary:
        torch.save(checkpoint, temporary)
    say(f"wrote {out}")
