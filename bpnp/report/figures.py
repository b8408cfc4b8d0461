"""Recall curves and pairs as matplotlib figures, for papers, notebooks and loggers.

Figures are made without pyplot: they need no display, no backend, and no closing.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bpnp.files import written_whole
from bpnp.report.page.charts import sorted_errors
from bpnp.report.palette import DASHES, LIGHT, QUIET, styles
from bpnp.report.photos import box_of
from bpnp.report.results import Results
from bpnp.report.runs import read_runs
from bpnp.report.samples import Array, PairView
from bpnp.report.solutions import Solved, solution_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Lines = Literal["match3d", "assigned3d"]
SUFFIXES = (".png", ".svg", ".pdf")


def recall_curve(
    runs: Sequence[Path | str] | Mapping[str, Results], *, joint_translation: float = 0.5, log: bool = False
) -> "Figure":
    """Share of pairs with an error up to a threshold, for rotation, translation, both, and reprojection (paper Fig. 3).

    runs: results folders, or results by name. The joint curve counts pairs with a translation error up to
    `joint_translation` scene units. `log`: logarithmic thresholds. Raises ValueError if a folder cannot be read.
    """
    from matplotlib.figure import Figure

    if not isinstance(runs, Mapping):
        runs = read_runs(runs)
    panels = (
        ("rotation_deg", "rotation error, degrees", 20.0),
        ("translation", "translation error, scene units", 1.0),
        ("joint", f"rotation error, degrees,\nwith translation error up to {joint_translation:g}", 20.0),
        ("reprojection_deg", "reprojection error, degrees", 2.0),
    )
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    shapes = styles({name: list(results.estimates) for name, results in runs.items()})
    for axes, (key, label, limit) in zip(np.ravel(figure.subplots(1, 4, sharey=True)), panels, strict=True):
        for (run, estimate), (colour, dashes) in shapes.items():
            errors = sorted_errors(runs[run], estimate, key, joint_translation)
            name = estimate if len(runs) == 1 else f"{run}: {estimate}"
            lines = axes.step(*_curve(errors, limit), where="post", color=LIGHT[colour], label=_text(name))
            if DASHES[dashes]:
                lines[0].set_dashes(DASHES[dashes])
        axes.set(xlabel=label, ylim=(0, 1.01), xlim=(limit / 1000, limit) if log else (0, limit))
        axes.set_xscale("log" if log else "linear")
        axes.grid(alpha=0.3)
    figure.axes[0].yaxis.set_major_formatter(lambda share, _: f"{100 * share:.0f} %")
    figure.axes[0].set_ylabel("pairs within")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def plot_pair(
    view: PairView | Solved,
    *,
    estimate: str | None = None,
    lines: Lines | None = "match3d",
    photo: Array | None = None,
) -> "Figure":
    """A pair in space, points with true and estimated cameras, and in the image, seen and reprojected points.

    view: of a test, or the solution of `bpnp.solve`. estimate: the pose that reprojects, the first by default. lines:
    join each image point with its true match ("match3d") or with the one assigned by the solver ("assigned3d"); of a
    pair without known matches, always the latter. photo: (h, w, 3) uint8 under the image points, undistorted, that
    fills `bpnp.report.photos.box_of(view)`. Raises ValueError for an unknown estimate.
    """
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    if not isinstance(view, PairView):
        view = solution_view(view)
    if estimate is not None and estimate not in view.estimates:
        raise ValueError(f"expected an estimate among {list(view.estimates)}, got {estimate!r}")
    estimate = estimate or next(iter(view.estimates), None)
    if lines == "match3d" and (view.match3d < 0).all():
        lines = "assigned3d"
    figure = Figure(figsize=(13, 6), layout="constrained")
    figure.suptitle(_text(view.id), fontsize=10)
    colours = dict(zip(view.estimates, LIGHT, strict=False))
    poses = {name: pose for name, pose in view.estimates.items() if np.isfinite(np.c_[pose]).all()}
    _draw_scene(figure.add_subplot(1, 2, 1, projection="3d"), view, poses, colours)
    axes = figure.add_subplot(1, 2, 2)
    rim = "black" if photo is None else "white"
    rims = axes.plot(*view.points2d.T, "o", mfc="none", mec=rim, ms=5, label="image points", zorder=3)
    if photo is not None:
        rims[0].set_path_effects([withStroke(linewidth=2, foreground="black")])  # for bright photos and the legend
    limits = axes.axis()
    if photo is not None:
        left, top, right, bottom = box_of(view)
        axes.imshow(photo, extent=(left, right, bottom, top), zorder=0)
    if estimate in poses:
        _draw_reprojection(axes, view, poses[estimate], colours[estimate], lines)
        axes.plot([], [], "x", color=colours[estimate], label=_text(f"3D points, {estimate}"))
    else:
        axes.set_title("no pose", fontsize=9)
    axes.set(xlim=limits[:2], ylim=limits[3:1:-1], aspect="equal")
    axes.set_xlabel("normalised image coordinates", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2, frameon=False, fontsize=8)
    return figure


def save_figure(figure: "Figure", path: Path | str, *, dpi: int = 110) -> Path:
    """Write a figure whole or not at all. Raises ValueError if the name does not end in .png, .svg or .pdf."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a file name that ends in {', '.join(SUFFIXES)}, got {path.name!r}")
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:].lower(), dpi=dpi)
    with written_whole(path) as temporary:
        temporary.write_bytes(content.getvalue())
    return path


