"""`bpnp prepare`: a data set as it was published, packed once as a memory-mapped store."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bpnp.commands.output import say
from bpnp.commands.parser import at_least

if TYPE_CHECKING:
    from bpnp.datamodules.prepare import Prepared

PROCESSES = os.cpu_count() or 1


def prepare_modelnet40(
    source: Path,
    *,
    output: Path = Path("data/modelnet40"),
    points: int = 2048,
    normalisation: Literal["unit_sphere", "unit_cube", "none"] = "unit_sphere",
    processes: int = PROCESSES,
) -> None:
    """Pack ModelNet40, or any folder or zip of meshes in its layout. A run that was killed resumes.

    Args:
        source: ModelNet40.zip, its folder, or the folder of ply_data_*.h5.
        output: new folder.
        points: surface samples of a mesh.
        normalisation: of each mesh.
        processes: worker processes.
    """
    from bpnp.datamodules.meshes.prepare import prepare_meshes

    at_least(4, points=points)
    at_least(1, processes=processes)
    _show(prepare_meshes(source, output, points=points, normalisation=normalisation, processes=processes))


def prepare_megadepth(
    source: Path,
    *,
    output: Path = Path("data/megadepth"),
    min_points: int = 4,
    clutter: float = 0.0,
    processes: int = PROCESSES,
) -> None:
    """Pack MegaDepth, or any folder of COLMAP models. A run that was killed resumes.

    Args:
        source: the folder of scenes, <scene>/sparse/manhattan/<k>/{cameras,images,points3D}.bin.
        output: new folder.
        min_points: fewest true pairs of an image.
        clutter: natural clutter to keep, as a ratio to the true pairs; 0.5 adds half as many points.
        processes: worker processes.
    """
    from bpnp.datamodules.colmap.prepare import prepare_colmap

    at_least(4, min_points=min_points)
    at_least(1, processes=processes)
    at_least(0, clutter=clutter)
    _show(prepare_colmap(source, output, min_points=min_points, clutter=clutter, processes=processes))


def prepare_released(source: Path, *, output: Path = Path("data/preprocessed"), dataset: str | None = None) -> None:
    """Pack the pickles that the authors of BPnPNet published.

    Args:
        source: the folder with <dataset>_train and <dataset>_test.
        output: new folder.
        dataset: where there are several, such as data61_2d3d.
    """
    from bpnp.datamodules.released.prepare import prepare_preprocessed

    _show(prepare_preprocessed(source, output, dataset=dataset))


def _show(prepared: "Prepared") -> None:
    say(f"{prepared.folder}: {', '.join(f'{count:,} {what}' for what, count in prepared.counts.items())}")
    if prepared.skipped:
        say(f"left out {len(prepared.skipped)}, all listed in {prepared.folder / 'manifest.json'}; such as:")
        for name, reason in list(prepared.skipped.items())[:10]:
            say(f"  {name}: {reason}")
