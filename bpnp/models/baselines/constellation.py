"""Constellation matching as open trackers of LED headsets do it: brute-force P3P over triples of neighbours."""

import itertools

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from bpnp.checks import check_positive
from bpnp.geometry import MIN_POINTS, bearings, project, transform
from bpnp.loops.parallel import Deadline
from bpnp.models.baselines.single_pairs import Answer, PairSolver, SinglePair, agreement
from bpnp.robust.consensus import Pairs, refine_locally
from bpnp.robust.p3p import p3p

CHUNK = 2**14  # triples solved at a time
SHORTLIST = 64  # poses that are matched one to one and refined
REFINE_STEPS = 10  # Gauss-Newton steps on the one-to-one matches of a pose


class Constellation(PairSolver):
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
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
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

    def solve(self, pair: SinglePair, deadline: Deadline) -> Answer:
        triples2d = neighbour_triples(pair.points2d, self.neighbours2d, ordered=False)
        triples3d = neighbour_triples(pair.points3d, self.neighbours3d, ordered=True)
        poses, counts, tried = [], [], 0
        for part in torch.cartesian_prod(torch.arange(len(triples2d)), torch.arange(len(triples3d))).split(CHUNK):
            if deadline.passed():
                break
            solution = p3p(bearings(pair.points2d)[triples2d[part[:, 0]]], pair.points3d[triples3d[part[:, 1]]])
            rotation, translation = solution.rotation[solution.valid], solution.translation[solution.valid]
            count = agreement(pair.points2d, pair.points3d, rotation, translation, threshold=self.radius).pairs
            best = count.topk(min(SHORTLIST, len(count))).indices
            poses.append(torch.cat([rotation, translation.unsqueeze(-1)], -1)[best])
            counts.append(count[best])
            tried += len(part)
        if tried == 0 or len(candidates := torch.cat(poses)) == 0:
            return Answer(iterations=tried)
        shortlist = torch.cat(counts).topk(min(SHORTLIST, len(candidates))).indices
        results = [self._refined(pair, pose) for pose in candidates[shortlist]]
        pose, matches, squared = max(results, key=lambda result: (result[1], -result[2]))
        if matches < MIN_POINTS:
            return Answer(iterations=tried)
        converged = matches >= self.min_matches and tried == len(triples2d) * len(triples3d)
        return Answer((pose[:, :3], pose[:, 3]), tried, (squared / matches) ** 0.5, converged)

    def _refined(self, pair: SinglePair, pose: Float[Tensor, "3 4"]) -> tuple[Float[Tensor, "3 4"], int, float]:
        """The pose refined on its matches, or as it was if that has fewer; number of matches, sum of their squares."""
        index2d, index3d, squared = self._matches(pair, pose)
        if len(index2d) < MIN_POINTS:
            return pose, len(index2d), float(squared)
        real = torch.ones(1, len(index2d), dtype=torch.bool, device=pose.device)
        matched = Pairs(pair.points2d[index2d].unsqueeze(0), pair.points3d[index3d].unsqueeze(0), real)
        refined = refine_locally(pose[None, None], matched, self.radius**2, REFINE_STEPS)[0, 0]
        again, _, squared_again = self._matches(pair, refined)
        if len(again) < len(index2d):
            return pose, len(index2d), float(squared)
        return refined, len(again), float(squared_again)

    def _matches(
        self, pair: SinglePair, pose: Float[Tensor, "3 4"]
    ) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"], Float[Tensor, ""]]:
        """One-to-one matches within the radius of least truncated squared distance, and the sum of their squares."""
        camera = transform(pose[:, :3], pose[:, 3], pair.points3d)
        squared = torch.cdist(pair.points2d, project(camera)).square()
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
    own = torch.arange(len(points), device=points.device)[:, None, None].expand(-1, len(chosen), 1)
    return torch.cat([own, nearest[:, chosen]], -1).flatten(0, 1)
