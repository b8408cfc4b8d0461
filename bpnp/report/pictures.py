"""The image of a pair and the residuals of its matches as matplotlib axes.

Axes are in pixels of the pair's camera, in normalised coordinates where there is none.
"""

from typing import TYPE_CHECKING, Literal

import numpy as np

from bpnp.cameras import Camera, in_front
from bpnp.report.palette import LIGHT, QUIET
from bpnp.report.photos import Box, picture_box, size_in_camera
from bpnp.report.samples import Array, PairView

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Lines = Literal["match3d", "assigned3d"]


def plot_image(
    axes: "Axes", view: PairView, *, estimate: str | None = None, lines: Lines | None = "match3d",
    photo: Array | None = None, box: Box | None = None,
) -> "Axes":  # fmt: skip
    """Rings around the image points, crosses where a pose puts 3D points, and a line from each to its match.

    estimate: whose pose, the first by default. lines: to the true matches or to those assigned by the solver, which a
    pair without known matches always has; those that are not the true ones are dotted. photo: (h, w, 3) uint8, as it
    was taken with the camera; or undistorted, filling a `box` of the normalised image plane, `picture_box` of the image
    points for a pair without a camera. Under a photo, 3D points without a match are not drawn. Returns the axes.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    seen, projected, targets = _drawn(view, estimate, lines)
    if photo is not None and (box is not None or view.camera is None):
        frame = Box(*_in_unit(np.reshape(box or picture_box(view.points2d), (2, 2)), view.camera).ravel().tolist())
    else:
        frame = picture_box(seen) if photo is None else Box(0, 0, *size_in_camera(photo, view.camera))
    if photo is not None:
        axes.imshow(photo, extent=(frame.left, frame.right, frame.bottom, frame.top), zorder=0)
    size = float(np.clip(80 / np.sqrt(len(seen)), 2, 7))
    rim = "black" if photo is None else "white"
    rims = axes.plot(*seen.T, "o", mfc="none", mec=rim, mew=0.7, ms=size, label="image points", zorder=3)
    if photo is not None:
        rims[0].set_path_effects([withStroke(linewidth=1.7, foreground="black")])  # for bright photos and the legend
    visible = np.isfinite(projected).all(-1)
    matched, free = visible & ((targets >= 0) | (lines is None)), visible & (targets < 0) & (lines is not None)
    if matched.any():
        colour = _colour(view, estimate)
        axes.plot(*projected[matched].T, "x", color=colour, ms=size, mew=0.9, label="3D points, matched", zorder=4)
        joined = matched & (targets >= 0)
        wrong = joined & (view.match3d != targets) & (view.match3d >= 0)
        for own, ink, style in ((joined & ~wrong, colour, "-"), (wrong, LIGHT[3], ":")):
            if own.any():
                ends = np.stack([seen[targets[own]], projected[own]], 1)
                axes.add_collection(LineCollection(list(ends), colors=ink, linestyles=style, linewidths=0.8, zorder=2))
    if free.any() and photo is None:
        axes.plot(*projected[free].T, "x", color=LIGHT[3], ms=size, mew=0.6, label="3D points, no match", zorder=1)
    unit = _unit(view)
    axes.set(xlim=(frame.left, frame.right), ylim=(frame.bottom, frame.top), aspect="equal", xlabel=unit, ylabel=unit)
    axes.tick_params(labelsize=8)
    return axes


def plot_residuals(
    axes: "Axes", view: PairView, *, estimate: str | None = None, lines: Lines = "match3d"
) -> "Axes":  # fmt: skip
    """A close-up: image point minus reprojected 3D point of each match; arguments as for `plot_image`."""
    seen, projected, targets = _drawn(view, estimate, lines)
    matched = targets >= 0
    residuals = seen[targets[matched]] - projected[matched]
    if not np.isfinite(residuals).any():
        axes.set_axis_off()
        return axes
    reach = 1.1 * float(np.nanmax(np.abs(residuals))) or 1.0
    axes.plot(*residuals.T, ".", color=_colour(view, estimate), ms=4)
    axes.axhline(0, color=QUIET, lw=0.5)
    axes.axvline(0, color=QUIET, lw=0.5)
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    axes.set_title(f"residuals, {_unit(view)}", fontsize=9)
    axes.tick_params(labelsize=7)
    return axes


def estimate_of(view: PairView, estimate: str | None) -> str | None:
    """The estimate, the first by default; None if there is none. Raises ValueError for one that the pair lacks."""
    if estimate is not None and estimate not in view.estimates:
        raise ValueError(f"expected an estimate among {list(view.estimates)}, got {estimate!r}")
    return estimate or next(iter(view.estimates), None)


def _drawn(view: PairView, estimate: str | None, lines: Lines | None) -> tuple[Array, Array, Array]:
    """Image points, projected 3D points (n, 2), NaN without a pose, and the image point that each is joined to."""
    pose = view.estimates.get(estimate_of(view, estimate) or "", (np.full((3, 3), np.nan), np.full(3, np.nan)))
    projected = in_front(np.asarray(view.points3d, float) @ pose[0].T + pose[1])[:, :2]
    if lines == "match3d" and (view.match3d < 0).all():
        lines = "assigned3d"
    targets = np.full(len(projected), -1) if lines is None else getattr(view, lines)
    return _in_unit(view.points2d, view.camera), _in_unit(projected, view.camera), targets


def _in_unit(points: Array, camera: Camera | None) -> Array:
    """Normalised coordinates (k, 2) as the axes have them."""
    return points if camera is None else camera.project(np.column_stack([points, np.ones(len(points))]))


def _unit(view: PairView) -> str:
    return "normalised coordinates" if view.camera is None else "pixels"


def _colour(view: PairView, estimate: str | None) -> str:
    return LIGHT[list(view.estimates).index(estimate_of(view, estimate) or "") % len(LIGHT)]
