"""Blind RANSAC: triples of random 2D-3D pairs, P3P, until the time is up (the paper's global baseline)."""

import math

from jaxtyping import Int
from torch import Tensor

from bpnp.geometry import MIN_POINTS, bearings
from bpnp.loops.parallel import Deadline
from bpnp.models.baselines.single_pairs import Answer, PairSolver, SinglePair, agreement, pair_seed
from bpnp.robust.consensus import distinct_triples
from bpnp.robust.p3p import p3p

TRIPLES = 256  # solved at a time
PREVIEW = 32  # 2D points on which every hypothesis is scored
SHORTLIST = 8  # hypotheses of these triples that are then scored on all points


class RandomRansac(PairSolver):
    """Random triples of 2D-3D pairs without any matching, P3P, and the pose under which most points have a partner.

    `residual` of the pose is the share of points of both sides without a partner. It converges when an all-true triple
    would have been drawn with probability `confidence`, were the matches of the best pose the true ones; with m = n =
    1000 that takes some 10^9 triples. The random numbers depend on the seed and on the pair's index alone.

    Args:
        threshold: distance of partners in the normalised image.
        confidence: probability at which to stop; 1 for never.
        max_hypotheses: most triples; null for as many as the time allows.
        seed: of the triples.
        time_limit: seconds per pair; null for none, which needs `max_hypotheses`.
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

    def solve(self, pair: SinglePair, deadline: Deadline) -> Answer:
        m, n = len(pair.points2d), len(pair.points3d)
        seed, best, tried, most, pairs = 2 * pair_seed(self.seed, pair.index), None, 0, 0, 0
        while tried < self.max_hypotheses and not deadline.passed() and not self._enough(pairs, m, n, tried):
            count = int(min(TRIPLES, self.max_hypotheses - tried))
            pools = (points.new_full((1, count), len(points)) for points in (pair.points2d, pair.points3d))
            triples = (distinct_triples(pool, seed + i, skip=tried)[0] for i, pool in enumerate(pools))
            found = self._best_of(pair, *triples)
            tried += count
            if found is not None and found[2] > most:
                best, most, pairs = found[:2], found[2], found[3]
        if best is None:
            return Answer(iterations=tried)
        return Answer(best, tried, 1 - most / (m + n), self._enough(pairs, m, n, tried))

    def _best_of(
        self, pair: SinglePair, triples2d: Int[Tensor, "h 3"], triples3d: Int[Tensor, "h 3"]
    ) -> tuple[Tensor, Tensor, int, int] | None:
        """The best pose of the triples, the number of points with a partner under it, and that of pairs."""
        solution = p3p(bearings(pair.points2d)[triples2d], pair.points3d[triples3d])
        rotation, translation = solution.rotation[solution.valid], solution.translation[solution.valid]
        if len(rotation) > SHORTLIST:
            # A stride takes points from all of the image, should they be in an order.
            some = pair.points2d[:: max(1, len(pair.points2d) // PREVIEW)]
            few = agreement(some, pair.points3d, rotation, translation, threshold=self.threshold)
            chosen = (few.partnered2d * len(pair.points3d) + few.partnered3d * len(some)).topk(SHORTLIST).indices
            rotation, translation = rotation[chosen], translation[chosen]
        if len(rotation) == 0:
            return None
        counts = agreement(pair.points2d, pair.points3d, rotation, translation, threshold=self.threshold)
        i = int(counts.points.argmax())
        points, pairs = int(counts.points[i]), int(counts.pairs[i])
        return (rotation[i], translation[i], points, pairs) if pairs >= MIN_POINTS else None

    def _enough(self, pairs: int, m: int, n: int, tried: int) -> bool:
        """Whether one of the triples is all true with the probability wanted, if `pairs` pairs are true."""
        true = probability_of_true_triple(pairs, m, n)
        if self.confidence == 1 or true == 0:
            return False
        return true == 1 or tried >= math.log(1 - self.confidence) / math.log1p(-true)


def probability_of_true_triple(pairs: int, m: int, n: int) -> float:
    """Probability that three random pairs, no point twice, are all among the `pairs` one-to-one true ones."""
    return math.prod(max(0, pairs - i) / ((m - i) * (n - i)) for i in range(3))
