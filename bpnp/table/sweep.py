"""Median rotation error and recall against the share of outliers, a curve for each method."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bpnp.report.palette import DASHES, LIGHT
from bpnp.table.layout import Line

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECALL = "recall_joint_15deg_0.5"
WORST_DEG = 180.0


def sweep_figure(lines: Sequence[Line]) -> "Figure":
    """A figure of the lines that have an outlier share. Raises ValueError if none has."""
    from matplotlib.figure import Figure

    labels = list(dict.fromkeys(line.label for line in lines if line.rho is not None))
    if not labels:
        raise ValueError("expected results at several outlier shares, got none; try --rho 0 0.25 0.5 1")
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    errors, recall = figure.subplots(1, 2)
    for i, label in enumerate(labels):
        known = [line for line in lines if line.label == label and line.rho is not None and not line.spread_of]
        chosen = sorted(known, key=lambda line: line.rho or 0.0)
        shares = [line.rho for line in chosen]
        style = {"color": LIGHT[i % len(LIGHT)], "marker": "o", "ms": 3.5, "label": label.replace("$", r"\$")}
        dashes = DASHES[i // len(LIGHT) % len(DASHES)]
        for axes, values in (
            (errors, [line.values["rotation_q2_deg"] for line in chosen]),
            (recall, [100 * line.values[RECALL] for line in chosen]),
        ):
            (curve,) = axes.plot(shares, values, **style)
            if dashes:
                curve.set_dashes(dashes)
    errors.set(yscale="log", ylabel="median rotation error, degrees", ylim=(None, 1.2 * WORST_DEG))
    recall.set(ylabel="% of pairs within 15 degrees and 0.5", ylim=(0, 101))
    for axes in (errors, recall):
        axes.set_xlabel("outliers a true pair, on both sides")
        axes.grid(alpha=0.3)
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure
