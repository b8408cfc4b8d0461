"""Options for all problems of a call, and their solutions: each by the search, or by a trained module.

Minimal solvers such as P3P are in `bpnp.search.propose.minimal_solvers`.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bpnp.arrays import Array
from bpnp.runtime import Clock, Deadline
from bpnp.search.assemble import OneCamera, Solved, assembled
from bpnp.search.few_points.enumeration import exceeds_enumeration
from bpnp.search.find import find_case
from bpnp.search.problem import Problem
from bpnp.search.propose.mirror import mirrored_alarms
from bpnp.search.schedule import Proposals
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import PosePrior
from bpnp.search.verdict import reasons
from bpnp.search.verdict.decide import Case, SearchResult, decide
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS

BATCH_ENTRIES = 2**26  # largest assignment matrix of a batch on a GPU, 2D points times 3D points [entries; cost]
MATCHER_ENTRIES = 2**22  # largest assignment matrix of a packaged matcher; larger ones take seconds [entries; cost]
# Time of a packaged matcher, over the sum of the squared numbers of 2D and of 3D points; it is not asked with less time
# left.
MATCHER_SECONDS = 2e-7  # [seconds; cost]
LOADING_SECONDS = 2.0  # time to import torch and to load the weights [seconds; cost]
TIME_LIMIT = 10.0  # default time limit of `solve`, and of `verify` [seconds; convention]
ENDING_SECONDS = 4e-3  # time of verdict and matching after a search, at most half of a limit [seconds; cost]
ENDING_SECONDS_A_POINT = 1.2e-5  # time that each 2D or 3D point adds to it [seconds per point; cost]
GRACE_SECONDS = 0.3  # time by which they may exceed a limit before the rest is cut off [seconds; convention]

if TYPE_CHECKING:
    import torch

Progress = Callable[[int, int, float], None]  # problem index, batches of initial poses so far, seconds
VIEW_MATCHER, SCENE_MATCHER = "matcher-maps", "matcher-sfm"  # packaged weights for the frames "view" and "any"


class Options(NamedTuple):
    """Options for all problems; see `bpnp.solve`."""

    solver: "torch.nn.Module | None" = None  # module that solves the problems; None for the search
    asks: bool = True  # let an undecided search start from poses of the packaged matchers
    inlier_threshold: float | None = None  # largest reprojection error of a match; None for the default
    clutter: float | None = None  # expected outlier fraction; None if it is unknown
    seed: int = 0
    time_limit: float | None = None  # seconds per problem, which the reasons state; None for no limit
    device: "torch.device | None" = None  # device of the modules; None for that of each module
    progress: Progress | None = None  # callback with (problem index, batches of initial poses, seconds)
    settings: SearchSettings = DEFAULT
    until: Deadline = Deadline()  # deadline for all searches together

    def progress_of(self, i: int) -> Callable[[int, float], None] | None:
        """Return the callback of problem i, with (batches of initial poses, seconds); None without one."""
        return None if self.progress is None else partial(self.progress, i)

    def numbered(self, i: int) -> "Options":
        """Return the options of problem i when it is solved alone: the callback gets this index."""
        progress = self.progress
        if progress is None:
            return self
        return self._replace(progress=lambda _, batches, seconds: progress(i, batches, seconds))

    @property
    def is_part(self) -> bool:
        """True for one search of several within a time limit; their reason then speaks of it."""
        return self.until.end is not None

    def deadline(self, problem: Problem) -> Deadline:
        """Return when the search of a problem that starts now has to stop, so that verdict and matching end in time."""
        return self.limit().before(ending_seconds(problem))

    def limit(self) -> Deadline:
        """Return the deadline of what starts now, without time for its ending, at most `GRACE_SECONDS` longer."""
        until, at = self.until, min(Deadline.after(self.time_limit).at, self.until.at)
        unfinished = set[str]() if math.isinf(until.final) else until.unfinished
        return Deadline(at, until.end if until.end is not None else at + GRACE_SECONDS, unfinished)


def ending_seconds(*problems: Problem) -> float:
    """Return the expected time of the verdict and the matching after a search."""
    points = sum(len(problem.bearings) + len(problem.points3d) for problem in problems)
    return ENDING_SECONDS + ENDING_SECONDS_A_POINT * points


def solve_problems(problems: Mapping[int, Problem], options: Options) -> dict[int, Solved]:
    """Return the solution of each problem, by the index of the problem."""
    solutions: dict[int, Solved] = {}
    solvable: dict[int, Problem] = {}
    copies: dict[int, torch.nn.Module] = {}
    for i, problem in problems.items():
        if problem.degenerate is not None:
            solutions[i] = without_pose(problem, problem.degenerate, options.inlier_threshold)
            continue
        net = problem.network
        if net is not None or options.solver is not None:
            from bpnp.search.propose.networks import evaluation_copy, view_for

            for module in (options.solver, net):
                if module is not None:
                    view_for(module, problem)  # raises before anything is solved
            if net is not None:
                copies[id(net)] = copies.get(id(net)) or evaluation_copy(net, options.device)
                problem = replace(problem, network=copies[id(net)])
        solvable[i] = problem
    if options.solver is not None and solvable:
        return solutions | dict(_by_module(evaluation_copy(options.solver, options.device), solvable, options))
    return solutions | {i: _by_search(i, problem, options) for i, problem in solvable.items()}


def at_deadline(result: SearchResult, options: Options, deadline: Deadline, seconds: float) -> SearchResult:
    """Return the result of a search, which its deadline may have cut short; the reason and the deadline then note it.

    Without a time limit the reason states the seconds that the search took.
    """
    is_open = result.verdict != "confident" and (not result.is_settled or result.code in reasons.UNTESTED)
    if not (is_open and deadline.passed()):
        return result
    if not result.is_settled:
        deadline.unfinished.add(reasons.Unfinished.search)
    if options.is_part:
        return result
    return replace(result, reason=reasons.undecided(result.reason, options.time_limit or seconds))


def without_pose(problem: Problem, why: str, inlier_threshold: float | None) -> Solved:
    """Return the solution of a problem whose points fix no pose."""
    case = Case.without_pose(problem, reasons.objection("degenerate", why=why), exhaustive=True)
    return Solved(case, assembled(OneCamera(problem), decide(case), inlier_threshold=inlier_threshold))


def _solved(
    problem: Problem, case: Case, result: SearchResult, options: Options, deadline: Deadline, seconds: float
) -> Solved:
    threshold = options.inlier_threshold
    solution = assembled(
        OneCamera(problem, case), result, seconds=seconds, inlier_threshold=threshold, deadline=deadline
    )
    return Solved(case, solution)


def _by_search(i: int, problem: Problem, options: Options) -> Solved:
    start, deadline = time.perf_counter(), options.deadline(problem)
    case = find_case(
        problem,
        around=None if problem.network is None else _pose_of_network(problem.network, problem, deadline),
        clutter=options.clutter,
        proposals=_proposals_of_matcher(problem, options.seed, deadline) if options.asks else None,
        seed=options.seed,
        deadline=deadline,
        settings=options.settings,
        progress=options.progress_of(i),
    )
    seconds = time.perf_counter() - start
    result = at_deadline(decide(case), options, deadline, seconds)
    if result.verdict == "failed" and mirrored_alarms(problem, deadline) <= MOST_FALSE_ALARMS:
        result = replace(result, reason=f"{result.reason}; {reasons.MIRRORED}")
    return _solved(problem, case, result, options, deadline, seconds)


def _pose_of_network(net: "torch.nn.Module", problem: Problem, deadline: Deadline) -> PosePrior | None:
    from bpnp.search.propose.networks import pose_prior

    return pose_prior(net, problem, deadline)


def _proposals_of_matcher(problem: Problem, seed: int, deadline: Deadline) -> Proposals | None:
    """Return a function that proposes poses of the packaged matcher for a problem; None if no matcher applies.

    The matcher for views near a known pose applies with a `PosePrior`. The matcher for scenes in any axes applies
    without a prior and with few enough points. Networks are imported only when the function is called, if the search is
    undecided and there is time for them.
    """
    weights = VIEW_MATCHER if isinstance(problem.prior, PosePrior) else SCENE_MATCHER
    too_many = len(problem.bearings) * len(problem.points3d) > MATCHER_ENTRIES
    if weights == SCENE_MATCHER and (too_many or problem.prior is not None or problem.network is not None):
        return None

    def propose() -> tuple[Array, Array]:
        if Clock.now() + _seconds_of_matcher(problem) > deadline.at:
            deadline.unfinished.add(reasons.Unfinished.matcher)
            return np.empty((0, 3, 3)), np.empty((0, 3))
        from bpnp.search.propose.networks import packaged_matcher, proposed

        return proposed(packaged_matcher(weights), problem, seed)

    return propose


def _seconds_of_matcher(problem: Problem) -> float:
    """Return the expected time of a packaged matcher, which cannot be interrupted."""
    squares = len(problem.bearings) ** 2 + len(problem.points3d) ** 2
    return MATCHER_SECONDS * squares + (0.0 if "torch" in sys.modules else LOADING_SECONDS)


def _by_module(
    net: "torch.nn.Module", problems: Mapping[int, Problem], options: Options
) -> Iterator[tuple[int, Solved]]:
    """Yield the solutions of a module, by the index of the problem.

    With a Matcher and too many points to enumerate, a search starts from poses sampled from its assignment. Otherwise
    the poses of the module are the result. On a GPU the module gets problems of similar size together.
    """
    from bpnp.models.matcher import Matcher
    from bpnp.search.propose.networks import device_of, predicted, proposed

    groups: list[list[int]] = []
    cells = {i: len(problem.bearings) * len(problem.points3d) for i, problem in problems.items()}
    for i in sorted(problems, key=cells.__getitem__):
        start, problem = time.perf_counter(), problems[i]
        if isinstance(net, Matcher) and exceeds_enumeration(problem):
            deadline = options.deadline(problem)
            case = find_case(
                problem,
                proposals=partial(proposed, net, problem, options.seed),
                only_proposals=True,
                clutter=options.clutter,
                seed=options.seed,
                deadline=deadline,
                settings=options.settings,
                progress=options.progress_of(i),
            )
            yield i, _solved(problem, case, decide(case), options, deadline, time.perf_counter() - start)
        elif groups and device_of(net).type != "cpu" and cells[i] * (len(groups[-1]) + 1) <= BATCH_ENTRIES:
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in groups:
        start, members = time.perf_counter(), [problems[i] for i in group]
        deadline = options.deadline(members[-1])
        cases = predicted(net, members, deadline)
        seconds = (time.perf_counter() - start) / len(group)
        for i, case in zip(group, cases, strict=True):
            yield i, _solved(problems[i], case, decide(case), options, deadline, seconds)
