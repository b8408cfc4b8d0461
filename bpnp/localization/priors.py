"""Files of rough poses."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.search.starts import PosePrior


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
