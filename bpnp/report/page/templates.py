"""The figures that the page fills with the data of a pair or of two runs, and the look of all its figures.

Colours are those of the light scheme; the page replaces each by that of the dark scheme where that is asked for.
"""

from typing import Any

from bpnp.report.palette import INKS

INK = {name: light for name, (light, _) in INKS.items()}
CLEAR = "rgba(0,0,0,0)"
GRID = {"gridcolor": INK["line"], "zerolinecolor": INK["line"]}
PICKED = {"symbol": "circle-open", "color": INK["wrong"], "line": {"width": 2}}
CONFIG = {  # of every figure
    "responsive": True,
    "displaylogo": False,
    "toImageButtonOptions": {"scale": 2, "filename": "bpnp"},
    "modeBarButtonsToRemove": [
        "sendChartToCloud", "select2d", "lasso2d", "autoScale2d", "tableRotation", "resetCameraLastSave3d",
    ],
}  # fmt: skip


def look() -> dict[str, Any]:
    """The plotly template of every figure."""
    axis = GRID | {"linecolor": INK["quiet"], "automargin": True}
    axis3d = GRID | {"color": INK["quiet"], "backgroundcolor": CLEAR, "showspikes": False}
    layout = {
        "margin": {"l": 50, "r": 12, "t": 44, "b": 40}, "showlegend": False, "paper_bgcolor": CLEAR,
        "plot_bgcolor": CLEAR, "font": {"color": INK["text"], "size": 11},
        "hoverlabel": {"namelength": 60, "bgcolor": INK["panel"], "font": {"color": INK["text"]}},
        "modebar": {"bgcolor": CLEAR, "color": INK["quiet"], "activecolor": INK["focus"]},
        "title": {"x": 0.02, "xanchor": "left", "font": {"size": 13}}, "xaxis": axis, "yaxis": axis,
        "scene": {"xaxis": axis3d, "yaxis": axis3d, "zaxis": axis3d},
    }  # fmt: skip
    return {"layout": layout}


def figures() -> dict[str, dict[str, Any]]:
    """By the id of their element: run against run, a pair in space, a pair in the image."""
    degrees = {"type": "log", "tickformat": "~g", "dtick": "D2"}
    diagonal = {
        "type": "line", "x0": 0, "y0": 0, "x1": 1, "y1": 1, "xref": "paper", "yref": "paper",
        "line": {"color": INK["quiet"], "width": 1, "dash": "dash"},
    }  # fmt: skip
    hover = "%{text}<br>%{x:.3g} against %{y:.3g} deg<extra></extra>"
    versus = {
        "data": [_marks("scatter", size=5, color=INK["text"], opacity=0.5) | {"hovertemplate": hover}],
        "layout": {
            "title": {"text": "Rotation error of each pair"}, "hovermode": "closest", "xaxis": degrees,
            "yaxis": degrees | {"matches": "x"},  # so that the diagonal of the picture is x = y
            "shapes": [diagonal],
        },
    }  # fmt: skip
    directions = {"xaxis": "right", "yaxis": "forward", "zaxis": "up"}  # of the true camera
    axes = {axis: {"title": {"text": direction}} for axis, direction in directions.items()}
    scene = {
        "data": [
            _marks("scatter3d", size=3.5, line={"width": 0}),
            {"type": "scatter3d", "mode": "markers", "hoverinfo": "skip", "marker": PICKED | {"size": 18}},
        ],
        "layout": {
            "margin": dict.fromkeys("lrtb", 0), "hovermode": "closest",
            "scene": axes | {
                "aspectmode": "data", "dragmode": "orbit", "camera": {"eye": {"x": 1.3, "y": -2.1, "z": 0.9}}
            },
        },
    }  # fmt: skip
    axis = {"constrain": "domain", "zeroline": False}
    image = {
        "data": [
            _lines(color=INK["quiet"]),
            _lines(color=INK["wrong"], dash="dot"),
            _marks("scatter", symbol="circle-open"),
            _marks("scatter", symbol="x-thin"),
            {"mode": "markers", "hoverinfo": "skip", "marker": PICKED | {"size": 16}},
        ],
        "layout": {
            "margin": {"l": 40, "r": 10, "t": 10, "b": 30}, "hovermode": "closest", "dragmode": "pan",
            "xaxis": axis, "yaxis": axis | {"scaleanchor": "x"},
        },
    }  # fmt: skip
    return {"versus": versus, "scene": scene, "image": image}


def _marks(kind: str, **marker: Any) -> dict[str, Any]:
    return {"type": kind, "mode": "markers", "marker": marker, "hovertemplate": "%{text}<extra></extra>"}


def _lines(**line: Any) -> dict[str, Any]:
    return {"mode": "lines", "hoverinfo": "skip", "opacity": 0.7, "line": {"width": 1, **line}}
