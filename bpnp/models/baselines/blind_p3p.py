"""P3P without any matching, on random triples until the time is up: the paper's RANSAC."""

import math

from bpnp.geometry import bearings
from bpnp.loops.parallel import Deadline
from bpnp.models.baselines.single_problem import Answer, SingleProblem, SingleSolver, agreement
from bpnp.poses import MIN_POINTS
from bpnp.robust.matches import distinct_triples
from bpnp.robust.minimal_solvers import p3p

TRIPLES = 256  # random ones, solved at a time
PREVIEW = 32  # 2D points on which every hypothesis of random triples is scored
HYPOTHESES = 8  # of these triples that are then scored on all points


class RandomRansac(SingleSolver):
    """Random triples of 2D and 3D points without any matching, P3P, and the pose under which most points have a
    partner.

    `residual` of the pose is the share of points of both sides without a partner. It converges when an all-true triple
    would have been drawn with probability `confidence`, were the matches of the best pose the true ones; with m = n =
    1000 that takes some 10^9 triples. The random numbers depend on the seed and on the problem's index alone.

    Args:
        threshold: distance of partners in the normalised image.
        confidence: probability at which to stop; 1 for never.
        max_hypotheses: most triples; null for as many as the time allows.
        seed: of the triples.
        time_limit: seconds a problem; null for none, which needs `max_hypotheses`.
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
            raise ValueError("expected `time_limit` or `max_hypotheses`, got neither; try time_limit 30")
        if not 0 < confidence <= 1 or not threshold > 0:
            raise ValueError(f"expected `threshold` > 0, `confidence` in (0, 1], got {threshold} and {confidence}")
        self.threshold, self.confidence, self.seed = threshold, confidence, seed
        self.max_hypotheses = math.inf if max_hypotheses is None else max_hypotheses

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
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
                # A stride takes points from all of the image, should they be in an order.
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
        """Whether one of the triples is all true with the probability wanted, if there are so many true matches."""
        true = probability_of_true_triple(matches, m, n)
        if self.confidence == 1 or true == 0:
            return False
        return true == 1 or tried >= math.log(1 - self.confidence) / math.log1p(-true)


def probability_of_true_triple(matches: int, m: int, n: int) -> float:
    """Probability that three random image points and three random scene points are three of the one-to-one matches."""
    return math.prod(max(0, matches - i) / ((m - i) * (n - i)) for i in range(3))