def _text(name: str) -> str:
    """A name as matplotlib shows it letter by letter: no formulas, no bytes of no text, no hidden label."""
    shown = name.encode("utf-8", "replace").decode().replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def _curve(errors: Array, limit: float) -> tuple[Array, Array]:
    """Corners of the share of errors <= x for x up to `limit`; right where a step starts."""
    inside = errors[errors <= limit]
    shares = np.arange(len(inside) + 1) / max(len(errors), 1)
    return np.r_[0.0, inside, limit], np.r_[shares, shares[-1]]


def _draw_scene(
    axes: Any, view: PairView, poses: Mapping[str, tuple[Array, Array]], colours: Mapping[str, str]
) -> None:
    """In the axes of the true camera: right, forward, up."""
    frame = view.pose or next(iter(poses.values()), (np.eye(3), np.zeros(3)))
    cameras = {"true pose": (view.pose, "black")} if view.pose is not None else {}
    cameras |= {name: (pose, colours[name]) for name, pose in poses.items()}
    points = _upright(view.points3d, frame)
    axes.scatter(*points.T, s=4, color=QUIET, depthshade=False)
    centre = np.median(points, axis=0)
    depth = max(0.5 * float(np.linalg.norm(centre)), 1e-9)
    for name, (pose, colour) in cameras.items():
        corners = _upright(_frustum(pose, view.points2d, depth), frame)
        if np.linalg.norm(corners[0] - centre) > 6 * depth + np.linalg.norm(np.ptp(points, axis=0)):
            axes.plot([], [], color=colour, label=_text(f"{name} (too far away)"))
            continue
        path = [0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1]
        axes.plot(*corners[path].T, color=colour, lw=2.5 if name == "true pose" else 1.2, label=_text(name))
    axes.set_aspect("equal")
    axes.view_init(elev=25, azim=-60)
    axes.tick_params(labelsize=7)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.get_major_locator().set_params(nbins=4)
    axes.legend(loc="upper left", fontsize=8)


def _frustum(pose: tuple[Array, Array], points2d: Array, depth: float) -> Array:
    """Centre and corners of a camera in scene coordinates, as wide as its image points."""
    (left, top), (right, bottom) = points2d.min(0), points2d.max(0)
    corners = np.array([[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]]) * depth
    rotation, translation = pose
    return (corners - translation) @ rotation


def _upright(points: Array, frame: tuple[Array, Array]) -> Array:
    rotation, translation = frame
    x, y, z = (points @ rotation.T + translation).T
    return np.stack([x, z, -y], -1)


def _draw_reprojection(
    axes: "Axes", view: PairView, pose: tuple[Array, Array], colour: str, lines: Lines | None
) -> None:
    rotation, translation = pose
    camera = view.points3d @ rotation.T + translation
    front = camera[:, 2] > 0
    projected = np.where(front[:, None], camera[:, :2] / np.where(front, camera[:, 2], 1)[:, None], np.nan)
    match = np.full(len(projected), -1) if lines is None else getattr(view, lines)
    for i in np.flatnonzero((match >= 0) & front):
        right = view.match3d[i] in (match[i], -1)
        ends = np.stack([view.points2d[match[i]], projected[i]])
        axes.plot(*ends.T, color=QUIET if right else LIGHT[3], lw=0.7, ls="-" if right else ":", zorder=1)
    axes.plot(*projected.T, "x", color=colour, ms=5, zorder=4)
