"""Files of rough poses."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.solving.arguments import Prior

Vector = tuple[float, float, float]


def known_pose(
    prior: Path | None, degrees: float, distance: float | None, up_camera: Vector | None, up_scene: Vector | None,
    up_degrees: float,
) -> Prior | str | Path | None:  # fmt: skip
    """The prior that the options of a command describe. Raises ValueError for options that contradict each other."""
    if (up_camera is None) != (up_scene is None):
        raise ValueError("expected --up_camera and --up_scene together, got one of them")
    if up_camera is None or up_scene is None:
        return None if prior is None else read_prior(prior, degrees, distance)
    if prior is not None:
        raise ValueError("expected --prior or --up_camera with --up_scene, got both")
    return GravityPrior(up_camera, up_scene, up_degrees)


def read_prior(path: Path, degrees: float, distance: float | None) -> Any:
    """The rough pose in a file with `rotation` and `translation`; the path of anything else, a checkpoint."""
    if path.suffix.lower() != ".json":
        return path
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rotation, translation = (np.array(content[name], np.float64) for name in ("rotation", "translation"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"expected JSON with `rotation` and `translation` in {path}, got {error}") from error
    return PosePrior(rotation, translation, degrees, np.inf if distance is None else distance)
