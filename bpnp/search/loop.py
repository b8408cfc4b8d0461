"""The loop of every search: propose, refine, score, contest.

A plan gives one step after the other, a step proposes refined poses, and a pool scores and keeps them. Once the best
pose may be confident, its rivals are asked (`bpnp.search.verdict.contest`). The loop ends when nothing speaks against
it, when more search would not help, when the plan has no step left, or when the budget or the time is spent.
Searches differ in their plan and pool only: one camera (`bpnp.search.schedule`), a rig (`bpnp.search.rig`), and few
points (`bpnp.search.few_points`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from bpnp.runtime import Clock, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.verdict.contest import contest
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.rivals import Rival

Progress = Callable[[int, float], None]  # iterations so far, seconds


class Step(NamedTuple):
    """One step of a search."""

    propose: Callable[[], Hypotheses]  # function that returns new poses
    around: Hypotheses | None = None  # pose (1,) around which a local search runs; None for other steps
    camera: int = 0  # index of the rig camera whose poses they are
    counts: bool = True  # the poses count as an iteration of that camera


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

    @property
    def rivals(self) -> Sequence[Rival]:
        """What to ask about the best pose."""

    def may_be_decided(self) -> bool:
        """Return True if the best pose may be confident; it is cheap, and `case` is called only then."""

    def case(self, *, ended: bool = True) -> Case:
        """Return what is known of the best pose; `ended` is False while the search may go on."""


def teller(progress: Progress | None) -> Callable[[int], None]:
    """Return a function that calls `progress` with a number of iterations and the seconds since now."""
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
) -> Case:
    """Run the steps of a plan until its best pose is decided or the budget is spent; return what is known of this pose.

    After the deadline no step begins. The numbers of iterations are told after each step. The rivals of the pose were
    asked.
    """
    while poses.iterations < most and not deadline.passed() and (step := plan.next_step()) is not None:
        poses.add(step, step.propose())
        tell(poses.iterations)
        if poses.may_be_decided():
            case = contest(poses.case(ended=False), poses.rivals)
            if case.is_settled:
                return case
    return contest(poses.case(), poses.rivals)
