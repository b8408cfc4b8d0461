"""Where the candidate poses of a solution come from: the search, a trained module, or one after the other."""

import copy
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bpnp.compilation import Deadline
from bpnp.search.many import search_poses
from bpnp.search.refine import score_poses
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import SearchResult
from bpnp.solving.finishing import finished, without_pose
from bpnp.solving.problem import Array, Problem
from bpnp.solving.processes import in_processes
from bpnp.solving.solution import Solution
from bpnp.types import Batch

ESTIMATES = ("refined", "ransac", "pnp")  # of a prediction, the one to trust most first
NET_SIGMA_DEG, NET_SIGMA_SHIFT = 10.0, 0.1  # of a net's pose; the latter of its distance from the scene
GPU_PAIRS, GPU_CELLS = 64, 2**26  # solved together by a module: pairs, and pairs x 2D points x 3D points

WORTH_FORKING = 0.3  # seconds of work; starting processes takes some tens of milliseconds

Progress = Callable[[int, int, float], None]  # pair, batches of starts so far, seconds


class Options(NamedTuple):
    """What applies to all pairs; see `bpnp.solve`.

    solver: None for the search. device: None for that of each module. settings: of the search.
    """

    solver: nn.Module | None = None
    inlier_threshold: float | None = None
    clutter: float | None = None
    seed: int = 0
    time_limit: float | None = None
    device: torch.device | None = None
    progress: Progress | None = None
    settings: SearchSettings = DEFAULT


def solutions_of(problems: Mapping[int, Problem], options: Options) -> dict[int, Solution]:
    """The solution of each problem, which has its number."""
    solutions = {
        i: without_pose(problem, problem.degenerate, options.inlier_threshold)
        for i, problem in problems.items()
        if problem.degenerate is not None
    }
    rest = {i: problem for i, problem in problems.items() if i not in solutions}
    if options.solver is None and not any(isinstance(problem.prior, nn.Module) for problem in rest.values()):
        return solutions | dict(_shared(rest, options))
    for i, result, seconds in (_searched if options.solver is None else _predicted)(rest, options):
        solutions[i] = finished(problems[i], result, seconds, options.inlier_threshold)
    return solutions


def _shared(problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, Solution]]:
    """Number and solution of each problem, of the search: in as many processes as torch has threads, where that pays.

    The first one is solved here: it compiles what all need, and tells how long one takes.
    """

    def solved(i: int, tell: Progress) -> Solution:
        ((_, result, seconds),) = _searched({i: problems[i]}, options._replace(progress=tell if listening else None))
        return finished(problems[i], result, seconds, options.inlier_threshold)

    listening, tell = options.progress is not None, options.progress or (lambda *_: None)
    first, *others = problems or (None,)
    if first is None:
        return
    solution = solved(first, tell)
    yield first, solution
    workers = 1 if multiprocessing.current_process().daemon else torch.get_num_threads()  # which may have no children
    if workers > 1 and len(others) > 1 and solution.seconds * len(others) > WORTH_FORKING:
        yield from in_processes(solved, others, workers, tell)
    else:
        yield from ((i, solved(i, tell)) for i in others)


def _searched(problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, SearchResult, float]]:
    """Number, result and seconds of each problem, of the search."""
    priors = [problem.prior for problem in problems.values()]
    nets = {id(net): evaluation_copy(net, options.device) for net in priors if isinstance(net, nn.Module)}
    for i, problem in problems.items():
        start, deadline = time.perf_counter(), Deadline.after(options.time_limit)
        net = nets.get(id(problem.prior))
        result = search_poses(
            problem.sets, around=None if net is None else _net_prior(net, problem, deadline), clutter=options.clutter,
            seed=options.seed, deadline=deadline, settings=options.settings,
            progress=None if options.progress is None else partial(options.progress, i),
        )  # fmt: skip
        yield i, result, time.perf_counter() - start


def _predicted(problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, SearchResult, float]]:
    """Number, result and seconds of each problem, of a module, which on a GPU gets pairs of similar size together."""
    assert options.solver is not None
    net = evaluation_copy(options.solver, options.device)
    for group in [[i] for i in problems] if device_of(net).type == "cpu" else _groups(problems):
        start = time.perf_counter()
        found = _asked(net, [problems[i] for i in group], Deadline.after(options.time_limit))
        seconds = (time.perf_counter() - start) / len(group)
        yield from ((i, result, seconds) for i, result in zip(group, found, strict=True))


def evaluation_copy(module: nn.Module, device: torch.device | None) -> nn.Module:
    """The module in evaluation mode on `device` (None: where it is).

    A copy unless it is that already: the caller's keeps its device and its training flags, and may be in use by other
    threads.
    """
    evaluates = not any(part.training for part in module.modules())
    if evaluates and device in (None, device_of(module)):
        return module
    return copy.deepcopy(module).to(device).eval()


def device_of(module: nn.Module) -> torch.device:
    """Where the parameters of a module are; the CPU if it has none."""
    parameter = next(module.parameters(), None)
    return torch.device("cpu") if parameter is None else parameter.device


def _groups(problems: Mapping[int, Problem]) -> Iterator[list[int]]:
    """Pairs of similar size, to solve together."""
    group: list[int] = []
    cells = {i: len(problem.bearings) * len(problem.points3d) for i, problem in problems.items()}
    for i in sorted(problems, key=cells.__getitem__):
        if group and (len(group) == GPU_PAIRS or cells[i] * (len(group) + 1) > GPU_CELLS):
            yield group
            group = []
        group.append(i)
    if group:
        yield group


def _net_prior(net: nn.Module, problem: Problem, deadline: Deadline) -> PosePrior | None:
    """The net's pose, None if it has none."""
    (asked,) = _asked(net, [problem], deadline)
    if not len(asked.candidates):
        return None
    rotation, translation = asked.best
    centre = rotation @ problem.local3d.mean(0) + translation
    return PosePrior(rotation, translation, NET_SIGMA_DEG, NET_SIGMA_SHIFT * float(np.linalg.norm(centre)) + 1e-12)


def _asked(net: nn.Module, members: list[Problem], deadline: Deadline) -> list[SearchResult]:
    """The poses of a module's prediction, scored. Points that are not in front of the camera are not given to it."""
    seen = [problem.points2d[problem.usable] for problem in members]
    batch = Batch.from_arrays(
        [points[np.isfinite(points).all(-1)].astype(np.float32) for points in seen],
        [problem.local3d.astype(np.float32) for problem in members],
    ).to(device_of(net))
    with torch.no_grad():
        poses = net(batch).poses
    if not poses:
        raise ValueError(f"expected a pose from the `solver` {type(net).__name__}, got a prediction without one")
    order = sorted(poses, key=lambda name: ESTIMATES.index(name) if name in ESTIMATES else len(ESTIMATES))
    rotation = _host(torch.stack([poses[name].rotation for name in order], 1))
    translation = _host(torch.stack([poses[name].translation for name in order], 1))
    return [
        score_poses(problem.sets, r, t, deadline) for problem, r, t in zip(members, rotation, translation, strict=True)
    ]


def _host(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()
