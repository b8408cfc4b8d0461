"""Median rotation error and recall against the share of outliers, a curve for each method."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bpnp.report.figures import line_style
from bpnp.report.palette import LIGHT
from bpnp.report.tables.rows import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECALL = "recall_joint_15deg_0.5"
WORST_DEG = 180.0


def sweep_figure(rows: Sequence[Row]) -> "Figure":
    """A figure of the rows that have an outlier share, without those of spreads."""
    from matplotlib.figure import Figure

    known = sorted((row for row in rows if row.rho is not None and not row.seeds), key=lambda row: row.rho or 0.0)
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    errors, recall = figure.subplots(1, 2)
    for i, label in enumerate(dict.fromkeys(row.label for row in rows if row in known)):
        chosen = [row for row in known if row.label == label]
        style = line_style(i, i // len(LIGHT)) | {"marker": "o", "ms": 3.5, "label": label.replace("$", r"\$")}
        shares = [row.rho for row in chosen]
        errors.plot(shares, [row.values["rotation_q2_deg"] for row in chosen], **style)
        recall.plot(shares, [100 * float(row.values[RECALL]) for row in chosen], **style)
    errors.set(yscale="log", ylabel="median rotation error, degrees", ylim=(None, 1.2 * WORST_DEG))
    recall.set(ylabel="% of pairs within 15 degrees and 0.5", ylim=(0, 101))
    for axes in (errors, recall):
        axes.set_xlabel("outliers a true pair, on both sides")
        axes.grid(alpha=0.3)
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure
