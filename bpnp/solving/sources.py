"""Where the candidate poses of a solution come from: the search, a trained module, or one after the other."""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import nn

from bpnp.loops.parallel import Deadline
from bpnp.search.enumeration.search import is_crowd
from bpnp.search.many import search_poses, search_proposed
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict import SearchResult
from bpnp.solving.finishing import finished, without_pose
from bpnp.solving.networks import device_of, evaluation_copy, pose_prior, predicted, proposals_for, proposed, view_for
from bpnp.solving.problem import Problem
from bpnp.solving.processes import in_processes
from bpnp.solving.solution import Solution

GPU_PAIRS, GPU_CELLS = 64, 2**26  # solved together by a module: pairs, and pairs x 2D points x 3D points

WORTH_FORKING = 0.3  # seconds of work; starting processes takes some tens of milliseconds

Progress = Callable[[int, int, float], None]  # pair, batches of starts so far, seconds


class Options(NamedTuple):
    """What applies to all pairs; see `bpnp.solve`.

    solver: None for the search. asks: whether a search in doubt asks packaged matchers for poses (`proposals_for`).
    device: None for that of each module. settings: of the search.
    """

    solver: nn.Module | None = None
    asks: bool = True
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
    for problem in rest.values():
        for net in (options.solver, problem.prior):
            if isinstance(net, nn.Module):
                view_for(net, problem)  # before anything is solved
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
            problem.sets, around=None if net is None else pose_prior(net, problem, deadline), clutter=options.clutter,
            proposals=proposals_for(problem, options.seed) if options.asks else None, seed=options.seed,
            deadline=deadline, settings=options.settings,
            progress=None if options.progress is None else partial(options.progress, i),
        )  # fmt: skip
        if not len(result.candidates) and deadline.passed():
            result = replace(result, reason=f"no pose was found in {options.time_limit:g} s; try a longer time limit")
        yield i, result, time.perf_counter() - start


def _predicted(problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, SearchResult, float]]:
    """Number, result and seconds of each problem, of a module.

    A matcher's assignment of many points proposes poses, from which the search goes on. Of other modules the poses
    count; on a GPU they get pairs of similar size together.
    """
    from bpnp.models.matcher import Matcher  # the networks, where one is given

    assert options.solver is not None
    net = evaluation_copy(options.solver, options.device)
    others = dict(problems)
    if isinstance(net, Matcher):
        for i, problem in problems.items():
            sets = problem.sets
            if not is_crowd(sets):
                continue
            del others[i]
            start, deadline = time.perf_counter(), Deadline.after(options.time_limit)
            result = search_proposed(
                sets, partial(proposed, net, problem, options.seed), clutter=options.clutter, seed=options.seed,
                deadline=deadline, settings=options.settings,
            )  # fmt: skip
            yield i, result, time.perf_counter() - start
    for group in [[i] for i in others] if device_of(net).type == "cpu" else _groups(others):
        start = time.perf_counter()
        found = predicted(net, [problems[i] for i in group], Deadline.after(options.time_limit))
        seconds = (time.perf_counter() - start) / len(group)
        yield from ((i, result, seconds) for i, result in zip(group, found, strict=True))


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
