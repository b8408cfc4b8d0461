"""Curves of a training: losses and validation errors over the steps, with the switch of the pose loss."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.report.figures import line_style, shown_text
from bpnp.report.results import Results
from bpnp.report.tables import Line, lines_of
from bpnp.report.terminal import INKS, QUIET
from bpnp.report.training_run import METRICS, training_logs, training_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

LOSSES = {
    "train/loss": "loss",
    "train/correspondence_loss": "$L_c$",
    "train/matching_loss": "matching loss",
    "train/rotation_loss": "$L_r$, radians",
    "train/translation_loss": "$L_t$, scene units",
    "val/correspondence_loss": "$L_c$, validation",
}
SWITCH = "train/pose_loss"
SMOOTH = 0.05  # fraction of the steps in a moving average
ESTIMATES = ("ransac", "pnp", "refined")  # order in which networks return them, that of their colours without a test
INK = INKS["text"][0]


def read_curves(run: Path | str) -> "DataFrame":
    """Read the log of a training, a row per step; raise ValueError if the folder has none, or one that cannot be read.

    A resumed training has several logs; from the first step of each on, it replaces the earlier ones.
    """
    from pandas import DataFrame, concat, read_csv

    curves = DataFrame()
    for file in training_logs(run):
        try:
            log = read_csv(file)
            steps = log["step"]
        except (ValueError, KeyError) as error:
            raise ValueError(f"{file} is not the log of a training ({error})") from error
        earlier = curves[curves["step"] < steps.min()] if len(curves) else curves
        curves = concat([earlier, log]) if len(earlier) else log
    if curves.empty:
        raise ValueError(f"{run} has no logs/version_*/{METRICS} of a training")
    return curves.copy().groupby("step").mean(numeric_only=True).reset_index()


def switch_step(curves: "DataFrame") -> int | None:
    """Return the first logged step with the pose loss; None if it never joined, or was there from the start."""
    if SWITCH not in curves:
        return None
    posed, trained = curves[curves[SWITCH].notna()]["step"], curves[curves["train/loss"].notna()]["step"]
    return int(posed.min()) if len(posed) and posed.min() > trained.min() else None


def lines_of_training(run: Path, folders: Mapping[str, Path], runs: Mapping[str, Results]) -> list[Line]:
    """Return the estimates of the first test of a training, with the colours that they have in the tables."""
    tests = [name for name, folder in folders.items() if name in runs and training_of(folder, runs[name]) == run]
    return [line for line in lines_of(runs) if line.run in tests[:1]]


def training_curves(run: Path | str, lines: Sequence[Line] = ()) -> "Figure":
    """Draw the losses of a training and the median errors of its validation.

    A line marks the switch of the pose loss. Estimates have the colours of `lines`, those of a test of the network.
    Raise ValueError as `read_curves` does.
    """
    from matplotlib import rc_context

    with rc_context(
        {"text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK}
    ):
        return _draw_curves(read_curves(run), lines)


def _draw_curves(curves: "DataFrame", lines: Sequence[Line]) -> "Figure":
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    losses, rotation, translation = figure.subplots(1, 3)
    styles = {line.estimate: line_style(line.colour, line.dashes) for line in lines}
    for i, (key, label) in enumerate(LOSSES.items()):
        _draw(losses, curves, key, label, smooth=key.startswith("train/"), **line_style(i, i))
    for i, estimate in enumerate(_estimates(curves)):
        style = styles.get(estimate, line_style(len(styles) + i, len(styles) + i))
        for axes, error in ((rotation, "rotation_q2_deg"), (translation, "translation_q2")):
            _draw(axes, curves, f"val/{estimate}/{error}", shown_text(estimate), marker="o", ms=3, **style)
    losses.set(ylabel="loss")
    rotation.set(ylabel="median rotation error, degrees", yscale="log")
    translation.set(ylabel="median translation error", yscale="log")
    for axes in (rotation, translation):
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(_plain)
        axes.yaxis.set_minor_formatter(NullFormatter())
    switch = switch_step(curves)
    for axes in (losses, rotation, translation):
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        if switch is not None:
            axes.axvline(switch, color=QUIET, lw=1, ls=":", label="pose loss joins")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=8, frameon=False)
    return figure


def _plain(value: float, _: int) -> str:
    """Format a tick of a logarithmic axis without powers of ten."""
    return f"{value:g}"


def _estimates(curves: "DataFrame") -> list[str]:
    """Return the estimates of the validation, those of `ESTIMATES` first; the log has them in alphabetical order."""
    parts = [str(name).split("/") for name in curves.columns]
    found = [part[1] for part in parts if len(part) == 3 and part[0] == "val" and part[2] == "rotation_q2_deg"]
    return [*(name for name in ESTIMATES if name in found), *(name for name in found if name not in ESTIMATES)]


def _draw(axes: Any, curves: "DataFrame", key: str, label: str, *, smooth: bool = False, **style: Any) -> None:
    if key not in curves or not curves[key].notna().any():
        return
    finite = curves[curves[key].notna() & np.isfinite(curves[key])]
    values = finite[key]
    if smooth:
        values = values.rolling(max(1, int(SMOOTH * len(values))), min_periods=1).mean()
    axes.plot(finite["step"], values, label=label, **style)
