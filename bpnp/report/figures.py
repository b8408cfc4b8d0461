"""Recall curves and problems as matplotlib figures, for papers, notebooks and loggers.

Figures are made without pyplot, so they need no display, no backend, and no closing. `plot_scene`, `plot_image` and
`plot_residuals` draw into given axes. An image and its residuals are in pixels of the problem's camera, or in
normalised coordinates without a camera.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.arrays import AnyArray
from bpnp.cameras import in_front
from bpnp.report.charts import Error, axis_title, recall_of
from bpnp.report.images import size_in_camera
from bpnp.report.points import ProblemPoints, utf8
from bpnp.report.results import Results
from bpnp.report.tables import lines_of, paper_quartiles, read_runs
from bpnp.report.terminal import DASHES, INKS, LIGHT, QUIET, Paper, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

TRUE_POSE = INKS["text"][0]  # colour of the true camera; that of no estimate is near it
POINTS = 981  # points of a curve
NUMBERED = 40  # largest number of 3D points whose indices are drawn
MARGIN = 0.15  # margin around the image points, relative to their extent
ACROSS, PANEL = 3, 4.5  # photos in a row, and width of each, inches
WIDTH, CLOSE_UP, CAPTIONS = 10.0, 3.5, 1.6  # width of an image, of its residuals, and height of the captions, inches
LIMITS: dict[Error, float] = {"rotation_deg": 20.0, "translation": 1.0, "joint": 20.0, "reprojection_deg": 2.0}
Lines = Literal["match3d", "assigned3d"]


def recall_curve(runs: Sequence[Path | str] | Mapping[str, Results], *, paper: Paper | None = None) -> "Figure":
    """Draw the fraction of problems with an error up to a threshold (paper Fig. 3).

    The panels are rotation, translation, both, and reprojection.

    Args:
        runs: Results folders, or results by name.
        paper: Table of the paper whose quartiles are drawn as rings, "modelnet40" or "megadepth". Default: None, no
            rings.

    Returns:
        The figure.

    Raises:
        ValueError: A folder cannot be read.
    """
    from matplotlib.figure import Figure

    runs = runs if isinstance(runs, Mapping) else read_runs(runs)
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    for axes, (key, limit) in zip(figure.subplots(1, 4, sharey=True), LIMITS.items(), strict=True):
        limits = np.linspace(0, limit, POINTS)
        for line in lines_of(runs):
            fractions = recall_of(runs, line, key, limits)
            axes.plot(limits, fractions, **line_style(line.colour, line.dashes), label=shown_text(line.label))
        for marker, (name, quartiles) in zip("osD^", paper_quartiles(paper, key).items(), strict=False):
            axes.plot(quartiles, [0.25, 0.5, 0.75], marker, mfc="none", color=QUIET, label=f"paper: {name}")
        axes.set(xlabel=axis_title(runs, key).replace(", of", ",\nof"), ylim=(0, 1.01), xlim=(0, limit))
        axes.grid(alpha=0.3)
    figure.axes[0].yaxis.set_major_formatter(lambda fraction, _: f"{100 * fraction:.0f} %")
    figure.axes[0].set_ylabel("problems within")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def outlier_curves(frame: "DataFrame") -> "Figure":
    """Draw median rotation error and recall of a `table_frame` against the outlier ratio, a curve for each method.

    Rows without an outlier ratio, and standard deviations, are not drawn.
    """
    from matplotlib.figure import Figure

    drawn = frame[frame.rho.notna() & ~frame.method.str.contains("standard deviation")].astype({"rho": float})
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, key, scale in zip(
        figure.subplots(1, 2), ("rotation_q2_deg", "recall_joint_15deg_0.5"), (1, 100), strict=True
    ):
        for i, (method, rows) in enumerate(drawn.sort_values("rho").groupby("method", sort=False)):
            style = line_style(i, i // len(LIGHT)) | {"marker": "o", "ms": 3.5, "label": shown_text(str(method))}
            axes.plot(rows.rho, scale * rows[key].astype(float), **style)
        axes.set_xlabel("outliers per match, on both sides")
        axes.grid(alpha=0.3)
    figure.axes[0].set(yscale="log", ylabel="median rotation error, degrees", ylim=(None, 1.2 * 180))
    figure.axes[1].set(ylabel="% of problems within 15 degrees and 0.5", ylim=(0, 101))
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def line_style(colour: int, dashes: int) -> dict[str, Any]:
    """Return matplotlib's options of a line."""
    lengths = DASHES[dashes % len(DASHES)]
    return {"color": LIGHT[colour % len(LIGHT)], "linestyle": (0, lengths) if lengths else "-"}


