"""Training steps on a GPU: problems a second and memory, by batch size and precision.

    python -m benchmarks gpu [--modes float32 bf16 compile bf16+compile] [--batches 16 64 256]

A step is forward, loss, backward and Adam on `--points` points a side, with the correspondence loss and with the pose
loss. bf16: autocast of the feature nets, the layers stay in float32; compile: torch.compile of the nets. Exits with 2
where there is no GPU.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch
from problems import planted, planted_network
from record import parser, write
from rich.console import Console
from rich.table import Table
from steps import training_step
from timing import Spread

MODES = ("float32", "bf16", "compile", "bf16+compile")
BATCHES = (16, 32, 64, 128, 256)
LEVEL = 10.0
WARM_UP, STEPS, ROUNDS = 5, 5, 7
Step = Callable[[], None]


@dataclass(frozen=True)
class Row:
    mode: str
    poses: bool
    batch: int
    problems_per_second: Spread
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


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--modes", nargs="+", choices=MODES, default=["float32", "bf16"])
    options.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    options.add_argument("--points", type=int, default=1000)
    chosen = options.parse_args()
    if not torch.cuda.is_available():
        print("expected a GPU that torch.cuda can use, got none; try a machine with CUDA", file=sys.stderr)
        raise SystemExit(2)
    device, name = torch.device("cuda"), torch.cuda.get_device_name()
    rows = [
        throughput(mode, batch, chosen.points, poses=poses, device=device)
        for poses in (False, True)
        for mode in chosen.modes
        for batch in chosen.batches
    ]
    table = Table("mode", "loss", "batch", "problems/s", "quartiles", "GB", title=f"{name}, {chosen.points} points")
    for row in rows:
        rate, loss = row.problems_per_second, "with pose" if row.poses else "correspondence"
        quartiles = f"{rate.low:.0f}-{rate.high:.0f}"
        table.add_row(row.mode, loss, str(row.batch), f"{rate.median:.0f}", quartiles, f"{row.peak_gb:.1f}")
    Console().print(table)
    if chosen.output:
        write(chosen.output, {"gpu": name, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
