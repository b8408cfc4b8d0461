"""What a user knows of single points: normals, labels and scores. Each function raises ValueError for unusable ones."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
UNIT_NORM = 1e-3


def checked_normals(values: Any, count: int, where: str) -> Array | None:
    """Unit normals (n, 3) of `count` 3D points."""
    if values is None:
        return None
    try:
        normals = np.asarray(_on_host(values), np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected `normals3d` as an array of numbers{where}, got {values!r:.60}") from error
    if normals.shape != (count, 3):
        raise ValueError(f"expected `normals3d` of shape ({count}, 3) as `points3d`{where}, got {normals.shape}")
    length = np.linalg.norm(normals, axis=-1)
    bad = np.flatnonzero(~(np.abs(length - 1) <= UNIT_NORM))
    if len(bad):
        raise ValueError(
            f"expected unit vectors in `normals3d`{where}, got {normals[bad[0]].tolist()} at point {bad[0]}; "
            "try to divide by the lengths"
        )
    return np.asarray(normals / length[:, None])


def checked_labels(labels2d: Any, labels3d: Any, counts: tuple[int, int], where: str) -> tuple[Labels, Labels] | None:
    """Integer labels of the 2D and the 3D points, -1 for any; both or neither."""
    if labels2d is None and labels3d is None:
        return None
    for name, values in (("labels2d", labels2d), ("labels3d", labels3d)):
        if values is None:
            raise ValueError(f"expected both `labels2d` and `labels3d`, or neither{where}, got no `{name}`")
    return _labels("labels2d", labels2d, counts[0], where), _labels("labels3d", labels3d, counts[1], where)


def checked_scores(name: str, values: Any, count: int, where: str) -> Array | None:
    """Probabilities (count,) that a point has a partner, in (0, 1]."""
    if values is None:
        return None
    points = name.replace("scores", "points")
    try:
        scores = np.asarray(_on_host(values), np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected `{name}` as an array of numbers{where}, got {values!r:.60}") from error
    if scores.shape != (count,):
        raise ValueError(f"expected `{name}` of shape ({count},) as `{points}`{where}, got {scores.shape}")
    bad = np.flatnonzero(~((scores > 0) & (scores <= 1)))
    if len(bad):
        raise ValueError(
            f"expected probabilities above 0 and up to 1 in `{name}`{where}, got {scores[bad[0]]} at point {bad[0]}; "
            "try to divide by the largest"
        )
    return scores


def _labels(name: str, values: Any, count: int, where: str) -> Labels:
    labels = np.asarray(_on_host(values))
    points = name.replace("labels", "points")
    if labels.shape != (count,):
        raise ValueError(f"expected `{name}` of shape ({count},) as `{points}`{where}, got {labels.shape}")
    if labels.dtype.kind not in "iu":
        raise ValueError(f"expected integers in `{name}`{where}, got {labels.dtype}; try .astype(int)")
    if labels.min(initial=0) < -1:
        raise ValueError(f"expected labels of 0 or more, or -1 for any, in `{name}`{where}, got {labels.min()}")
    return labels.astype(np.int64)


def _on_host(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values
