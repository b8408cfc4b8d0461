"""P3P on random triples of 2D and 3D points until a time limit: the RANSAC baseline of the paper."""

import math

from bpnp.geometry import bearings
from bpnp.layers.ransac.matches import distinct_triples
from bpnp.layers.ransac.minimal_solvers import p3p
from bpnp.models.baselines.single_problem import Answer, SingleProblem, SingleSolver, agreement
from bpnp.poses import MIN_POINTS
from bpnp.runtime import Deadline

TRIPLES = 256  # random triples solved at a time
PREVIEW = 32  # 2D points that give the first score of a hypothesis
HYPOTHESES = 8  # best hypotheses of these triples, which are then scored on all points


class RandomRansac(SingleSolver):
    """RANSAC without matches: P3P on random triples of 2D and 3D points, keeping the pose with the most inliers.

    `residual` of the pose is the fraction of points of both sides without a point of the other side within `threshold`.
    It converges when a triple of true matches would have been drawn with probability `confidence`, if the matches of
    the best pose were the true ones. With m = n = 1000 that takes about 10^9 triples. The random numbers depend only on
    the seed and on the index of the problem.

    Differences from the paper, which names the minimal solver, the confidence and the time limit only:

    - P3P is that of Ding et al. (CVPR 2023) instead of Kneip et al. (CVPR 2011). All of its poses are candidates, so
      that three matches suffice where the paper counts four.
    - The score is the number of points of both sides with a point of the other side nearby, not only that of image
      points.
    - Of the poses of 256 triples, the 8 best on about 32 image points are scored on all points, so that more triples
      fit into the time limit.

    Args:
        threshold: Largest distance of matching points in the normalised image, default 0.01.
        confidence: Probability at which to stop, default 0.9; 1 for never.
        max_hypotheses: Largest number of triples; None for as many as the time allows.
        seed: Seed of the triples.
        time_limit: Seconds for each problem, default 30; None for no limit, which needs `max_hypotheses`.
    """

    estimates = ("random_ransac",)

    def __init__(
        self,
        *,
        threshold: float = 0.01,
        confidence: float = 0.9,
        max_hypotheses: int | None = None,
        seed: int = 0,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        if time_limit is None and max_hypotheses is None:
            raise ValueError("`time_limit` and `max_hypotheses` are both None; set one of them, such as time_limit 30")
        if not 0 < confidence <= 1 or not threshold > 0:
            raise ValueError(
                f"`threshold` is {threshold} and `confidence` {confidence}; both must be above 0, `confidence` up to 1"
            )
        self.threshold, self.confidence, self.seed = threshold, confidence, seed
        self.max_hypotheses = math.inf if max_hypotheses is None else max_hypotheses

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        """Return the pose with the most inliers among random triples; arguments as for `SingleSolver.solve`."""
        sides, rays = (problem.points2d, problem.points3d), bearings(problem.points2d)
        m, n = map(len, sides)
        seed, best, tried, most, matches = 2 * problem.seed(self.seed), None, 0, 0, 0
        while tried < self.max_hypotheses and not deadline.passed() and not self._enough(matches, m, n, tried):
            count = int(min(TRIPLES, self.max_hypotheses - tried))
            pools = (points.new_full((1, count), len(points)) for points in sides)
            triples = (distinct_triples(pool, seed + i, skip=tried)[0] for i, pool in enumerate(pools))
            found = p3p(*(side[chosen] for side, chosen in zip((rays, sides[1]), triples, strict=True)))
            rotation, translation = found.rotation[found.valid], found.translation[found.valid]
            tried += count
            if len(rotation) > HYPOTHESES:
                # A stride takes points from the whole image even if they are ordered.
                some = sides[0][:: max(1, m // PREVIEW)]
                few = agreement(some, sides[1], rotation, translation, threshold=self.threshold)
                chosen = (few[0] * n + few[1] * len(some)).topk(HYPOTHESES).indices
                rotation, translation = rotation[chosen], translation[chosen]
            if len(rotation):
                counts = agreement(*sides, rotation, translation, threshold=self.threshold)
                i = int(counts.sum(0).argmax())
                if (points := int(counts[:, i].sum())) > most and (least := int(counts[:, i].min())) >= MIN_POINTS:
                    best, most, matches = (rotation[i], translation[i]), points, least
        if best is None:
            return Answer(iterations=tried)
        return Answer(best, tried, 1 - most / (m + n), self._enough(matches, m, n, tried))

    def _enough(self, matches: int, m: int, n: int, tried: int) -> bool:
        """Return True if a triple of true matches has been drawn with the required probability."""
        true = probability_of_true_triple(matches, m, n)
        if self.confidence == 1 or true == 0:
            return False
        return true == 1 or tried >= math.log(1 - self.confidence) / math.log1p(-true)


def probability_of_true_triple(matches: int, m: int, n: int) -> float:
    """Return the probability that three random image points and three random scene points are matches."""
    return math.prod(max(0, matches - i) / ((m - i) * (n - i)) for i in range(3))
