"""Time and memory of the whole network, forward and backward, for one pair of growing size.

    python benchmarks/bench_scaling.py [--sizes 250 500 1000 2000 4000 8000 14742]

Prints a table and writes it and a plot to benchmarks/results/scaling-<machine kind>.json and .png. Every size runs in a
process of its own, whose highest resident memory is read at the end of each stage. The features are as smooth over the
image at all sizes, so that a point of a larger set shares its probability with more neighbours. A size is left out,
with a message, if the memory that the one before it predicts is not free.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
from problems import planted, planted_network
from rich.console import Console
from rich.table import Table
from steps import training_losses
from timing import machine, restart_with_settings, write_json

RESULTS = Path(__file__).parent / "results"
SIZES = (250, 500, 1000, 2000, 4000, 8000, 14742)
LEVEL = 10.0
STAGES = ("features, cost", "Sinkhorn", "RANSAC", "PnP", "backward")


@dataclass
class Run:
    """One forward and backward pass; memory is the process' highest so far, at the end of each stage."""

    points: int
    poses: bool
    seconds: dict[str, float] = field(default_factory=dict)
    peak_gb: dict[str, float] = field(default_factory=dict)
    sinkhorn_iterations: int = 0
    pose_converged: bool | None = None

    @property
    def total_seconds(self) -> float:
        return sum(self.seconds.values())

    @property
    def highest_gb(self) -> float:
        return max(self.peak_gb.values())


def measure(points: int, *, poses: bool) -> Run:
    problem = planted(1, points, kind="smooth", level=LEVEL)
    net, batch = planted_network(problem), problem.batch
    run = Run(points, poses)
    last = time.perf_counter()

    def ends(stage: str) -> None:
        nonlocal last
        run.seconds[stage] = time.perf_counter() - last
        run.peak_gb[stage] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
        last = time.perf_counter()

    def solved(stage: str) -> Any:
        def hook(_module: torch.nn.Module, _inputs: Any, output: Any) -> None:
            ends(stage)
            if stage == "Sinkhorn":
                run.sinkhorn_iterations = int(output[-1].iterations.max())
            elif stage == "PnP":
                run.pose_converged = bool(output[-1].converged.all())

        return hook

    net.transport.register_forward_pre_hook(lambda *_: ends("features, cost"))
    for stage, layer in (("Sinkhorn", net.transport), ("RANSAC", net.ransac), ("PnP", net.pnp)):
        layer.register_forward_hook(solved(stage))
    training_losses(net, batch, poses).mean().backward()
    ends("backward")
    return run


def in_its_own_process(points: int, *, poses: bool, threads: int) -> Run:
    command = [sys.executable, __file__, "--one", "--sizes", str(points), "--threads", str(threads)]
    finished = subprocess.run(command + ["--poses"] * poses, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        last = finished.stderr.strip().splitlines()[-1:] or ["nothing (out of memory?)"]
        raise RuntimeError(f"expected a run with {points} points, got {last[0]}")
    return Run(**json.loads(finished.stdout))


def free_gigabytes() -> float:
    """Memory that the system can give; infinite where it does not tell."""
    information = Path("/proc/meminfo")
    lines = information.read_text().splitlines() if information.exists() else []
    return next((int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("MemAvailable")), float("inf"))


def all_runs(sizes: Sequence[int], threads: int, console: Console) -> list[Run]:
    runs: list[Run] = []
    for poses in (False, True):
        expected = 0.0
        for i, points in enumerate(sizes):
            if expected > (free := free_gigabytes()):
                console.print(f"{points} points left out: about {expected:.1f} GB needed, {free:.1f} GB free")
                continue
            run = in_its_own_process(points, poses=poses, threads=threads)
            console.print(f"{points} points: {run.total_seconds:.2f} s, {run.highest_gb:.2f} GB")
            runs.append(run)
            if i + 1 < len(sizes):
                expected = run.highest_gb * (sizes[i + 1] / points) ** 2
    return runs


def show(runs: Sequence[Run], title: str) -> None:
    table = Table("points", "loss", "s", "GB", *(f"{stage}, s / GB" for stage in STAGES), "its", "pose", title=title)
    for run in runs:
        stages = [
            f"{run.seconds[stage]:.3g} / {run.peak_gb[stage]:.3g}" if stage in run.seconds else "" for stage in STAGES
        ]
        table.add_row(
            str(run.points), "with pose" if run.poses else "corr.", f"{run.total_seconds:.3g}", f"{run.highest_gb:.3g}",
            *stages, str(run.sinkhorn_iterations), {None: "", True: "ok", False: "failed"}[run.pose_converged],
        )  # fmt: skip
    Console(width=None if Console().is_terminal else 150).print(table)


def save_plot(runs: Sequence[Run], path: Path) -> None:
    """Seconds and gigabytes against points, each with the line of m n through its largest run."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for axis, label in zip(axes, ("seconds", "highest resident memory, GB"), strict=True):
        for poses, name in ((False, "correspondence loss"), (True, "with pose loss")):
            some = [run for run in runs if run.poses == poses]
            values = [run.total_seconds if label == "seconds" else run.highest_gb for run in some]
            axis.plot([run.points for run in some], values, "o-", label=name)
        sizes, top = [run.points for run in some], values[-1]
        axis.plot(sizes, [top * (x / sizes[-1]) ** 2 for x in sizes], "k--", linewidth=0.8, label="proportional to m n")
        axis.set(xscale="log", yscale="log", xlabel="m = n", ylabel=label)
    axes[0].legend()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, help="JSON file; the plot lies beside it")
    parser.add_argument("--one", action="store_true", help="run the first size here and print its record")
    parser.add_argument("--poses", action="store_true", help="with --one: with the pose loss")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    if options.one:
        print(json.dumps(asdict(measure(options.sizes[0], poses=options.poses))))
        return
    record = machine()
    console = Console(stderr=True)
    runs = all_runs(sorted(options.sizes), options.threads, console)
    show(runs, f"one pair, {record['cpu']}, {record['threads']} threads")
    out = options.out or RESULTS / f"scaling-{record['kind']}.json"
    write_json(out, {"machine": record, "runs": [asdict(run) for run in runs]})
    save_plot(runs, out.with_suffix(".png"))
    console.print(f"written to {out} and {out.with_suffix('.png')}")


if __name__ == "__main__":
    restart_with_settings()
    main()
