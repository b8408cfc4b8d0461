"""Which COLMAP models there are below a folder, and which scene each belongs to."""

import itertools
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

from bpnp.datamodules.colmap.model_files import FILES, ColmapError, model_format

# What lies between the folder of a scene and its models: <scene>/sparse/0, <scene>/sparse/manhattan/0 (MegaDepth),
# <scene>/dense/0/sparse.
LAYOUT = re.compile(r"sparse|dense\d*")
INSIDE_LAYOUT = re.compile(r"sparse|dense\d*|manhattan|\d+")


def find_scenes(roots: str | Path | Sequence[str | Path]) -> dict[str, dict[str, Path]]:
    """Every COLMAP model at or below `roots`, as {scene: {name of the model: folder}}, sorted.

    A scene is named by its path below the root, without what follows from `sparse` or `dense` on; all models below it
    (`sparse/0`, `sparse/1`, `sparse/manhattan/0`) belong to it. A scene's only model has the scene's name, others have
    their path added.

    Raises ColmapError if a root is not a folder, holds no model, or two scenes have one name. A folder that lacks one
    of the three files is skipped with a warning if there are whole ones.
    """
    scenes: dict[str, dict[str, Path]] = {}
    homes: dict[str, Path] = {}
    for root in [roots] if isinstance(roots, (str, Path)) else roots:
        top = Path(root).absolute()
        for folder in _find_models(top):
            home = _scene_folder(top, folder)
            scene = home.relative_to(top).as_posix() if top in home.parents else home.name
            if homes.setdefault(scene, home) != home:
                raise ColmapError(
                    f"expected scenes of different names, got {homes[scene]} and {home} for {scene!r}; try their "
                    "common parent folder as `root`"
                )
            scenes.setdefault(scene, {})["/".join((scene, *folder.relative_to(home).parts))] = folder
    return {
        scene: {scene: next(iter(models.values()))} if len(models) == 1 else dict(sorted(models.items()))
        for scene, models in sorted(scenes.items())
    }


def _find_models(top: Path) -> list[Path]:
    if not top.is_dir():
        raise ColmapError(f"expected a folder of COLMAP models, got {top}, which is no folder; try another `root`")
    whole, incomplete, visited = [], [], set[Path]()
    for name, children, files in os.walk(top, followlinks=True):
        folder = Path(name)
        children.sort()
        if folder.resolve() in visited:  # a link
            children.clear()
            continue
        visited.add(folder.resolve())
        if model_format(folder):
            whole.append(folder)
        elif max(sum(f"{part}.{suffix}" in files for part in FILES) for suffix in ("bin", "txt")) > 1:
            incomplete.append(folder)
    if incomplete:
        message = (
            f"expected cameras, images and points3D in a COLMAP model, got {len(incomplete)} folders without one of "
            f"them ({', '.join(map(str, incomplete[:4]))}); try copying them again"
        )
        if not whole:
            raise ColmapError(message)
        warnings.warn(f"skipped: {message}", stacklevel=4)
    if not whole:
        raise ColmapError(
            f"expected COLMAP models below {top}, got none; try a folder that holds <scene>/sparse/0/cameras.bin (or "
            ".txt), images and points3D"
        )
    return whole


def _scene_folder(top: Path, folder: Path) -> Path:
    """Where the path to a model first meets `sparse` or `dense`; else the model's folder itself.

    Looked for below the root, or from above it if the root is inside a scene, `castle/sparse` say.
    """
    start = len(top.parts)
    if all(INSIDE_LAYOUT.fullmatch(part) for part in folder.relative_to(top).parts):
        start -= len(list(itertools.takewhile(INSIDE_LAYOUT.fullmatch, reversed(top.parts))))
    for depth in range(max(start, 1), len(folder.parts)):
        if LAYOUT.fullmatch(folder.parts[depth]):
            return Path(*folder.parts[:depth])
    return folder
