"""The picture of a solution: what the camera sees, and where the pose puts the scene's points."""

from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.cameras import in_front
from bpnp.report.palette import LIGHT, QUIET
from bpnp.report.photos import MARGIN, Box
from bpnp.report.samples import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VERDICTS = {"confident": LIGHT[2], "ambiguous": LIGHT[1], "failed": LIGHT[3]}
WIDTH, CAPTIONS = 8.0, 1.3  # inches


def picture_box(points2d: Array) -> Box:
    """What the image points span, and a little more; the photo of `solution_picture` fills it.

    Raises ValueError if no point is in front of the camera.
    """
    seen = points2d[np.isfinite(points2d).all(-1)].astype(float)
    if not len(seen):
        raise ValueError("expected image points in front of the camera to draw, got none")
    low, high = seen.min(0), seen.max(0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return Box(*(low - margin).tolist(), *(high + margin).tolist())


def solution_picture(solution: Any, *, title: str | None = None, photo: Array | None = None) -> "Figure":
    """The normalised image plane: image points, matched and unmatched reprojected 3D points, and a line for each match.

    solution: as `bpnp.solve` returns it. photo: (h, w, 3) uint8, undistorted, that fills `picture_box`.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    points2d, matches = np.asarray(solution.points2d), np.asarray(getattr(solution, "match_places", solution.matches))
    box = picture_box(points2d)
    height = WIDTH * (box.bottom - box.top) / (box.right - box.left)
    figure = Figure(figsize=(WIDTH, float(np.clip(height, 2.5, 9)) + CAPTIONS), layout="constrained")
    axes = figure.add_subplot()
    if photo is not None:
        axes.imshow(photo, extent=(box.left, box.right, box.bottom, box.top), alpha=0.75, zorder=0)
    size = float(np.clip(80 / np.sqrt(len(points2d)), 1.5, 6))
    axes.plot(*points2d.T, "o", mfc="none", mec="black", mew=0.6, ms=size, label="image points", zorder=3)
    if np.isfinite(solution.rotation).all() and np.isfinite(solution.translation).all():
        projected = in_front(np.asarray(solution.points3d) @ solution.rotation.T + solution.translation)[:, :2]
        free = np.ones(len(projected), bool)
        free[matches[:, 1]] = False
        axes.plot(*projected[free].T, "x", color=LIGHT[3], ms=size, mew=0.6, label="3D points, no match", zorder=1)
        axes.plot(*projected[~free].T, "x", color=LIGHT[0], ms=size, mew=0.8, label="3D points, matched", zorder=4)
        ends = np.stack([points2d[matches[:, 0]], projected[matches[:, 1]]], 1)
        axes.add_collection(LineCollection(list(ends), colors=LIGHT[0], linewidths=0.8, zorder=2))
    axes.set(xlim=(box.left, box.right), ylim=(box.bottom, box.top), aspect="equal")
    axes.tick_params(labelsize=8)
    shown = "" if title is None else f"{title}\n"
    figure.suptitle((shown + _described(solution)).replace("$", r"\$"), fontsize=10, color=VERDICTS[solution.verdict])
    axes.set_xlabel(str(solution.reason).replace("$", r"\$"), fontsize=8, color=QUIET, wrap=True)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def _described(solution: Any) -> str:
    if not len(solution.matches):
        return f"{solution.verdict}: no match"
    error = f"{solution.reprojection_error:.3g} {solution.unit}"
    return (
        f"{solution.verdict}: {solution.inlier_count} matches ({100 * solution.inlier_ratio:.0f} %), mean error {error}"
    )
