"""The picture of a solution: what the camera sees, and where the pose puts the scene's points."""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.cameras import Camera, in_front
from bpnp.report.palette import LIGHT, QUIET, VERDICTS
from bpnp.report.photos import Box, picture_box
from bpnp.report.samples import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, CLOSE_UP, CAPTIONS = 10.0, 3.5, 1.3  # inches
LINE = 130  # characters


def read_photo(path: Path | str) -> Array:
    """The picture in a file (h, w, 3), uint8. Raises ValueError that names a file that is none."""
    from PIL import Image

    try:
        with Image.open(path) as photo:
            return np.asarray(photo.convert("RGB"))
    except OSError as error:
        raise ValueError(f"expected a picture, got {path}: {error}") from error


def solution_picture(
    solution: Any, *, title: str | None = None, photo: Array | None = None, box: Box | None = None
) -> "Figure":
    """The image: its points, matched and unmatched reprojected 3D points, a line for each match; and the residuals.

    solution: as `bpnp.solve` returns it; the axes are pixels of its camera, without one normalised coordinates.
    photo: (h, w, 3) uint8, as it was taken with the camera; or undistorted, filling a `box` of the normalised image
    plane, `picture_box(solution.points2d)` for a solution without a camera.
    """
    from matplotlib.figure import Figure

    camera = solution.camera
    matches = np.asarray(getattr(solution, "match_places", solution.matches))
    seen, projected = np.asarray(solution.points2d), np.empty((0, 2))
    if np.isfinite(solution.rotation).all() and np.isfinite(solution.translation).all():
        projected = in_front(np.asarray(solution.points3d) @ solution.rotation.T + solution.translation)[:, :2]
    if photo is not None and (box is not None or camera is None):
        (left, top), (right, bottom) = _drawn(np.reshape(box or picture_box(seen), (2, 2)), camera)
        frame = Box(left, top, right, bottom)
    elif photo is not None:
        frame = Box(0, 0, photo.shape[1], photo.shape[0])
    seen, projected = _drawn(seen, camera), _drawn(projected, camera)
    if photo is None:
        frame = picture_box(seen)
    height = WIDTH * (frame.bottom - frame.top) / (frame.right - frame.left)
    figure = Figure(figsize=(WIDTH + CLOSE_UP, float(np.clip(height, 3, 10)) + CAPTIONS), layout="constrained")
    axes, close = figure.subplots(1, 2, width_ratios=(WIDTH, CLOSE_UP))
    if photo is not None:
        axes.imshow(photo, extent=(frame.left, frame.right, frame.bottom, frame.top), zorder=0)
    _draw_points(axes, seen, projected, matches, hidden=photo is None)
    unit = "normalised coordinates" if camera is None else "pixels"
    axes.set(xlim=(frame.left, frame.right), ylim=(frame.bottom, frame.top), aspect="equal", xlabel=unit, ylabel=unit)
    axes.tick_params(labelsize=8)
    _draw_residuals(close, seen, projected, matches, unit)
    figure.suptitle(_described(solution, title).replace("$", r"\$"), fontsize=10, color=VERDICTS[solution.verdict])
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def _drawn(points: Array, camera: Camera | None) -> Array:
    """Normalised coordinates (k, 2) as the axes have them."""
    return points if camera is None else camera.project(np.column_stack([points, np.ones(len(points))]))


def _draw_points(axes: "Axes", seen: Array, projected: Array, matches: Any, *, hidden: bool) -> None:
    """Rings around the image points, crosses where the pose puts 3D points; without a photo, those of no match too."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    size = float(np.clip(80 / np.sqrt(len(seen)), 2, 7))
    colour = "black" if hidden else "white"
    rims = axes.plot(*seen.T, "o", mfc="none", mec=colour, mew=0.7, ms=size, label="image points", zorder=3)
    if not hidden:
        rims[0].set_path_effects([withStroke(linewidth=1.7, foreground="black")])  # for bright photos and the legend
    if not len(projected):
        return
    free = np.ones(len(projected), bool)
    free[matches[:, 1]] = False
    if free.any() and hidden:
        axes.plot(*projected[free].T, "x", color=LIGHT[3], ms=size, mew=0.6, label="3D points, no match", zorder=1)
    if not free.all():
        axes.plot(*projected[~free].T, "x", color=LIGHT[0], ms=size, mew=0.9, label="3D points, matched", zorder=4)
        ends = np.stack([seen[matches[:, 0]], projected[matches[:, 1]]], 1)
        axes.add_collection(LineCollection(list(ends), colors=LIGHT[0], linewidths=0.8, zorder=2))


def _draw_residuals(axes: "Axes", seen: Array, projected: Array, matches: Any, unit: str) -> None:
    """A close-up: image point minus reprojected 3D point of each match."""
    if not len(matches) or not len(projected):
        axes.set_axis_off()
        return
    residuals = seen[matches[:, 0]] - projected[matches[:, 1]]
    reach = 1.1 * float(np.nanmax(np.abs(residuals))) or 1.0
    axes.plot(*residuals.T, ".", color=LIGHT[0], ms=4)
    axes.axhline(0, color=QUIET, lw=0.5)
    axes.axvline(0, color=QUIET, lw=0.5)
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    axes.set_title(f"residuals, {unit}", fontsize=9)
    axes.tick_params(labelsize=7)


def _described(solution: Any, title: str | None) -> str:
    """Title, verdict with the figures of the matches, and the reason, a line each."""
    found = "no match"
    if len(solution.matches):
        share, error = f"{100 * solution.inlier_ratio:.0f} %", f"{solution.reprojection_error:.3g} {solution.unit}"
        found = f"{solution.inlier_count} matches ({share}), mean error {error}"
    reason = textwrap.fill(str(solution.reason), LINE)
    return "\n".join([*([] if title is None else [title]), f"{solution.verdict}: {found}", reason])
