"""Blind RANSAC: triples of random 2D-3D pairs, P3P, until the time is up (the paper's global baseline)."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from bpnp.geometry import MIN_POINTS, bearings
from bpnp.models.baselines.agreement import agreement
from bpnp.models.baselines.single_pairs import Clock, Found, PairSolver, SinglePair, generator_for, no_pose
from bpnp.robust.p3p import p3p

PREVIEW = 32  # 2D points on which every hypothesis is tried
SHORTLIST = 8  # hypotheses of a chunk that are then tried on all points


class _Best(NamedTuple):
    rotation: Tensor
    translation: Tensor
    points: int  # with a partner, on both sides
    pairs: int


class RandomRansac(PairSolver):
    """Random triples of 2D-3D pairs without any matching, P3P, and the pose with the most points near a partner.

    `residual` of the pose is the share of points of both sides without a partner. It converges when an all-true triple
    would have been drawn with probability `confidence`, were the matches of the best pose the true ones; with m = n =
    1000 that takes some 10^9 triples. The random numbers depend on the seed and on the pair's index alone.

    Args:
        threshold: distance of partners in the normalised image.
        confidence: probability at which to stop; 1 for never.
        max_hypotheses: most triples; null for as many as the time allows.
        chunk: triples solved at a time.
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
        chunk: int = 256,
        seed: int = 0,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        if time_limit is None and max_hypotheses is None:
            raise ValueError("expected `time_limit` or `max_hypotheses`, got neither; try time_limit 30")
        if not 0 < confidence <= 1 or not threshold > 0:
            raise ValueError(
                f"expected `threshold` > 0 and `confidence` in (0, 1], got {threshold} and {confidence}"
            )  # fmt: skip
        self.threshold, self.confidence, self.chunk, self.seed = threshold, confidence, chunk, seed
        self.max_hypotheses = max_hypotheses

    def solve(self, pair: SinglePair, clock: Clock) -> Found:
        generator = generator_for(self.seed, pair.index)
        m, n = len(pair.points2d), len(pair.points3d)
        tried, best = 0, None
        needed = math.inf if self.max_hypotheses is None else self.max_hypotheses
        while tried < needed and not clock.over():
            count = int(min(self.chunk, needed - tried))
            best = self._improve(best, pair, _triples(generator, count, m), _triples(generator, count, n))
            tried += count
            if best is not None and self._enough(best.pairs, m, n, tried):
                return self._found(best, tried, m + n, converged=True)
        return (
            no_pose(pair.points3d, tried) if best is None else self._found(best, tried, m + n, converged=False)
        )  # fmt: skip

    def _improve(self, best: _Best | None, pair: SinglePair, triples2d: Tensor, triples3d: Tensor) -> _Best | None:
        """The best of the poses of some triples, and of the best so far."""
        device = pair.points2d.device
        solution = p3p(bearings(pair.points2d)[triples2d.to(device)], pair.points3d[triples3d.to(device)])
        rotation, translation = solution.rotation[solution.valid], solution.translation[solution.valid]
        if len(rotation) == 0:
            return best
        if len(rotation) > SHORTLIST:
            # Points are in no order that tells anything; a stride takes some from everywhere if they were.
            some = pair.points2d[:: max(1, len(pair.points2d) // PREVIEW)]
            few = agreement(some, pair.points3d, rotation, translation, threshold=self.threshold)
            chosen = (few.near2d * len(pair.points3d) + few.near3d * len(some)).topk(SHORTLIST).indices
            rotation, translation = rotation[chosen], translation[chosen]
        near = agreement(pair.points2d, pair.points3d, rotation, translation, threshold=self.threshold)
        points = near.near2d + near.near3d
        i = int(points.argmax())
        if int(near.pairs[i]) < MIN_POINTS or (best is not None and int(points[i]) <= best.points):
            return best
        return _Best(rotation[i], translation[i], int(points[i]), int(near.pairs[i]))

    def _enough(self, pairs: int, m: int, n: int, tried: int) -> bool:
        if self.confidence == 1:
            return False
        true = probability_of_true_triple(pairs, m, n)
        return true == 1 or (true > 0 and tried >= math.log(1 - self.confidence) / math.log1p(-true))

    def _found(self, best: _Best, tried: int, points: int, *, converged: bool) -> Found:
        return Found(best.rotation, best.translation, tried, 1 - best.points / points, converged)


def probability_of_true_triple(pairs: int, m: int, n: int) -> float:
    """Probability that three random pairs, no point twice, are all among the `pairs` one-to-one true ones."""
    return math.prod(max(0, pairs - i) / ((m - i) * (n - i)) for i in range(3))


def _triples(generator: torch.Generator, count: int, points: int) -> Int[Tensor, "h 3"]:
    """Three different indices out of `points`, uniformly and in random order."""
    first, second, third = (torch.randint(points - i, (count,), generator=generator) for i in range(3))
    second = second + (second >= first)
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    third = third + (third >= low)
    third = third + (third >= high)
    return torch.stack([first, second, third], -1)