def plot_problem(problem: ProblemPoints, *, estimate: str | None = None, lines: Lines | None = "match3d") -> "Figure":
    """Draw a problem in space, with true and estimated cameras, and in the image, with reprojected points.

    Args:
        problem: Problem.
        estimate: As in `plot_image`.
        lines: As in `plot_image`.

    Returns:
        The figure.

    Raises:
        ValueError: The estimate is unknown.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), layout="constrained")
    figure.suptitle(shown_text(problem.id), fontsize=10)
    plot_scene(figure.add_subplot(1, 2, 1, projection="3d"), problem)
    axes = plot_image(figure.add_subplot(1, 2, 2), problem, estimate=estimate, lines=lines)
    name, pose = _estimate(problem, estimate)
    axes.set_title(shown_text(f"reprojected by {name}") if np.isfinite(np.c_[pose]).all() else "no pose", fontsize=9)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False, fontsize=8)
    return figure


def plot_photo(problem: ProblemPoints, photo: AnyArray, *, estimates: Sequence[str] | None = None) -> "Figure":
    """Draw the 3D points over a photo (h, w, 3), uint8, as each pose projects them, an image per estimate.

    As in Fig. 4 of the paper, rings are the image points. The titles have the errors of the poses, if the true pose is
    known. Raise ValueError if the camera is missing or of another image shape, or an estimate is unknown.
    """
    from matplotlib.figure import Figure

    names = list(problem.estimates) if estimates is None else list(estimates)
    columns = min(len(names), ACROSS)
    rows = -(-len(names) // columns)
    width, height = size_in_camera(photo, problem.camera)
    size = (PANEL * columns, rows * (PANEL * height / width + 0.5) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(names) :]:
        axes.remove()
    for axes, name in zip(panels[: len(names)], names, strict=True):
        plot_image(axes, problem, estimate=name, lines=None, photo=photo)
        axes.set_title(shown_text(f"{name}: {_outcome(problem, name)}"), fontsize=10)
    figure.suptitle(shown_text(problem.id), fontsize=10)
    return figure


def _outcome(problem: ProblemPoints, estimate: str) -> str:
    """Describe the pose of an estimate by its errors."""
    rotation, translation = problem.estimates[estimate]
    if not np.isfinite(np.c_[rotation, translation]).all():
        return "no pose"
    if problem.pose is None:
        return "a pose"
    angle = np.degrees((Rotation.from_matrix(problem.pose[0]).inv() * Rotation.from_matrix(rotation)).magnitude())
    return f"{number(float(angle))} deg, {number(float(np.linalg.norm(translation - problem.pose[1])))}"


def plot_scene(axes: Any, problem: ProblemPoints) -> Any:
    """Draw 3D points, true and estimated cameras, in the axes of the true camera (right, forward, up).

    Args:
        axes: Matplotlib axes with projection="3d".
        problem: Problem.

    Returns:
        The axes.
    """
    colours = dict(zip(problem.estimates, cycle(LIGHT), strict=False))
    poses = {name: pose for name, pose in problem.estimates.items() if np.isfinite(np.c_[pose]).all()}
    frame = problem.pose or next(iter(poses.values()), (np.eye(3), np.zeros(3)))
    cameras = {"true pose": (problem.pose, TRUE_POSE)} if problem.pose is not None else {}
    cameras |= {name: (pose, colours[name]) for name, pose in poses.items()}
    points = _upright(problem.points3d, frame)
    axes.scatter(*points.T, s=4, color=QUIET, depthshade=False)
    centre = np.median(points, axis=0)
    depth = max(0.5 * float(np.linalg.norm(centre)), 1e-9)
    (left, top), (right, bottom) = np.nanmin(problem.points2d, axis=0), np.nanmax(problem.points2d, axis=0)
    frustum = np.array([[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]]) * depth
    for name, ((rotation, translation), colour) in cameras.items():
        corners = _upright((frustum - translation) @ rotation, frame)
        if np.linalg.norm(corners[0] - centre) > 6 * depth + np.linalg.norm(np.ptp(points, axis=0)):
            axes.plot([], [], color=colour, label=shown_text(f"{name} (too far away)"))
            continue
        path = [0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1]
        axes.plot(*corners[path].T, color=colour, lw=2.5 if name == "true pose" else 1.2, label=shown_text(name))
    axes.set_aspect("equal")
    axes.view_init(elev=25, azim=-60)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("right, scene units", fontsize=8)
    axes.set_ylabel("forward", fontsize=8)
    axes.set_zlabel("up", fontsize=8)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.get_major_locator().set_params(nbins=4)
    axes.legend(loc="upper left", fontsize=8)
    return axes


def plot_image(
    axes: "Axes", problem: ProblemPoints, *, estimate: str | None = None, lines: Lines | None = "match3d",
    photo: AnyArray | None = None,
) -> "Axes":  # fmt: skip
    """Draw rings around image points, crosses at projected 3D points, and lines between matches.

    Points whose normals face away from the camera are small dots. The indices of 3D points are drawn if there are at
    most 40.

    Args:
        axes: Matplotlib axes.
        problem: Problem.
        estimate: Name of the estimate whose pose projects the 3D points. Default: the first.
        lines: Draw lines to the true matches ("match3d"), or to those assigned by the solver ("assigned3d"), which are
            also drawn for a problem without true matches. Assigned matches that are not true are dotted. None: no
            lines.
        photo: Photo by the problem's camera (h, w, 3), uint8, drawn under the points. 3D points without a match are
            then left out.

    Returns:
        The axes.

    Raises:
        ValueError: There is a photo but no camera, or no image point in front of the camera.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    image, projected, targets, colour = _prepare_drawing(problem, estimate, lines)
    if photo is not None and problem.camera is None:
        raise ValueError("the problem has no camera, which is needed to draw a photo under its points")
    left, top, right, bottom = _extent(image) if photo is None else (0, 0, *size_in_camera(photo, problem.camera))
    size = float(np.clip(80 / np.sqrt(len(image)), 2, 7))
    rim = "black" if photo is None else "white"
    rims = axes.plot(*image.T, "o", mfc="none", mec=rim, mew=0.7, ms=size, label="image points", zorder=3)
    if photo is not None:
        axes.imshow(photo, extent=(left, right, bottom, top), zorder=0)
        rims[0].set_path_effects([withStroke(linewidth=1.7, foreground="black")])  # for bright photos and the legend
    visible = np.isfinite(projected).all(-1)
    linked = visible & (targets >= 0)
    matched = visible if lines is None else linked
    away = _facing_away(problem, estimate) & visible & ~matched
    free = visible & ~matched & ~away
    if matched.any():
        points = projected[matched].T
        crosses = axes.plot(*points, "x", color=colour, ms=size, mew=0.9, label="3D points, matched", zorder=4)
        if photo is not None:
            crosses[0].set_path_effects([withStroke(linewidth=2.2, foreground="white")])  # for photos of its colour
        wrong = linked & (problem.match3d != targets) & (problem.match3d >= 0)
        for some, ink, style in ((linked & ~wrong, colour, "-"), (wrong, LIGHT[3], ":")):
            if some.any():
                ends = np.stack([image[targets[some]], projected[some]], 1)
                axes.add_collection(LineCollection(list(ends), colors=ink, linestyles=style, linewidths=0.8, zorder=2))
    if free.any() and photo is None:
        axes.plot(*projected[free].T, "x", color=LIGHT[3], ms=size, mew=0.6, label="3D points, no match", zorder=1)
    if away.any() and photo is None:
        axes.plot(*projected[away].T, ".", color=QUIET, ms=size / 2, label="3D points, facing away", zorder=1)
    if len(projected) <= NUMBERED:
        shown = matched if photo is not None else visible
        for index in np.flatnonzero(
            shown & (projected >= (left, top)).all(-1) & (projected <= (right, bottom)).all(-1)
        ):
            ink = QUIET if away[index] else LIGHT[3] if free[index] else rim
            text = str(problem.numbers()[1][index])
            axes.annotate(text, projected[index], (4, 4), textcoords="offset points", fontsize=7, color=ink, zorder=5)
    unit = _unit(problem)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel=unit, ylabel=unit)
    axes.tick_params(labelsize=8)
    return axes


