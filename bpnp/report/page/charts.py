"""The charts of the page as plotly figures, for notebooks too: recall, errors against the size, time, training.

Each function takes results by name and returns a `plotly.graph_objects.Figure`, or None where there is nothing to
draw: `recall_chart(results, "rotation_deg").show()`.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bpnp.report.palette import DASHES, LIGHT, QUIET
from bpnp.report.results import Results
from bpnp.report.runs import series_of
from bpnp.report.samples import Array
from bpnp.report.training_log import TrainingLog

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Error = Literal["rotation_deg", "translation", "joint", "reprojection_deg"]
POINTS = 200  # of a curve
GROUPS = 16  # of pairs of similar size
RECALLS: dict[Error, tuple[str, str, float]] = {
    "rotation_deg": ("Rotation", "rotation error, degrees", 90.0),
    "translation": ("Translation", "translation error, scene units", 10.0),
    "joint": ("Rotation and translation", "rotation error, degrees, of pairs within 0.5 scene units", 90.0),
    "reprojection_deg": ("Reprojection", "reprojection error, degrees", 20.0),
}
JOINT_TRANSLATION = 0.5
SIZES = {"m": "2D points", "n": "3D points", "true_pairs": "true pairs"}
TRAINING = {
    "Training loss": (("train/loss", "train/correspondence_loss", "train/pose_loss"), False),
    "Validation: correspondence loss": (("val/correspondence_loss",), False),
    "Validation: median rotation error, degrees": (("val/rotation_q2_deg",), True),
}


def sorted_errors(results: Results, estimate: str, key: str) -> Array:
    """Errors of the pairs that have one, ascending; in the joint curve a pair that is too far away never counts."""
    errors = results.errors(estimate)
    if key == "joint":
        return np.sort(errors.rotation_deg.where(errors.translation <= JOINT_TRANSLATION, np.inf).numpy())
    values = getattr(errors, key).numpy()
    return np.sort(values[~np.isnan(values)])


def within(errors: Array, limits: Array) -> Array:
    """Share of ascending errors up to each limit."""
    return np.searchsorted(errors, limits, side="right") / max(len(errors), 1)


def recall_chart(runs: Mapping[str, Results], error: Error) -> "Figure | None":
    """Share of pairs with an error up to a threshold, on a logarithmic axis (paper Fig. 3)."""
    title, unit, most = RECALLS[error]
    known = [sorted_errors(runs[own.run], own.estimate, error) for own in series_of(runs)]
    finite = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in known])
    if not len(finite):
        return None
    low = max(float(np.quantile(finite, 0.01)), most / 1e5)
    limits = np.geomspace(low, max(most, 2 * low), POINTS)
    figure = _figure(title, unit, "pairs up to this error")
    figure.update_yaxes(range=[0, 1.01], tickformat=".0%")
    for place, errors in enumerate(known):
        _line(figure, runs, place, limits, within(errors, limits), "%{y:.1%}")
    return _logarithmic(figure)


def error_chart(runs: Mapping[str, Results], size: str) -> "Figure | None":
    """Median rotation error of groups of pairs of similar `size` ("m", "n" or "true_pairs")."""
    figure = _figure(f"Median rotation error against {SIZES[size]}", SIZES[size], "degrees")
    figure.update_yaxes(type="log")
    for place, own in enumerate(series_of(runs)):
        rows = sorted(runs[own.run].of(own.estimate), key=lambda row: getattr(row, size))
        x = np.array([getattr(row, size) for row in rows])
        if len(np.unique(x)) < 3:
            continue
        edges = np.searchsorted(x, np.unique(np.quantile(x, np.linspace(0, 1, GROUPS + 1)[1:-1])), side="right")
        error = np.array([row.rotation_error_deg for row in rows])
        groups = [part for part in np.split(np.arange(len(x)), edges) if len(part)]
        medians = [max(float(np.median(error[part])), 1e-6) for part in groups]
        _line(figure, runs, place, [np.median(x[part]) for part in groups], medians, "%{y:.3g} deg")
    return _logarithmic(figure) if figure.data else None


def time_charts(runs: Mapping[str, Results]) -> "list[Figure]":
    """Share of pairs done within a time, and cumulative seconds in the order of the data set.

    The estimates of a run are made together and share their time.
    """
    first = {own.run: place for place, own in reversed(list(enumerate(series_of(runs))))}
    times = {run: np.array([row.seconds for row in runs[run].of(next(iter(runs[run].estimates)))]) for run in first}
    positive = np.concatenate([values[values > 0] for values in times.values()])
    if not len(positive):
        return []
    limits = np.geomspace(positive.min() * 0.9, positive.max() * 1.1, POINTS)
    shares = _figure("Pairs done within a time", "seconds per pair", "pairs within")
    shares.update_yaxes(range=[0, 1.01], tickformat=".0%")
    total = _figure("Cumulative run time", "pairs, in the order of the data set", "seconds")
    for run, values in reversed(times.items()):
        _line(shares, runs, first[run], limits, within(np.sort(values), limits), "%{y:.1%}", name=run)
        shown = np.unique(np.linspace(0, len(values) - 1, POINTS).astype(int))
        _line(total, runs, first[run], shown + 1, np.cumsum(values)[shown], "%{y:.3g} s", name=run)
    return [_logarithmic(shares), total]


def training_charts(logs: Mapping[str, TrainingLog]) -> "list[Figure]":
    """Losses and the validation error over the steps; a dashed line marks the first step with the pose loss."""
    charts = []
    for title, (keys, log) in TRAINING.items():
        figure = _figure(title, "step", "")
        figure.update_yaxes(type="log" if log else "linear")
        for place, (run, own) in enumerate(logs.items()):
            known = [key for key in keys if key in own.curves and (key == keys[0] or own.switch_step is not None)]
            for key in known:
                short = key.split("/")[1].replace("_", " ")
                steps, values = own.curves[key]
                colour = LIGHT[(place if len(logs) > 1 else keys.index(key)) % len(LIGHT)]
                figure.add_scatter(
                    x=steps, y=values, name=short if len(logs) == 1 else f"{run} {short}", mode="lines",
                    line={"color": colour, "dash": _dash(keys.index(key)), "width": 2},
                )  # fmt: skip
            if own.switch_step is not None and known and known[0].startswith("train"):
                text = "pose loss joins" if len(logs) == 1 else f"{run}: pose loss"
                figure.add_vline(
                    x=own.switch_step, line={"dash": "dash", "width": 1, "color": QUIET}, annotation={"text": text}
                )
        if figure.data:
            charts.append(figure)
    return charts


def chart_text(figure: "Figure") -> str:
    """What a chart shows in words, for screen readers: the last value of each line."""
    form = ".1%" if figure.layout.yaxis.tickformat else ".3g"
    ends = [f"{trace.name} ends at {trace.y[-1]:{form}}" for trace in figure.data if len(trace.y)]
    return f"{figure.layout.title.text}: {'; '.join(ends)}"


def page_charts(runs: Mapping[str, Results], logs: Mapping[str, TrainingLog]) -> "dict[str, list[Figure]]":
    """The charts of the page by section; sections without one are left out."""
    if not runs:
        return {"training": training_charts(logs)}
    sections: dict[str, Sequence[Figure | None]] = {
        "recall": [recall_chart(runs, error) for error in RECALLS],
        "errors": [error_chart(runs, size) for size in SIZES],
        "time": time_charts(runs),
        "training": training_charts(logs),
    }
    known = {name: [chart for chart in charts if chart is not None] for name, charts in sections.items()}
    return {name: charts for name, charts in known.items() if charts}


def _figure(title: str, x: str, y: str) -> "Figure":
    from plotly.graph_objects import Figure

    figure = Figure(layout={"title": {"text": title}, "hovermode": "x unified", "template": "none"})
    figure.update_xaxes(title={"text": x}, hoverformat=".3~g")
    figure.update_yaxes(title={"text": y})
    return figure


def _logarithmic(figure: "Figure") -> "Figure":
    """The figure with a logarithmic x axis.

    Of one to two decades plotly labels every digit, which overlap, unless it is asked for fewer: then 1, 2 and 5.
    """
    x = np.concatenate([trace.x for trace in figure.data])
    decades = float(np.log10(x.max() / x.min()))
    few = {"nticks": int(decades / 0.31)} if 1 <= decades < 2.2 else {}  # more than 0.3 decades a label
    return figure.update_xaxes(type="log", tickformat="~g", **few)


def _line(
    figure: "Figure", runs: Mapping[str, Results], place: int, x: Any, y: Any, hover: str, name: str = ""
) -> None:
    """Add a line in the style of the series at `place`, by which the page finds it."""
    own = series_of(runs)[place]
    figure.add_scatter(
        x=np.asarray(x, np.float32), y=np.asarray(y, np.float32), name=name or own.label, mode="lines", meta=place,
        line={"color": LIGHT[own.colour], "dash": _dash(own.dashes), "width": 2}, hovertemplate=hover,
    )  # fmt: skip


def _dash(number: int) -> str:
    return ",".join(f"{length:g}px" for length in DASHES[number % len(DASHES)]) or "solid"
