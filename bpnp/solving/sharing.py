"""Several devices in one image: no light is matched to two of them."""

from collections.abc import Callable, Mapping

import numpy as np

from bpnp.search.few.search import is_few
from bpnp.solving.problem import Problem
from bpnp.solving.solution import Solution


def shared_lights(
    problems: Mapping[int, Problem], solutions: dict[int, Solution], solve_again: Callable[[int, Problem], Solution]
) -> None:
    """Where few-point pairs have the same image points, leave each point to one pair; `solutions` is changed.

    The pair with the fewest false alarms keeps its matches. A later one that claimed one of their points is solved
    again, by `solve_again`, without these; its `stats.taken2d` says how many points that are. A failed pose keeps none.
    """
    groups: dict[bytes, list[int]] = {}
    for i, problem in problems.items():
        if problem.degenerate is None and is_few(problem.sets):
            groups.setdefault(problem.image.tobytes() + repr(problem.camera).encode(), []).append(i)
    for members in groups.values():
        taken: set[int] = set()
        for i in sorted(members, key=lambda i: (solutions[i].log10_false_alarms, i)):
            claimed = set(solutions[i].matches[:, 0].tolist())
            if claimed & taken:
                solutions[i] = solve_again(i, problems[i].without(np.array(sorted(taken))))
                claimed = set(solutions[i].matches[:, 0].tolist())
            if solutions[i].verdict != "failed":
                taken |= claimed
