"""The loop of every search: propose, refine, score, judge.

A plan gives one step after the other, a step proposes refined poses, and a pool scores and keeps them. The loop ends
when the verdict on the best pose is final, when the plan has no step left, or when the budget or the time is spent.
Searches differ in their plan and pool only: one camera (`bpnp.search.plan`), a rig (`bpnp.search.rig`), and few points
(`bpnp.search.enumeration`).
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from bpnp.runtime import Clock, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.verdict.decide import SearchResult

Progress = Callable[[int, float], None]  # iterations so far, seconds


class Step(NamedTuple):
    """One step of a search.

    Attributes:
        propose: Function that returns new poses.
        around: Pose (1,) around which a local search runs; None for other steps.
        camera: Index of the rig camera whose poses they are, default 0.
        counts: True if the poses count as an iteration of that camera, default True.
    """

    propose: Callable[[], Hypotheses]
    around: Hypotheses | None = None
    camera: int = 0
    counts: bool = True


@runtime_checkable
class Plan(Protocol):
    """Order of the steps of a search."""

    def next_step(self) -> Step | None:
        """Return the next step, chosen by what the pool holds; None if there is none."""


@runtime_checkable
class Poses(Protocol):
    """Poses that a search has found so far."""

    @property
    def iterations(self) -> int:
        """Number of iterations so far."""

    def add(self, step: Step, found: Hypotheses) -> None:
        """Score the poses that a step found, and keep the best of all."""

    def may_be_decided(self) -> bool:
        """Return True if the verdict may be final; it is cheap, and `result` is computed only then."""

    def result(self, *, ended: bool = True) -> SearchResult:
        """Compute the verdict; `ended` is False while the search may go on."""


def teller(progress: Progress | None) -> Callable[[int], None]:
    """Return a function that calls `progress` with a number of iterations and the seconds since now.

    Args:
        progress: Callback of a search; None for no callback.
    """
    begun = Clock.now()

    def tell(iterations: int) -> None:
        if progress is not None:
            progress(iterations, Clock.now() - begun)

    return tell


def run(
    plan: Plan,
    poses: Poses,
    *,
    most: int,
    deadline: Deadline,
    tell: Callable[[int], None] = lambda iterations: None,
) -> SearchResult:
    """Run the steps of a plan until the verdict is final or the budget is spent.

    Args:
        plan: Steps of the search.
        poses: Poses found so far.
        most: Largest number of iterations.
        deadline: Time after which no step begins.
        tell: Called with the number of iterations after each step.

    Returns:
        Distinct poses with the verdict.
    """
    while poses.iterations < most and not deadline.passed() and (step := plan.next_step()) is not None:
        poses.add(step, step.propose())
        tell(poses.iterations)
        if poses.may_be_decided():
            result = poses.result(ended=False)
            if result.verdict == "confident" or result.settled:
                return result
    return poses.result()
