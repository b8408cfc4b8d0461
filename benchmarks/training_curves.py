"""The loss and the rotation error of a training, as a picture.

    python benchmarks/training_curves.py runs/procedural --stages 3000 4200 --output docs/images/procedural.png

Reads the logs that `bpnp fit` leaves in the run's folder; a resumed run counts as one. A dashed line marks each step at
which the settings changed.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt

from bpnp.report.figures import save_figure
from bpnp.report.palette import LIGHT
from bpnp.report.runs import TrainingLog, read_training_log

PARTS = {"train": "training batch", "val": "validation"}
ROTATION = "val/rotation_q2_deg"


def draw(log: TrainingLog, stages: Sequence[int], loss: str = "correspondence_loss") -> plt.Figure:
    """A loss on the left, median rotation error of `ransac` on the right, over the optimiser's steps."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for (part, label), colour in zip(PARTS.items(), LIGHT, strict=False):
        if f"{part}/{loss}" in log.curves:
            left.plot(*log.curves[f"{part}/{loss}"], color=colour, label=label, linewidth=1.2)
    left.set(xlabel="step", ylabel=loss.replace("_", " "))
    left.legend(frameon=False)
    right.plot(*log.curves[ROTATION], color=LIGHT[0], linewidth=1.2)
    right.set(xlabel="step", ylabel="median rotation error, validation (deg)", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        for step in stages:
            axes.axvline(step, color="black", linestyle="--", linewidth=0.8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the training's trainer.default_root_dir")
    parser.add_argument("--stages", type=int, nargs="*", default=[], help="steps at which the settings changed")
    parser.add_argument("--loss", default="correspondence_loss", help="of the log (default: correspondence_loss)")
    parser.add_argument("--output", type=Path, default=Path("docs/images/procedural.png"))
    chosen = parser.parse_args(arguments)
    log = read_training_log(chosen.run)
    if log is None or ROTATION not in log.curves:
        parser.error(f"expected the log of a training in {chosen.run}, got none; try its trainer.default_root_dir")
    save_figure(draw(log, chosen.stages, chosen.loss), chosen.output, dpi=80)


if __name__ == "__main__":
    main()
