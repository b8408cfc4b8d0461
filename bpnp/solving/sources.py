"""From problems to their solutions: by the search, by a trained module, or by one after the other."""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import nn

from bpnp.loops.parallel import Clock, Deadline, in_processes
from bpnp.search.enumeration.search import exceeds_enumeration
from bpnp.search.evidence import reasons
from bpnp.search.propose.mirror import mirrored_alarms
from bpnp.search.search import search_poses, search_proposed
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.solving.matches import finished, without_pose
from bpnp.solving.networks import device_of, evaluation_copy, pose_prior, predicted, proposals_for, proposed, view_for
from bpnp.solving.problem import Problem
from bpnp.solving.solution import Solution

Progress = Callable[[int, int, float], None]  # problem, batches of starts so far, seconds
TOGETHER = 2**26  # cells of the assignments, 2D points x 3D points, that a module solves together on a GPU
WORTH_FORKING = 0.3  # seconds of work; starting processes takes some tens of milliseconds
# Seconds, and seconds a 2D or 3D point, that the verdict and matching take after the search; of a limit at most half.
ENDING, ENDING_A_POINT = 4e-3, 8e-6


class Options(NamedTuple):
    """What applies to all problems; see `bpnp.solve`.

    solver: None for the search. asks: whether a search in doubt asks packaged matchers for poses (`proposals_for`).
    time_limit: seconds a problem, None for none. until: when all of it has to end. device: None for that of each
    module. settings: of the search.
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
    until: Deadline = Deadline()

    def deadline(self, problem: Problem) -> Deadline:
        """When to leave off searching, so that all ends in time; of a problem that is begun now."""
        begun = Clock.now()
        end = min(self.until.at, Deadline.after(self.time_limit).at)
        ending = ENDING + ENDING_A_POINT * (len(problem.image) + len(problem.points3d))
        return Deadline(max(end - ending, (begun + end) / 2))


def solutions_of(problems: Mapping[int, Problem], options: Options) -> dict[int, Solution]:
    """The solution of each problem, which has its number."""
    solutions: dict[int, Solution] = {}
    solvable: dict[int, Problem] = {}
    copies: dict[int, nn.Module] = {}
    for i, problem in problems.items():
        if problem.degenerate is not None:
            solutions[i] = without_pose(problem, problem.degenerate, options.inlier_threshold)
            continue
        net = problem.prior if isinstance(problem.prior, nn.Module) else None
        for module in (options.solver, net):
            if module is not None:
                view_for(module, problem)  # raises before anything is solved
        if net is not None:
            copies[id(net)] = copies.get(id(net)) or evaluation_copy(net, options.device)
            problem = replace(problem, prior=copies[id(net)])
        solvable[i] = problem
    if options.solver is not None:
        return solutions | dict(_by_module(evaluation_copy(options.solver, options.device), solvable, options))
    if copies:  # a process would copy the networks
        return solutions | {i: _by_search(i, problem, options) for i, problem in solvable.items()}
    return solutions | (dict(_by_searches(solvable, options)) if solvable else {})


def _by_searches(problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, Solution]]:
    """In as many processes as torch has threads, where that pays and nobody asks for the progress.

    The first one is solved here: it compiles what all need, and tells how long one takes.
    """
    first, *waiting = problems
    solution = _by_search(first, problems[first], options)
    yield first, solution
    workers = 1 if multiprocessing.current_process().daemon else torch.get_num_threads()  # which may have no children
    pays = len(waiting) > 1 and solution.seconds * len(waiting) > WORTH_FORKING
    if workers > 1 and pays and options.progress is None:
        yield from in_processes(lambda i: _by_search(i, problems[i], options), waiting, workers)
    else:
        yield from ((i, _by_search(i, problems[i], options)) for i in waiting)


def _by_search(i: int, problem: Problem, options: Options) -> Solution:
    start, deadline = time.perf_counter(), options.deadline(problem)
    radius = None if options.inlier_threshold is None else options.inlier_threshold / problem.per_radian
    result = search_poses(
        replace(problem.sets, radius=radius),
        around=pose_prior(problem.prior, problem, deadline) if isinstance(problem.prior, nn.Module) else None,
        clutter=options.clutter,
        proposals=proposals_for(problem, options.seed) if options.asks else None,
        seed=options.seed,
        deadline=deadline,
        settings=options.settings,
        progress=None if options.progress is None else partial(options.progress, i),
    )
    seconds = time.perf_counter() - start
    if not len(result.candidates) and deadline.passed():
        limit = options.time_limit or seconds
        result = replace(result, reason=f"no pose was found in {limit:.3g} s; try a longer time limit")
    elif result.verdict == "ambiguous" and not result.settled and deadline.passed():
        result = replace(result, reason=reasons.undecided(result.reason, options.time_limit or seconds))
    if result.verdict == "failed" and mirrored_alarms(problem.sets, deadline) <= options.settings.evidence.false_alarms:
        result = replace(result, reason=f"{result.reason}; {reasons.MIRRORED}")
    return finished(problem, result, seconds, options.inlier_threshold)


def _by_module(net: nn.Module, problems: Mapping[int, Problem], options: Options) -> Iterator[tuple[int, Solution]]:
    """A matcher's assignment of many points proposes poses, from which the search goes on. Of other modules the poses
    count; on a GPU they get problems of similar size together."""
    from bpnp.models.matcher import Matcher  # the networks, where one is given

    groups: list[list[int]] = []
    cells = {i: len(problem.image) * len(problem.points3d) for i, problem in problems.items()}
    for i in sorted(problems, key=cells.__getitem__):
        start, problem = time.perf_counter(), problems[i]
        if isinstance(net, Matcher) and exceeds_enumeration(problem.sets):
            result = search_proposed(
                problem.sets,
                partial(proposed, net, problem, options.seed),
                clutter=options.clutter,
                seed=options.seed,
                deadline=options.deadline(problem),
                settings=options.settings,
            )
            yield i, finished(problem, result, time.perf_counter() - start, options.inlier_threshold)
        elif groups and device_of(net).type != "cpu" and cells[i] * (len(groups[-1]) + 1) <= TOGETHER:
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in groups:
        start, members = time.perf_counter(), [problems[i] for i in group]
        results = predicted(net, members, options.deadline(members[-1]))
        seconds = (time.perf_counter() - start) / len(group)
        for i, result in zip(group, results, strict=True):
            yield i, finished(problems[i], result, seconds, options.inlier_threshold)
