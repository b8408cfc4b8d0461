"""Recall curves and pairs as matplotlib figures, for papers, notebooks and loggers.

Figures are made without pyplot: they need no display, no backend, and no closing. `plot_scene`, `plot_image` and
`plot_residuals` draw into given axes.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.files import interruptions_later, written_whole
from bpnp.report.page.charts import RECALLS, Error, sorted_errors, within
from bpnp.report.palette import DASHES, LIGHT, QUIET
from bpnp.report.photos import box_of
from bpnp.report.pictures import Lines, estimate_of, plot_image
from bpnp.report.results import Results
from bpnp.report.runs import read_runs, series_of
from bpnp.report.samples import Array, PairView

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")
POINTS = 981  # of a curve
LIMITS: dict[Error, float] = {
    "rotation_deg": 20.0,
    "translation": 1.0,
    "joint": 20.0,
    "reprojection_deg": 2.0,
}  # of the recall curves


def recall_curve(runs: Sequence[Path | str] | Mapping[str, Results]) -> "Figure":
    """Share of pairs with an error up to a threshold, for rotation, translation, both, and reprojection (paper Fig. 3).

    runs: results folders, or results by name. Raises ValueError if a folder cannot be read.
    """
    from matplotlib.figure import Figure

    runs = runs if isinstance(runs, Mapping) else read_runs(runs)
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    for axes, (key, limit) in zip(figure.subplots(1, 4, sharey=True), LIMITS.items(), strict=True):
        for own in series_of(runs):
            limits = np.linspace(0, limit, POINTS)
            shares = within(sorted_errors(runs[own.run], own.estimate, key), limits)
            axes.plot(limits, shares, **line_style(own.colour, own.dashes), label=_text(own.label))
        axes.set(xlabel=RECALLS[key][1].replace(", of", ",\nof"), ylim=(0, 1.01), xlim=(0, limit))
        axes.grid(alpha=0.3)
    figure.axes[0].yaxis.set_major_formatter(lambda share, _: f"{100 * share:.0f} %")
    figure.axes[0].set_ylabel("pairs within")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def line_style(colour: int, dashes: int) -> dict[str, Any]:
    """Matplotlib's options of a line from the indices of `styles`."""
    lengths = DASHES[dashes % len(DASHES)]
    return {"color": LIGHT[colour % len(LIGHT)], "linestyle": (0, lengths) if lengths else "-"}


def plot_pair(
    view: PairView, *, estimate: str | None = None, lines: Lines | None = "match3d", photo: Array | None = None
) -> "Figure":
    """A pair in space, points with true and estimated cameras, and in the image, seen and reprojected points.

    estimate, lines: see `plot_image`. photo: (h, w, 3)
    uint8 under the image points, undistorted, that fills `bpnp.report.photos.box_of(view)`. Raises ValueError for an
    unknown estimate.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), layout="constrained")
    figure.suptitle(_text(view.id), fontsize=10)
    plot_scene(figure.add_subplot(1, 2, 1, projection="3d"), view)
    box = None if photo is None else box_of(view)
    axes = plot_image(figure.add_subplot(1, 2, 2), view, estimate=estimate, lines=lines, photo=photo, box=box)
    name = estimate_of(view, estimate)
    found = name is not None and np.isfinite(np.c_[view.estimates[name]]).all()
    axes.set_title(_text(f"reprojected by {name}") if found else "no pose", fontsize=9)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False, fontsize=8)
    return figure


def plot_scene(axes: Any, view: PairView) -> Any:
    """3D points, true and estimated cameras, in the axes of the true camera (right, forward, up). Returns the axes.

    axes: a matplotlib axes with projection="3d".
    """
    colours = {name: LIGHT[i % len(LIGHT)] for i, name in enumerate(view.estimates)}
    poses = {name: pose for name, pose in view.estimates.items() if np.isfinite(np.c_[pose]).all()}
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
    return axes


def save_figure(figure: "Figure", path: Path | str, *, dpi: int = 110) -> Path:
    """Write a figure whole or not at all. Raises ValueError if the name does not end in .png, .svg or .pdf."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a file name that ends in {', '.join(SUFFIXES)}, got {path.name!r}")
    content = io.BytesIO()
    with interruptions_later():  # matplotlib would take Ctrl-C for an error of its input
        figure.savefig(content, format=path.suffix[1:].lower(), dpi=dpi)
    with written_whole(path) as temporary:
        temporary.write_bytes(content.getvalue())
    return path


def _text(name: str) -> str:
    """A name as matplotlib shows it letter by letter: no formulas, no bytes of no text, no hidden label."""
    shown = name.encode("utf-8", "replace").decode().replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def _frustum(pose: tuple[Array, Array], points2d: Array, depth: float) -> Array:
    """Centre and corners of a camera in scene coordinates, as wide as its image points."""
    (left, top), (right, bottom) = np.nanmin(points2d, axis=0), np.nanmax(points2d, axis=0)
    corners = np.array([[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]]) * depth
    rotation, translation = pose
    return (corners - translation) @ rotation


def _upright(points: Array, frame: tuple[Array, Array]) -> Array:
    rotation, translation = frame
    x, y, z = (points @ rotation.T + translation).T
    return np.stack([x, z, -y], -1)
