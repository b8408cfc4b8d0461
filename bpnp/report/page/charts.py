"""The charts of the page as plotly figures, for notebooks too: recall, errors against the size, time; and the figures
that the page fills with a problem or with two runs.

Each chart takes results by name and returns a `plotly.graph_objects.Figure`, or None where there is nothing to draw:
`recall_chart(results, "rotation_deg").show()`. Colours are those of the light scheme, which the page replaces where the
dark one is asked for.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from bpnp.metrics import joint_error, recall_curve
from bpnp.report.palette import DASHES, INKS, LIGHT
from bpnp.report.results import Results
from bpnp.report.runs import Line, lines_of

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Error = Literal["rotation_deg", "translation", "joint", "reprojection_deg"]
Array = npt.NDArray[Any]
POINTS = 200  # of a curve
GROUPS = 16  # of problems of similar size
RECALLS: dict[Error, tuple[str, str, float]] = {
    "rotation_deg": ("Rotation", "rotation error, degrees", 90.0),
    "translation": ("Translation", "translation error, scene units", 10.0),
    "joint": ("Rotation and translation", "rotation error, degrees, of problems within 0.5 scene units", 90.0),
    "reprojection_deg": ("Reprojection", "reprojection error, degrees", 20.0),
}
JOINT_TRANSLATION = 0.5
INK = {name: light for name, (light, _) in INKS.items()}
CLEAR = "rgba(0,0,0,0)"
GRID = {"gridcolor": INK["line"], "zerolinecolor": INK["line"]}
HIDDEN = ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d", "tableRotation", "resetCameraLastSave3d"]
CONFIG = {  # of every figure
    "responsive": True,
    "displaylogo": False,
    "toImageButtonOptions": {"scale": 2, "filename": "bpnp"},
    "modeBarButtonsToRemove": HIDDEN,
}
SIZES = {"m": "2D points", "n": "3D points", "matches": "true matches"}


def errors_of(results: Results, estimate: str, error: Error) -> torch.Tensor:
    """Errors of the problems that have one; in the joint curve one that is too far away is infinite."""
    errors = results.errors(estimate)
    values: torch.Tensor = joint_error(errors, JOINT_TRANSLATION) if error == "joint" else getattr(errors, error)
    return values[~values.isnan()]


def recall_of(results: Results, estimate: str, error: Error, limits: Array) -> Array:
    """Share of these problems with an error up to each limit."""
    return recall_curve(errors_of(results, estimate, error), limits.tolist()).numpy()


def recall_chart(runs: Mapping[str, Results], error: Error) -> "Figure | None":
    """Share of problems with an error up to a threshold, on a logarithmic axis (paper Fig. 3)."""
    title, unit, most = RECALLS[error]
    finite = np.concatenate([errors_of(runs[line.run], line.estimate, error).numpy() for line in lines_of(runs)])
    finite = finite[np.isfinite(finite) & (finite > 0)]
    if not len(finite):
        return None
    low = max(float(np.quantile(finite, 0.01)), most / 1e5)
    limits = np.geomspace(low, max(most, 2 * low), POINTS)
    figure = _figure(title, unit, "problems up to this error", share=True)
    for place, line in enumerate(lines_of(runs)):
        _add(figure, place, line, limits, recall_of(runs[line.run], line.estimate, error, limits), "%{y:.1%}")
    return _logarithmic(figure)


def error_chart(runs: Mapping[str, Results], size: str) -> "Figure | None":
    """Median rotation error of groups of problems of similar `size` ("m", "n" or "matches")."""
    figure = _figure(f"Median rotation error against {SIZES[size]}", SIZES[size], "degrees")
    figure.update_yaxes(type="log")
    for place, line in enumerate(lines_of(runs)):
        frame = runs[line.run].frame().query("estimate == @line.estimate")
        if frame[size].nunique() < 3:
            continue
        edges = np.unique(np.quantile(frame[size], np.linspace(0, 1, GROUPS + 1)[1:-1]))
        groups = frame.groupby(np.searchsorted(edges, frame[size]))
        medians = groups.rotation_error_deg.median().clip(lower=1e-6)
        _add(figure, place, line, groups[size].median(), medians, "%{y:.3g} deg")
    return _logarithmic(figure) if figure.data else None


def time_chart(runs: Mapping[str, Results]) -> "Figure | None":
    """Share of problems done within a time; the estimates of a run are made together and share it."""
    first: dict[str, tuple[int, Line]] = {}
    for place, line in enumerate(lines_of(runs)):
        first.setdefault(line.run, (place, line._replace(label=line.run)))
    times = [torch.tensor([row.seconds for row in runs[run].of(line.estimate)]) for run, (_, line) in first.items()]
    positive = torch.cat([seconds[seconds > 0] for seconds in times])
    if not len(positive):
        return None
    limits = np.geomspace(float(positive.min()) * 0.9, float(positive.max()) * 1.1, POINTS)
    figure = _figure("Problems done within a time", "seconds per problem", "problems within", share=True)
    for (place, line), seconds in zip(first.values(), times, strict=True):
        _add(figure, place, line, limits, recall_curve(seconds, limits.tolist()), "%{y:.1%}")
    return _logarithmic(figure)


def chart_text(figure: "Figure") -> str:
    """What a chart shows in words, for screen readers: the last value of each line."""
    form = ".1%" if figure.layout.yaxis.tickformat else ".3g"
    ends = [f"{trace.name} ends at {trace.y[-1]:{form}}" for trace in figure.data if len(trace.y)]
    return f"{figure.layout.title.text}: {'; '.join(ends)}"


def page_charts(runs: Mapping[str, Results]) -> "dict[str, list[Figure]]":
    """The charts of the page by heading; headings without one are left out."""
    charts = {
        "Recall": [recall_chart(runs, error) for error in RECALLS],
        "Errors against size": [error_chart(runs, size) for size in SIZES],
        "Time": [time_chart(runs)],
    }
    known = {name: [chart for chart in several if chart is not None] for name, several in charts.items()}
    return {name: several for name, several in known.items() if several}


def _figure(title: str, x: str, y: str, *, share: bool = False) -> "Figure":
    from plotly.graph_objects import Figure

    figure = Figure(layout={"title": {"text": title}, "hovermode": "x unified", "template": "none"})
    figure.update_xaxes(title={"text": x}, hoverformat=".3~g")
    return figure.update_yaxes(title={"text": y}, **({"range": [0, 1.01], "tickformat": ".0%"} if share else {}))


def _logarithmic(figure: "Figure") -> "Figure":
    """The figure with a logarithmic x axis.

    Of one to two decades plotly labels every digit, which overlap, unless it is asked for fewer: then 1, 2 and 5.
    """
    x = np.concatenate([trace.x for trace in figure.data])
    decades = float(np.log10(x.max() / x.min()))
    few = {"nticks": int(decades / 0.31)} if 1 <= decades < 2.2 else {}  # more than 0.3 decades a label
    return figure.update_xaxes(type="log", tickformat="~g", **few)


def _add(figure: "Figure", place: int, line: Line, x: Any, y: Any, hover: str) -> None:
    """Add a line; by the place of its estimate the page finds it."""
    dash = ",".join(f"{length:g}px" for length in DASHES[line.dashes % len(DASHES)]) or "solid"
    style = {"color": LIGHT[line.colour % len(LIGHT)], "dash": dash, "width": 2}
    points = {"x": np.asarray(x, np.float32), "y": np.asarray(y, np.float32)}
    figure.add_scatter(**points, name=line.label, mode="lines", meta=place, line=style, hovertemplate=hover)


def look() -> dict[str, Any]:
    """The plotly template of every figure."""
    axis = GRID | {"linecolor": INK["quiet"], "automargin": True}
    axis3d = GRID | {"color": INK["quiet"], "backgroundcolor": CLEAR, "showspikes": False}
    layout = {
        "margin": {"l": 50, "r": 12, "t": 44, "b": 40},
        "showlegend": False,
        "paper_bgcolor": CLEAR,
        "plot_bgcolor": CLEAR,
        "font": {"color": INK["text"], "size": 11},
        "hoverlabel": {"namelength": 60, "bgcolor": INK["panel"], "font": {"color": INK["text"]}},
        "modebar": {"bgcolor": CLEAR, "color": INK["quiet"], "activecolor": INK["focus"]},
        "title": {"x": 0.02, "xanchor": "left", "font": {"size": 13}},
        "xaxis": axis,
        "yaxis": axis,
        "scene": {"xaxis": axis3d, "yaxis": axis3d, "zaxis": axis3d},
    }
    return {"layout": layout}


def figures() -> dict[str, dict[str, Any]]:
    """By the id of their element: run against run, a problem in space, a problem in the image."""
    degrees = {"type": "log", "tickformat": "~g", "dtick": "D2"}
    diagonal = {"type": "line", "x0": 0, "y0": 0, "x1": 1, "y1": 1, "xref": "paper", "yref": "paper"}
    diagonal |= {"line": {"color": INK["quiet"], "width": 1, "dash": "dash"}}
    hover = "%{text}<br>%{x:.3g} against %{y:.3g} deg<extra></extra>"
    versus = (
        [_marks(size=5, color=INK["text"], opacity=0.5) | {"hovertemplate": hover}],
        {
            "title": {"text": "Rotation error of each problem"},
            "xaxis": degrees,
            "yaxis": degrees | {"matches": "x"},  # so that the diagonal of the picture is x = y
            "shapes": [diagonal],
        },
    )
    directions = {"xaxis": "right", "yaxis": "forward", "zaxis": "up"}  # of the true camera
    axes = {axis: {"title": {"text": direction}} for axis, direction in directions.items()}
    view = {"aspectmode": "data", "dragmode": "orbit", "camera": {"eye": {"x": 1.3, "y": -2.1, "z": 0.9}}}
    space: list[dict[str, Any]] = [_marks(size=3.5, line={"width": 0}), _picked(18)]
    scene = (
        [mark | {"type": "scatter3d"} for mark in space],
        {
            "margin": dict.fromkeys("lrtb", 0),
            "scene": axes | view,
        },
    )
    axis: dict[str, Any] = {"constrain": "domain", "zeroline": False}
    lines = [_lines(color=INK["quiet"]), _lines(color=INK["wrong"], dash="dot")]
    image = (
        [*lines, _marks(symbol="circle-open"), _marks(symbol="x-thin"), _picked(16)],
        {
            "margin": {"l": 40, "r": 10, "t": 10, "b": 30},
            "dragmode": "pan",
            "xaxis": axis,
            "yaxis": axis | {"scaleanchor": "x"},
        },
    )
    drawn: dict[str, tuple[Any, dict[str, Any]]] = {"versus": versus, "scene": scene, "image": image}
    return {name: {"data": data, "layout": {"hovermode": "closest"} | layout} for name, (data, layout) in drawn.items()}


def _marks(**marker: Any) -> dict[str, Any]:
    return {"type": "scatter", "mode": "markers", "marker": marker, "hovertemplate": "%{text}<extra></extra>"}


def _picked(size: int) -> dict[str, Any]:
    marker = {"symbol": "circle-open", "color": INK["wrong"], "line": {"width": 2}, "size": size}
    return {"mode": "markers", "hoverinfo": "skip", "marker": marker}


def _lines(**line: Any) -> dict[str, Any]:
    return {"mode": "lines", "hoverinfo": "skip", "opacity": 0.7, "line": {"width": 1, **line}}
