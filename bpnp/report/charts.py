"""Plotly figures of the page: recall curves, and figures that the page fills with a problem or with two runs.

In a notebook: `recall_chart({"mine": results}, "rotation_deg").show()`. Colours are those of the light scheme; the page
replaces them for the dark one.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from bpnp.arrays import AnyArray
from bpnp.metrics import joint_error, recall_at
from bpnp.report.results import Results
from bpnp.report.tables import Line, joint_limits, lines_of, paper_quartiles
from bpnp.report.terminal import DASHES, INKS, LIGHT, Paper

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Error = Literal["rotation_deg", "translation", "joint", "reprojection_deg"]
POINTS = 200  # points of a curve
RECALLS: dict[Error, tuple[str, str, float]] = {
    "rotation_deg": ("Rotation", "rotation error, degrees", 90.0),
    "translation": ("Translation", "translation error, scene units", 10.0),
    "joint": ("Rotation and translation", "rotation error, degrees, of problems within {:g} scene units", 90.0),
    "reprojection_deg": ("Reprojection", "reprojection error, degrees", 20.0),
}
PAPER_MARKS = ("circle-open", "square-open", "diamond-open", "triangle-up-open")  # of the paper's networks
INK = {name: light for name, (light, _) in INKS.items()}
CLEAR = "rgba(0,0,0,0)"
GRID = {"gridcolor": INK["line"], "zerolinecolor": INK["line"]}
HIDDEN = ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d", "tableRotation", "resetCameraLastSave3d"]
CONFIG = {  # plotly's options of every figure
    "responsive": True,
    "displaylogo": False,
    "toImageButtonOptions": {"scale": 2, "filename": "bpnp"},
    "modeBarButtonsToRemove": HIDDEN,
}


def axis_title(runs: Mapping[str, Results], error: Error) -> str:
    """Return the title of the axis of an error; "joint" has the translation limit of `joint_limits`."""
    return RECALLS[error][1].format(joint_limits(runs)[1])


def errors_of(runs: Mapping[str, Results], line: Line, error: Error) -> torch.Tensor:
    """Return the errors of the problems that have one (not NaN).

    In "joint", the rotation error of a problem beyond the translation limit of `joint_limits` is infinite.
    """
    errors = runs[line.run].errors(line.estimate)
    values: torch.Tensor = joint_error(errors, joint_limits(runs)[1]) if error == "joint" else getattr(errors, error)
    return values[~values.isnan()]


def recall_of(runs: Mapping[str, Results], line: Line, error: Error, limits: AnyArray) -> AnyArray:
    """Return the fraction (k,) of problems with an error up to each limit (k,)."""
    return recall_at(errors_of(runs, line, error), limits.tolist()).numpy()


def import_plotly() -> Any:
    """Return the module plotly; raise ValueError without it, since only the page and dashboards need it."""
    try:
        import plotly
        import plotly.graph_objects
        import plotly.offline
    except ImportError as error:
        raise ValueError(
            "the page of `bpnp report` and the charts of `bpnp wandb` need plotly; install it with `pip install plotly`"
        ) from error
    return plotly


def recall_chart(runs: Mapping[str, Results], error: Error, *, paper: Paper | None = None) -> "Figure | None":
    """Draw the fraction of problems with an error up to a threshold, on a logarithmic axis (paper Fig. 3).

    Rings are the quartiles in the table `paper`. The result is None if no problem has an error of this kind.
    """
    plotly = import_plotly()
    title, _, most = RECALLS[error]
    every = np.concatenate([errors_of(runs, line, error).numpy() for line in lines_of(runs)])
    if not len(every):
        return None
    drawn = every[np.isfinite(every) & (every > 0)]  # an axis of logarithms has no place for the others
    low = max(float(np.quantile(drawn, 0.01)) if len(drawn) else 0.0, most / 1e5)
    if error != "translation":  # an axis of angles ends where most poses are wrong, also if all of them are
        low = min(low, most / 2)
    limits = np.geomspace(low, max(most, 2 * low), POINTS)
    figure = plotly.graph_objects.Figure(
        layout={"title": {"text": title}, "hovermode": "x unified", "template": "none"}
    )
    figure.update_yaxes(title={"text": "problems up to this error"}, range=[0, 1.01], tickformat=".0%")
    # On one to two decades plotly labels every digit, and the labels overlap; with fewer ticks it labels 1, 2 and 5.
    decades = float(np.log10(limits[-1] / limits[0]))
    few = {"nticks": int(decades / 0.31)} if 1 <= decades < 2.2 else {}  # at least 0.3 decades between labels
    axis = axis_title(runs, error).replace(", of", ",<br>of")  # a phone shows half of it in a line
    figure.update_xaxes(title={"text": axis}, hoverformat=".3~g", type="log", tickformat="~g", **few)
    for index, line in enumerate(lines_of(runs)):
        dash = ",".join(f"{length:g}px" for length in DASHES[line.dashes % len(DASHES)]) or "solid"
        style = {"color": LIGHT[line.colour % len(LIGHT)], "dash": dash, "width": 2}
        fractions = recall_of(runs, line, error, limits)
        points = {"x": limits.astype(np.float32), "y": fractions.astype(np.float32)}
        # `meta` identifies the estimate of the line for the page.
        figure.add_scatter(**points, name=line.label, mode="lines", meta=index, line=style, hovertemplate="%{y:.1%}")
    for index, (name, quartiles) in enumerate(paper_quartiles(paper, error).items()):
        marker = {"symbol": PAPER_MARKS[index], "size": 8, "color": INK["quiet"], "line": {"width": 1.5}}
        points = {"x": np.array(quartiles, np.float32), "y": np.array([0.25, 0.5, 0.75], np.float32)}
        figure.add_scatter(**points, name=f"paper: {name}", mode="markers", marker=marker, hovertemplate="%{y:.0%}")
    return figure


def chart_text(figure: "Figure") -> str:
    """Describe a chart for screen readers: the last value of each line."""
    ends = [f"{trace.name} ends at {trace.y[-1]:.1%}" for trace in figure.data if trace.mode == "lines"]
    return f"{figure.layout.title.text}: {'; '.join(ends)}"


def look() -> dict[str, Any]:
    """Return the plotly template of all figures."""
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
    """Return the figures that the page fills, by the id of their element."""
    degrees = {"type": "log", "tickformat": "~g", "dtick": "D2"}
    diagonal = {"type": "line", "x0": 0, "y0": 0, "x1": 1, "y1": 1, "xref": "paper", "yref": "paper"}
    diagonal |= {"line": {"color": INK["quiet"], "width": 1, "dash": "dash"}}
    hover = "%{text}<br>%{x:.3g} against %{y:.3g} deg<extra></extra>"
    versus = (
        [_marks(size=5, color=INK["text"], opacity=0.5) | {"hovertemplate": hover}],
        {
            "title": {"text": "Rotation errors"},
            "xaxis": degrees,
            "yaxis": degrees | {"matches": "x"},  # equal ranges, so that the diagonal is x = y
            "shapes": [diagonal],
        },
    )
    directions = {"xaxis": "right", "yaxis": "forward", "zaxis": "up"}  # of the true camera
    axes = {axis: {"title": {"text": direction}} for axis, direction in directions.items()}
    view = {"aspectmode": "data", "dragmode": "orbit", "camera": {"eye": {"x": 1.3, "y": -2.1, "z": 0.9}}}
    space: list[dict[str, Any]] = [_marks(size=3.5, line={"width": 0}), _selected_point(18)]
    scene = (
        [mark | {"type": "scatter3d"} for mark in space],
        {"margin": dict.fromkeys("lrtb", 0), "scene": axes | view},
    )
    axis: dict[str, Any] = {"constrain": "domain", "zeroline": False}
    lines = [_lines(color=INK["quiet"]), _lines(color=INK["wrong"], dash="dot")]
    image = (
        [*lines, _marks(symbol="circle-open"), _marks(symbol="x-thin"), _selected_point(16)],
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


def _selected_point(size: int) -> dict[str, Any]:
    marker = {"symbol": "circle-open", "color": INK["wrong"], "line": {"width": 2}, "size": size}
    return {"mode": "markers", "hoverinfo": "skip", "marker": marker}


def _lines(**line: Any) -> dict[str, Any]:
    return {"mode": "lines", "hoverinfo": "skip", "opacity": 0.7, "line": {"width": 1, **line}}
