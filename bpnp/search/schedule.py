"""Steps of a search in order, until a pose is confident or the budget is spent.

| best pose so far                | steps                                                                      |
|---------------------------------|----------------------------------------------------------------------------|
| none, and a guess is given      | batches of starts around it                                                |
| near a rough prior              | density-map search, then a batch of starts over all rotations              |
| not significant                 | a batch of starts over all rotations, and density-map searches over all    |
|                                 | rotations of equal duration; once the proposals of a network; after each,  |
|                                 | local searches around its likeliest poses                                  |
| significant, not yet confident  | batches and searches over all rotations, and local searches around it      |

Each step draws starts, preselects them, anneals the best, and returns distinct poses, which the loop
(`bpnp.search.loop`) adds to the pool. The next step is chosen by what the pool holds then.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bpnp.search.hypotheses import Hypotheses, select_distinct, to_scene_frame
from bpnp.search.loop import Step
from bpnp.search.pool import Pool
from bpnp.search.propose.density_map import (
    LOCAL,
    is_near,
    search_around,
    search_density,
    search_everywhere,
    search_near,
    select_admitted,
)
from bpnp.search.propose.given import enter_given
from bpnp.search.refine.annealing import batch_size, multistart
from bpnp.search.settings import DensitySearch
from bpnp.search.starts import PosePrior, Prior
from bpnp.search.verdict.completeness import far_missed, near_missed
from bpnp.search.verdict.limits import MOST_FALSE_ALARMS

GUESSED_BATCHES = 4  # number of batches around a guess of the pose, before all others [batches; calibration]
NEAR_STEPS = 12  # steps near a rough prior before the search treats the prior as possibly wrong [steps; calibration]
UNAIDED_ROUNDS = 10  # number of rounds without a significant pose before proposals are requested [rounds; calibration]
STARTS_A_SEARCH = 96  # starts that take as long as a search over all rotations [starts; measured, CPU time of both]
SURROUNDED_POSES = 6  # poses of a source that density-map searches are made around, at most [poses; calibration]
SURROUNDED_APART_DEG = 10.0  # least angle between the rotations of these poses, degrees [degrees; calibration]
MOST_FRUITLESS = 3  # consecutive searches without a better pose that end those of a source [searches; calibration]
LOCAL_SEARCHES = 3  # local searches around a significant pose that find nothing better, at most [searches; calibration]
PROPOSED_AFTER = 4  # number of steps near a prior after which proposals are requested [steps; not tuned]
PROPOSED = DensitySearch()  # density-map search from proposed poses [`DensitySearch`; calibration]

Proposals = Callable[[], tuple[NDArray[np.float64], NDArray[np.float64]]]  # rotations (s, 3, 3), translations (s, 3)


@dataclass
class GlobalSteps:
    """Batches of starts, and after each the density-map searches over all rotations that take as long.

    Every third batch ignores the prior, which may be wrong.
    """

    pool: Pool
    scene_prior: Prior | None  # prior in the frame of the scene
    batches: int = 0
    searches: int = 0  # number of density-map searches so far
    waiting: int = 0  # number of density-map searches until the next batch

    def next_step(self) -> Step:
        """Return the next batch or density-map search."""
        scene = self.pool.scene
        if self.waiting:
            number, self.searches, self.waiting = self.searches, self.searches + 1, self.waiting - 1
            return Step(partial(search_everywhere, scene, number, self.scene_prior))
        number, self.batches = self.batches, self.batches + 1
        self.waiting = batch_size(number) // STARTS_A_SEARCH
        return Step(partial(multistart, scene, number, None if number % 3 == 2 else self.scene_prior))


@dataclass
class LocalSearches:
    """Local searches around the best poses of a step, of different rotations.

    Poses whose surroundings were searched before are skipped. The searches end after several without a better pose, or
    with a significant pose.
    """

    pool: Pool
    poses: Hypotheses  # poses to search around, best first
    fruitless: int = 0  # number of consecutive searches without a better pose
    best: float | None = None  # largest sort key of the pool before the search that runs; None if none runs

    def next_step(self) -> Step | None:
        """Return the next local search; None after the last one."""
        pool = self.pool
        if self.best is not None:
            self.fruitless = 0 if pool.best_key > self.best else self.fruitless + 1
        while len(self.poses) and self.fruitless < MOST_FRUITLESS and pool.log10_false_alarms >= 0:
            pose, self.poses = self.poses[:1], self.poses[1:]
            if not pool.is_searched(pose):
                self.best = pool.best_key
                pool.searched_around.append(pose)
                return Step(partial(search_around, pool.scene, pose, LOCAL))
        return None


@dataclass
class Plan:
    """Order of the steps of a search of one camera."""

    pool: Pool
    guess: Prior | None  # guess of the pose in the frame of the scene, used before all other sources
    proposals: Proposals | None  # function that returns poses to start from, called once
    near: PosePrior | None  # prior near which the search begins, in the frame of the scene; None after it was given up
    source: GlobalSteps | None  # starts over all rotations; None to start from proposals only
    taken: int = 0  # number of steps that the guess gave
    taken_near: int = 0  # number of steps near the prior
    asked_near: bool = False  # the proposals were requested near the prior
    rounds: int = 0  # number of rounds over all rotations
    local: LocalSearches | None = None  # local searches that are under way
    _found: list[Hypotheses] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        pool: Pool,
        around: Prior | None = None,
        proposals: Proposals | None = None,
        *,
        only_proposals: bool = False,
    ) -> "Plan":
        """Return the plan of a search over all poses, or from proposed poses only.

        The guess `around` is a pose in the frame of the problem.
        """
        if only_proposals:
            return cls(pool, None, proposals, None, None)
        guess, scene_prior = (
            None if prior is None else pool.scene.enter_prior(prior) for prior in (around, pool.problem.prior)
        )
        near = scene_prior if isinstance(scene_prior, PosePrior) and is_near(pool.scene, scene_prior) else None
        return cls(pool, guess, proposals, near, GlobalSteps(pool, None if near is not None else scene_prior))

    def next_step(self) -> Step | None:
        """Return the next step; None if there is none."""
        if self.guess is not None and self.taken < GUESSED_BATCHES:
            self.taken += 1
            return Step(partial(_dependent_batch, self.pool, self.taken - 1, self.guess))
        if self.near is not None:
            if self.taken_near < NEAR_STEPS:
                return self._next_near(self.near)
            if self.pool.log10_false_alarms < 0:
                return self._next_of_significant(partial(self._next_near, self.near))
            # The prior may be wrong: poses found near it would only displace others.
            self.pool.forget()
            self.near = None
        return self._next_of_proposals() if self.source is None else self._next_anywhere(self.source)

    def _next_near(self, prior: PosePrior) -> Step:
        """Return a step near the prior: in turn near it and over all rotations, and the proposals once."""
        scene, number = self.pool.scene, self.taken_near - self.asked_near
        undecided = self.pool.log10_false_alarms > MOST_FALSE_ALARMS
        self.taken_near += 1
        if number == PROPOSED_AFTER and self.proposals is not None and undecided:
            self.asked_near = True
            return Step(self._take_proposals())
        if number % 2:
            return Step(partial(multistart, scene, number // 2, None))
        return Step(partial(search_near, scene, prior))

    def _next_anywhere(self, source: GlobalSteps) -> Step:
        """Return a step over all rotations or a wide prior, a local search, or the proposals."""
        if not source.batches:
            return source.next_step()
        while True:
            if (step := self._next_local()) is not None:
                return step
            unaided = self.rounds > UNAIDED_ROUNDS and self.pool.log10_false_alarms >= 0
            if unaided and self.proposals is not None:
                return self._with_local_searches(Step(self._take_proposals()))
            self.rounds += 1
            if self.pool.log10_false_alarms < 0:
                return self._next_of_significant(source.next_step)
            return self._with_local_searches(source.next_step())

    def _next_of_proposals(self) -> Step | None:
        """Return the proposals, a local search around one of them, or one around a significant pose."""
        if self.proposals is not None:
            return self._with_local_searches(Step(self._take_proposals()))
        if (step := self._next_local()) is not None:
            return step
        pool = self.pool
        enough = pool.log10_false_alarms >= 0 or pool.local_searches(pool.leaders()) >= LOCAL_SEARCHES
        return None if enough else self._local_search()

    def _take_proposals(self) -> Callable[[], Hypotheses]:
        """Return a function that searches from the proposals, which are then used up."""
        proposals, self.proposals = self.proposals, None
        assert proposals is not None
        return partial(search_proposed, self.pool, proposals)

    def _with_local_searches(self, step: Step) -> Step:
        """Return a step after which the surroundings of its best poses are searched."""

        def propose() -> Hypotheses:
            self._found.append(step.propose())
            return self._found[-1]

        return step._replace(propose=propose)

    def _next_local(self) -> Step | None:
        """Return the next local search around the poses of the last step; None if there is none."""
        if self._found:
            poses = select_distinct(self._found.pop(), self.pool.scene, SURROUNDED_POSES, SURROUNDED_APART_DEG)
            self.local = LocalSearches(self.pool, poses)
        step = None if self.local is None else self.local.next_step()
        if step is None:
            self.local = None
        return step

    def _next_of_significant(self, next_start: Callable[[], Step]) -> Step:
        """Return the step that reduces the larger miss probability: a local search around the best pose, or a start."""
        pool = self.pool
        leaders = pool.leaders()
        local_searches = pool.local_searches(leaders)
        symmetric = pool.symmetry.is_known(leaders) and pool.symmetry.is_symmetric(leaders)
        basin_count = pool.symmetry.basin_count(leaders, with_copies=symmetric)
        far = far_missed(basin_count, symmetric=symmetric)
        if local_searches < LOCAL_SEARCHES and near_missed(basin_count, local_searches) > far:
            return self._local_search()
        return next_start()

    def _local_search(self) -> Step:
        """Return a local search around the best pose."""
        scene = self.pool.scene
        leader = to_scene_frame(self.pool.leaders()[:1], scene)
        return Step(partial(search_around, scene, leader, LOCAL), leader)


def _dependent_batch(pool: Pool, number: int, guess: Prior) -> Hypotheses:
    return multistart(pool.scene, number, guess).as_dependent()


def search_proposed(pool: Pool, proposals: Proposals) -> Hypotheses:
    """Run a density-map search from proposed poses that the prior of the problem admits.

    Basin counts are 0, since proposals are dependent. ValueError for wrong shapes of the proposals.
    """
    rotation, translation = (np.asarray(values, np.float64) for values in proposals())
    if rotation.shape[1:] != (3, 3) or translation.shape != (len(rotation), 3):
        raise ValueError(
            f"proposed poses have the shapes {rotation.shape} and {translation.shape}; rotations are (s, 3, 3) and "
            "translations (s, 3)"
        )
    poses = select_admitted(pool.scene, enter_given(pool.scene, rotation, translation), pool.problem.prior)
    if not len(poses):
        return poses
    return search_density(pool.scene, poses, PROPOSED)
