"""P3P without any matching: on random triples until the time is up (the paper's RANSAC), and on triples of neighbours
as open trackers of LED headsets try them (constellation matching)."""

import itertools
import math

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from bpnp.checks import check_positive
from bpnp.geometry import MIN_POINTS, bearings, project, transform
from bpnp.loops.parallel import Deadline
from bpnp.models.baselines.single_problem import Answer, SingleProblem, SingleSolver, agreement
from bpnp.robust.consensus import Matches, distinct_triples, refine_locally
from bpnp.robust.minimal_solvers import p3p

TRIPLES = 256  # random ones, solved at a time
PREVIEW = 32  # 2D points on which every hypothesis of random triples is scored
HYPOTHESES = 8  # of these triples that are then scored on all points
CHUNK = 2**14  # triples of neighbours, solved at a time
SHORTLIST = 64  # poses that are matched one to one and refined
REFINE_STEPS = 10  # Gauss-Newton steps on the one-to-one matches of a pose


def solutions(problem: SingleProblem, triples2d: Tensor, triples3d: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (s, 3, 3) and translations (s, 3) under which triples (h, 3) match, up to four each."""
    solution = p3p(bearings(problem.points2d)[triples2d], problem.points3d[triples3d])
    return solution.rotation[solution.valid], solution.translation[solution.valid]


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
        sides = problem.points2d, problem.points3d
        m, n = map(len, sides)
        seed, best, tried, most, matches = 2 * problem.seed(self.seed), None, 0, 0, 0
        while tried < self.max_hypotheses and not deadline.passed() and not self._enough(matches, m, n, tried):
            count = int(min(TRIPLES, self.max_hypotheses - tried))
            pools = (points.new_full((1, count), len(points)) for points in sides)
            triples = (distinct_triples(pool, seed + i, skip=tried)[0] for i, pool in enumerate(pools))
            rotation, translation = solutions(problem, *triples)
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


class Constellation(SingleSolver):
    """Few points: P3P on every triple of an image point and two of its neighbours with every ordered triple of a scene
    point and two of its neighbours. Of all poses the one with the most one-to-one matches is returned.

    About m k (k - 1) / 2 times n l (l - 1) triples are solved, k and l being the neighbours of either side. The poses
    under which most points have a partner are matched one to one, refined on their matches and matched again. Equal
    numbers are decided by the sum of squared distances. `residual` is the root mean square distance of the matches in
    the normalised image; `converged`: at least `min_matches` matches, and all triples were tried.

    Args:
        radius: largest distance of a match in the normalised image (0.003 is 2.4 px at a focal length of 800).
        neighbours2d: nearest image points from which the triples of an image point are made.
        neighbours3d: nearest scene points from which the triples of a scene point are made.
        min_matches: fewest matches of a pose that counts as found; three are explained by the triple itself.
        time_limit: seconds a problem, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("constellation",)

    def __init__(
        self,
        *,
        radius: float = 0.003,
        neighbours2d: int = 5,
        neighbours3d: int = 6,
        min_matches: int = 6,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        check_positive(radius=radius)
        if min(neighbours2d, neighbours3d) < 2 or min_matches < MIN_POINTS:
            got = f"{neighbours2d}, {neighbours3d} and {min_matches}"
            raise ValueError(f"expected 2 or more neighbours and `min_matches` of {MIN_POINTS} or more, got {got}")
        self.radius, self.min_matches = radius, min_matches
        self.neighbours2d, self.neighbours3d = neighbours2d, neighbours3d

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        triples2d = neighbour_triples(problem.points2d, self.neighbours2d, ordered=False)
        triples3d = neighbour_triples(problem.points3d, self.neighbours3d, ordered=True)
        poses, counts, tried = [], [], 0
        for part in torch.cartesian_prod(torch.arange(len(triples2d)), torch.arange(len(triples3d))).split(CHUNK):
            if deadline.passed():
                break
            rotation, translation = solutions(problem, triples2d[part[:, 0]], triples3d[part[:, 1]])
            matched = agreement(*problem[:2], rotation, translation, threshold=self.radius).amin(0)
            most = matched.topk(min(SHORTLIST, len(rotation)))
            poses.append(torch.cat([rotation, translation.unsqueeze(-1)], -1)[most.indices])
            counts.append(most.values)
            tried += len(part)
        if tried == 0 or len(candidates := torch.cat(poses)) == 0:
            return Answer(iterations=tried)
        shortlist = torch.cat(counts).topk(min(SHORTLIST, len(candidates))).indices
        results = [self._refined(problem, pose) for pose in candidates[shortlist]]
        pose, matches, squared = max(results, key=lambda result: (result[1], -result[2]))
        if matches < MIN_POINTS:
            return Answer(iterations=tried)
        converged = matches >= self.min_matches and tried == len(triples2d) * len(triples3d)
        return Answer((pose[:, :3], pose[:, 3]), tried, (squared / matches) ** 0.5, converged)

    def _refined(self, problem: SingleProblem, pose: Float[Tensor, "3 4"]) -> tuple[Tensor, int, float]:
        """The pose refined on its matches, or as it was if that has fewer; number of matches, sum of their squares."""
        index2d, index3d, squared = self._matches(problem, pose)
        if len(index2d) >= MIN_POINTS:
            real = torch.ones(1, len(index2d), dtype=torch.bool, device=pose.device)
            matched = Matches(problem.points2d[index2d].unsqueeze(0), problem.points3d[index3d].unsqueeze(0), real)
            refined = refine_locally(pose[None, None], matched, self.radius**2, REFINE_STEPS)[0, 0]
            again, _, squared_again = self._matches(problem, refined)
            if len(again) >= len(index2d):
                return refined, len(again), float(squared_again)
        return pose, len(index2d), float(squared)

    def _matches(self, problem: SingleProblem, pose: Float[Tensor, "3 4"]) -> tuple[Tensor, Tensor, Tensor]:
        """One-to-one matches within the radius of least truncated squared distance, and the sum of their squares."""
        camera = transform(pose[:, :3], pose[:, 3], problem.points3d)
        squared = torch.cdist(problem.points2d, project(camera)).square()
        squared = torch.where(camera[:, 2] > 0, squared, torch.inf).clamp(max=self.radius**2)
        rows, columns = (torch.as_tensor(side).to(pose.device) for side in linear_sum_assignment(squared.cpu().numpy()))
        within = squared[rows, columns] < self.radius**2
        rows, columns = rows[within], columns[within]
        return rows, columns, squared[rows, columns].sum()


def neighbour_triples(points: Float[Tensor, "k d"], neighbours: int, *, ordered: bool) -> Int[Tensor, "t 3"]:
    """Every point with two of its nearest neighbours, both orders of these if `ordered`."""
    count = min(neighbours, len(points) - 1)
    nearest = torch.cdist(points, points).fill_diagonal_(torch.inf).topk(count, largest=False).indices
    pick = itertools.permutations if ordered else itertools.combinations
    chosen = torch.tensor(list(pick(range(count), 2)), device=points.device)
    itself = torch.arange(len(points), device=points.device)[:, None, None].expand(-1, len(chosen), 1)
    return torch.cat([itself, nearest[:, chosen]], -1).flatten(0, 1)
