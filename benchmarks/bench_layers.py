"""Layers of this package against the paper's method (`paper_layers.py`) on the same inputs.

    python -m benchmarks layers [--points 200 --rounds 3]

Both run alternately; CPU times and ratios are medians over the rounds. A camera of the paper's protocol (noise of 2
pixels at a focal length of 800, Euler angles up to 45 degrees, distance 4.5) sees points in the unit ball. Inputs
differ in the kind of the point features and in the fraction of the assignment on the true matches:

- smooth: random waves over the image position (noisy on the 2D side, exact on the 3D side); `level` is their wave
  number. Neighbouring points have similar features, as in a trained network, and share their probability.
- independent: a random unit vector per point, with noise of relative size `level` on the other side. All wrong matches
  are equally unlikely, the easy case for every iterative solver.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from timeit import Timer
from typing import Any, Literal

import numpy as np
import roma
import torch
from paper_layers import SINKHORN_TOLERANCE, PaperPnP, PaperSinkhorn
from record import parser, positive, select, write
from torch import Tensor, nn

from bpnp.cli import keep_freed_memory
from bpnp.geometry import bearings
from bpnp.layers import ransac_pnp, sinkhorn, weighted_pnp
from bpnp.models.bpnpnet import pairwise_distance
from bpnp.types import Batch

Kind = Literal["smooth", "independent"]
FOCAL, NOISE_PX, DISTANCE, CHANNELS = 800.0, 2.0, 4.5, 128
MU, MANY = 0.1, 10_000
SHORTEST = 0.05  # seconds; a faster call is repeated within a round
FORWARD: tuple[tuple[Kind, float, float, int], ...] = (
    # kind, level, mu, iterations of the paper's method (to its tolerance of 1e-9 where they are many)
    ("independent", 0.7, MU, 100),
    ("smooth", 10, MU, 100),
    ("smooth", 3, MU, MANY),
    ("smooth", 10, 0.01, 100),
)
BACKWARD: tuple[tuple[Kind, float], ...] = (("independent", 0.7), ("smooth", 10))


def plant(batch: int, points: int, *, kind: Kind, level: float, seed: int = 0) -> tuple[Batch, Tensor]:
    """Return scenes in which 3D point j was seen as 2D point j, and the cost: distances between unit features."""
    generator = torch.Generator().manual_seed(seed)
    scene = nn.functional.normalize(torch.randn(batch, points, 3, generator=generator), dim=-1)
    scene = scene * torch.rand(batch, points, 1, generator=generator) ** (1 / 3)
    x, y, z = (torch.rand(3, batch, generator=generator) * torch.pi / 4).unbind()
    rotation = roma.euler_to_rotmat("ZYX", [z, y, x])
    translation = torch.rand(batch, 3, generator=generator) - 0.5 + torch.tensor([0, 0, DISTANCE])
    camera = scene @ rotation.mT + translation.unsqueeze(1)
    exact = camera[..., :2] / camera[..., 2:]
    noisy = exact + NOISE_PX / FOCAL * torch.randn(batch, points, 2, generator=generator)
    problems = Batch.from_arrays(
        list(noisy), list(scene), list(rotation), list(translation), [torch.arange(points)] * batch, focal=FOCAL
    )
    if kind == "smooth":
        directions = level * DISTANCE * torch.randn(2, CHANNELS // 2, generator=generator)
        waves = (x @ directions for x in (noisy, exact))
        features2d, features3d = (torch.cat([x.cos(), x.sin()], -1) for x in waves)
    else:
        features3d = torch.randn(batch, points, CHANNELS, generator=generator)
        features2d = features3d + level * torch.randn(batch, points, CHANNELS, generator=generator)
    return problems, pairwise_distance(*(nn.functional.normalize(x, dim=-1) for x in (features2d, features3d)))


def diagonal_mass(assignment: Tensor) -> float:
    """Return the fraction of the assignment on the true matches, averaged over the batch."""
    return float(assignment.detach().diagonal(dim1=-2, dim2=-1).sum(-1).mean())


Row = tuple[str, str, Callable[[], object], Callable[[], object]]  # what, on which inputs, by ours and the paper's way


def race(ours: Callable[[], object], papers: Callable[[], object], rounds: int) -> tuple[float, float, float]:
    """Return the median CPU milliseconds of two functions that run alternately, and the median ratio of the second to
    the first. Each is called once to warm up and once to choose the number of calls.
    """
    timers = [Timer(candidate, timer=time.process_time) for candidate in (ours, papers)]
    repeats = [max(1, round(SHORTEST / max(timer.repeat(2, 1)[1], 1e-6))) for timer in timers]
    times = [[1000 * t.timeit(n) / n for t, n in zip(timers, repeats, strict=True)] for _ in range(rounds)]
    return *(float(x) for x in np.median(times, 0)), float(np.median([b / a for a, b in times]))  # type: ignore[return-value]


def rows(points: int, batch: int) -> Iterator[Row]:
    yield from pnp_rows(points, batch)
    for kind, level, mu, iterations in FORWARD:
        cost = plant(batch, points, kind=kind, level=level)[1]
        tolerance = SINKHORN_TOLERANCE if iterations == MANY else 0
        ours, papers = partial(sinkhorn, cost, mu=mu), partial(PaperSinkhorn.apply, cost, mu, iterations, tolerance)
        ends = "to its tolerance" if tolerance else f"{iterations} iterations"
        inputs = f"{kind}, {diagonal_mass(ours()[0]):.0%}"
        yield f"Sinkhorn forward, mu {mu}, the paper's {ends}", inputs, ours, papers
    for kind, level in BACKWARD:
        cost = plant(batch, points, kind=kind, level=level)[1].requires_grad_()
        plan = sinkhorn(cost, mu=MU)[0]
        back = [gradient_of(each, cost, 1 - 2 * torch.eye(points).expand_as(plan))
                for each in (plan, PaperSinkhorn.apply(cost, MU))]  # fmt: skip
        yield "Sinkhorn backward", f"{kind}, {diagonal_mass(plan):.0%}", back[0], back[1]


def pnp_rows(points: int, batch: int) -> Iterator[Row]:
    problems, cost = plant(batch, points, kind="smooth", level=10)
    plan, rays, points3d = sinkhorn(cost)[0], bearings(problems.points2d), problems.points3d
    start = ransac_pnp(plan, problems.points2d, points3d)[:2]
    inputs, vector = f"smooth, {diagonal_mass(plan):.0%}", torch.cat([roma.rotmat_to_rotvec(start[0]), start[1]], -1)
    ours = partial(weighted_pnp, plan, rays, points3d, *start)
    papers = partial(PaperPnP.apply, *(x.double() for x in (plan, rays, points3d, vector)))
    yield "PnP forward, from RANSAC", inputs, ours, papers

    leaf = plan.clone().requires_grad_()
    solved, pose = weighted_pnp(leaf, rays, points3d, *start)[:2], PaperPnP.apply(leaf, rays, points3d, vector)
    incoming = [torch.randn(x.shape, generator=torch.Generator().manual_seed(0)) for x in solved]
    papers_pose = roma.rotvec_to_rotmat(pose[:, :3]), pose[:, 3:]
    back = [gradient_of(each, leaf, incoming) for each in (solved, papers_pose)]
    yield "PnP backward", inputs, back[0], back[1]


def gradient_of(outputs: Any, inputs: Tensor, incoming: Any) -> Callable[[], object]:
    return partial(torch.autograd.grad, outputs, inputs, incoming, retain_graph=True)


def main() -> None:
    options = parser(__doc__, without=["data", "seed", "limit", "time-limit"])
    options.add_argument("--points", type=positive, default=1000, help="on each side (default: 1000)")
    options.add_argument("--rounds", type=positive, default=7, help="timings of each side in a row (default: 7)")
    options.add_argument("--batch", type=positive, default=4, help="problems in a batch (default: 4)")
    chosen = options.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    found = []
    drawn = select(rows(chosen.points, chosen.batch), chosen.only, lambda row: f"{row[0]}; {row[1]}")
    for what, inputs, ours, papers in drawn:
        *ms, ratio = race(ours, papers, chosen.rounds)
        print(f"{what}; {inputs}: ours {ms[0]:.3g} CPU ms, the paper's {ms[1]:.3g}, ratio {ratio:.3g}", flush=True)
        found.append({"what": what, "inputs": inputs, "ms": ms, "ratio": ratio})
    if chosen.output:
        write(chosen.output, {"points": chosen.points, "batch": chosen.batch, "rows": found})