def plot_residuals(
    axes: "Axes", problem: ProblemPoints, *, estimate: str | None = None, lines: Lines = "match3d"
) -> "Axes":
    """Draw image point minus projected 3D point of each match.

    Args:
        axes: Matplotlib axes.
        problem: Problem.
        estimate: As in `plot_image`.
        lines: Matches to draw, as in `plot_image`.

    Returns:
        The axes.
    """
    image, projected, targets, colour = _prepare_drawing(problem, estimate, lines)
    matched = targets >= 0
    residuals = image[targets[matched]] - projected[matched]
    if not np.isfinite(residuals).any():
        axes.set_axis_off()
        return axes
    reach = 1.1 * float(np.nanmax(np.abs(residuals))) or 1.0
    axes.plot(*residuals.T, ".", color=colour, ms=4)
    axes.axhline(0, color=QUIET, lw=0.5)
    axes.axvline(0, color=QUIET, lw=0.5)
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    axes.set_title(f"residuals, {_unit(problem)}", fontsize=9)
    axes.tick_params(labelsize=7)
    return axes


def plot_matches(
    problem: ProblemPoints, *, colour: str, photo: AnyArray | None = None, competing: ProblemPoints | None = None
) -> "Figure":
    """Draw the image of a problem and a close-up of its residuals, under its id in a colour.

    `competing` is the problem with another estimate, drawn next to it.
    """
    from matplotlib.figure import Figure

    figure, drawn = Figure(layout="constrained"), [problem] if competing is None else [problem, competing]
    widths = (*[WIDTH / len(drawn)] * len(drawn), CLOSE_UP / len(drawn))
    *images, close = figure.subplots(1, len(widths), width_ratios=widths)
    for axes, one in zip(images, drawn, strict=True):
        plot_image(axes, one, photo=photo)
    if competing is not None:
        images[0].set_title("best pose", fontsize=9)
        images[1].set_title(shown_text(competing.id), fontsize=9)
    axes = images[0]
    plot_residuals(close, problem)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    height = float(np.clip(widths[0] * (bottom - top) / (right - left), 3, 8))
    figure.set_size_inches(sum(widths), height + CAPTIONS)
    figure.suptitle(shown_text(problem.id), fontsize=10, color=colour)
    entries = {label: handle for one in images for handle, label in zip(*one.get_legend_handles_labels(), strict=True)}
    figure.legend([*entries.values()], [*entries], loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def _estimate(problem: ProblemPoints, estimate: str | None) -> tuple[str, tuple[AnyArray, AnyArray]]:
    """Return the name and the pose of an estimate, by default the first; the pose is NaN if there is none."""
    if estimate is not None and estimate not in problem.estimates:
        raise ValueError(f"there is no estimate {estimate!r}; the estimates are {list(problem.estimates)}")
    name = estimate or next(iter(problem.estimates), "")
    return name, problem.estimates.get(name, (np.full((3, 3), np.nan), np.full(3, np.nan)))


def _prepare_drawing(
    problem: ProblemPoints, estimate: str | None, lines: Lines | None
) -> tuple[AnyArray, AnyArray, AnyArray, str]:
    """Return image points (m, 2), projected 3D points (n, 2), links (n,) and the colour of the estimate.

    Points are in the units of the axes; projected ones are NaN without a pose. A link is the index of the image point
    that a 3D point is drawn to, -1 for none.
    """
    name, (rotation, translation) = _estimate(problem, estimate)
    image = problem.points2d
    projected = in_front(np.asarray(problem.points3d, float) @ rotation.T + translation)[:, :2]
    if problem.camera is not None:
        image, projected = (
            problem.camera.project(np.column_stack([points, np.ones(len(points))])) for points in (image, projected)
        )
    if lines == "match3d" and (problem.match3d < 0).all():
        lines = "assigned3d"
    targets = np.full(len(projected), -1) if lines is None else getattr(problem, lines)
    order = [*problem.estimates].index(name) if name else 0
    return image, projected, targets, LIGHT[order % len(LIGHT)]


def _facing_away(problem: ProblemPoints, estimate: str | None) -> AnyArray:
    """Return which 3D points (n,) have normals that face away from the camera of an estimate; none without normals."""
    if problem.normals3d is None:
        return np.zeros(len(problem.points3d), bool)
    rotation, translation = _estimate(problem, estimate)[1]
    camera = np.asarray(problem.points3d, float) @ rotation.T + translation
    return np.asarray(((problem.normals3d @ rotation.T) * camera).sum(-1) >= 0)


def _extent(points2d: AnyArray) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of the image points, with a margin."""
    finite = points2d[np.isfinite(points2d).all(-1)].astype(float)
    if not len(finite):
        raise ValueError("the problem has no image point in front of the camera to draw")
    low, high = finite.min(0), finite.max(0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return *(low - margin).tolist(), *(high + margin).tolist()


def _unit(problem: ProblemPoints) -> str:
    return "normalised coordinates" if problem.camera is None else "pixels"


def shown_text(name: str) -> str:
    """Escape a name for matplotlib: no formulas, no bytes that are not text, no hidden label."""
    shown = utf8(name).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def _upright(points: AnyArray, frame: tuple[AnyArray, AnyArray]) -> AnyArray:
    """Transform scene points to the axes right, forward, up of a camera."""
    rotation, translation = frame
    x, y, z = (points @ rotation.T + translation).T
    return np.stack([x, z, -y], -1)
