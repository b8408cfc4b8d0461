"""Training steps on a GPU: problems a second and memory, by batch size and precision.

    python -m benchmarks gpu [--modes float32 bf16 compile bf16+compile] [--batches 16 64 256]

A step is forward, loss, backward and Adam on `--points` points a side, with the correspondence loss and with the pose
loss. bf16: autocast of the feature nets, the layers stay in float32; compile: torch.compile of the nets. Exits with 2
where there is no GPU.
"""

import sys
import time
from functools import partial
from typing import Any

import numpy as np
import torch
from problems import planted, planted_network, training_losses, training_step
from record import parser, write
from rich.console import Console
from rich.table import Table

MODES = ("float32", "bf16", "compile", "bf16+compile")
BATCHES = (16, 32, 64, 128, 256)
LEVEL = 10.0
WARM_UP, STEPS, ROUNDS = 5, 5, 7


def throughput(mode: str, batch: int, points: int, *, poses: bool) -> dict[str, Any]:
    device, problem = torch.device("cuda"), planted(batch, points, kind="smooth", level=LEVEL)
    net = planted_network(problem, autocast=torch.bfloat16 if "bf16" in mode else None).to(device)
    if "compile" in mode:
        for part in (net.features2d, net.features3d):
            part.compile()
    step = training_step(net, partial(training_losses, batch=problem.batch.to(device), poses=poses))
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
    low, median, high = np.percentile(rates, (25, 50, 75)).tolist()
    known = {"mode": mode, "loss": "with pose" if poses else "correspondence", "batch": batch}
    return known | {"problems/s": median, "low": low, "high": high, "GB": torch.cuda.max_memory_allocated() / 1e9}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--modes", nargs="+", choices=MODES, default=["float32", "bf16"])
    options.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    options.add_argument("--points", type=int, default=1000)
    chosen = options.parse_args()
    if not torch.cuda.is_available():
        print("expected a GPU that torch.cuda can use, got none; try a machine with CUDA", file=sys.stderr)
        raise SystemExit(2)
    rows = [
        throughput(mode, batch, chosen.points, poses=poses)
        for poses in (False, True)
        for mode in chosen.modes
        for batch in chosen.batches
    ]
    table = Table(*rows[0], title=f"{torch.cuda.get_device_name()}, {chosen.points} points")
    for row in rows:
        table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)
    if chosen.output:
        write(chosen.output, {"gpu": torch.cuda.get_device_name(), "rows": rows})


if __name__ == "__main__":
    main()
