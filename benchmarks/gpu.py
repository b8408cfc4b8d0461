"""Training steps on a GPU: pairs a second, memory, where the time goes, and where a step waits for the device.

    python benchmarks/gpu.py [--modes float32 bf16 compile bf16+compile] [--batches 16 32 64 128 256]

A step is forward, loss, backward and Adam on `--points` points a side, with the correspondence loss and with the pose
loss. bf16: autocast of the feature nets, the layers stay in float32; compile: torch.compile of the nets. Prints tables
and writes benchmarks/results/<name of the GPU>.json. Exits with 2 where there is no GPU.
"""

import argparse
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from problems import planted, planted_network
from rich.console import Console
from rich.table import Table
from steps import training_step
from timing import Spread, machine, write_json
from torch.profiler import profile

RESULTS = Path(__file__).parent / "results"
MODES = ("float32", "bf16", "compile", "bf16+compile")
BATCHES = (16, 32, 64, 128, 256)
TARGETS = {False: 3000.0, True: 1500.0}  # pairs a second, without and with the pose loss
LEVEL = 10.0
WARM_UP, STEPS, ROUNDS = 5, 5, 7
Step = Callable[[], None]


@dataclass(frozen=True)
class Row:
    mode: str
    poses: bool
    batch: int
    pairs_per_second: Spread
    peak_gb: float


def make_step(mode: str, batch: int, points: int, *, poses: bool, device: torch.device) -> Step:
    problem = planted(batch, points, kind="smooth", level=LEVEL)
    net = planted_network(problem, autocast=torch.bfloat16 if "bf16" in mode else None).to(device)
    if "compile" in mode:
        for part in (net.features2d, net.features3d):
            part.compile()
    return training_step(net, problem.batch.to(device), poses=poses)


def throughput(mode: str, batch: int, points: int, *, poses: bool, device: torch.device) -> Row:
    step = make_step(mode, batch, points, poses=poses, device=device)
    torch.cuda.reset_peak_memory_stats()
    for _ in range(WARM_UP):
        step()
    rates = []
    for _ in range(ROUNDS):
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(STEPS):
            step()
        torch.cuda.synchronize()
        rates.append(STEPS * batch / (time.perf_counter() - start))
    return Row(mode, poses, batch, Spread.of(rates), torch.cuda.max_memory_allocated() / 1e9)


def synchronisations(step: Step) -> list[str]:
    """Lines of a warmed-up step at which the host waits for the device, each once.

    Those of a backward pass are all told at the line that started it; the first of all is told with its traceback.
    """
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            step()
        torch.cuda.set_sync_debug_mode("error")
        try:
            step()
            first = []
        except RuntimeError:
            first = [traceback.format_exc()]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = [w for w in caught if "synchroniz" in str(w.message)]
    return sorted({f"{w.filename}:{w.lineno}" for w in waits}) + first


def hottest(step: Step, *, count: int = 15) -> list[dict[str, Any]]:
    """Operators of three steps by their own time on the device."""
    with profile() as profiler:
        for _ in range(3):
            step()
        torch.cuda.synchronize()
    events = sorted(profiler.key_averages(), key=lambda event: -event.self_device_time_total)
    return [
        {
            "name": event.key,
            "calls": event.count / 3,
            "device_ms": event.self_device_time_total / 3000,
            "host_ms": event.self_cpu_time_total / 3000,
        }
        for event in events[:count]
    ]


def show(rows: Sequence[Row], title: str) -> None:
    table = Table("mode", "loss", "batch", "pairs/s", "quartiles", "GB", "target", title=title)
    for row in rows:
        rate = row.pairs_per_second
        table.add_row(
            row.mode, _loss(row.poses), str(row.batch), f"{rate.median:.0f}", f"{rate.low:.0f}-{rate.high:.0f}",
            f"{row.peak_gb:.1f}", f">= {TARGETS[row.poses]:.0f}",
        )  # fmt: skip
    Console().print(table)


def _loss(poses: bool) -> str:
    return "with pose" if poses else "correspondence"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modes", nargs="+", choices=MODES, default=["float32", "bf16"])
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        print("expected a GPU that torch.cuda can use, got none; try a machine with CUDA", file=sys.stderr)
        raise SystemExit(2)
    device, name = torch.device("cuda"), torch.cuda.get_device_name()
    console = Console()
    rows, details = [], []
    for poses in (False, True):
        for mode in options.modes:
            some = [throughput(mode, b, options.points, poses=poses, device=device) for b in options.batches]
            rows += some
            best = max(some, key=lambda row: row.pairs_per_second.median)
            step = make_step(mode, best.batch, options.points, poses=poses, device=device)
            for _ in range(WARM_UP):
                step()
            waits, operators = synchronisations(step), hottest(step)
            details.append({"mode": mode, "poses": poses, "batch": best.batch, "waits": waits, "operators": operators})
            console.print(f"{mode}, {_loss(poses)} loss, {best.batch} pairs: {len(waits)} places wait for the device")
            for line in waits:
                console.print(f"  {line}", highlight=False)
            for operator in operators:
                console.print(f"  {operator['device_ms']:8.3f} ms {operator['calls']:6.0f} calls {operator['name']}")
    show(rows, f"{name}, {options.points} points")
    out = options.out or RESULTS / f"{name.replace(' ', '-').lower()}.json"
    record = {"machine": machine() | {"kind": name}, "rows": [asdict(row) for row in rows], "details": details}
    write_json(out, record)
    console.print(f"written to {out}")


if __name__ == "__main__":
    main()
