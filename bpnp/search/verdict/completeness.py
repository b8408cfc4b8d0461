"""Completeness of a search: the probability that a better pose exists and was not visited."""

import math

import numpy as np
from numpy.typing import NDArray

from bpnp.poses import SAME
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Problem
from bpnp.search.propose.collinear import find_line
from bpnp.search.propose.repetitions import SYMMETRIC, matched_points, registered
from bpnp.search.propose.symmetries import Motions
from bpnp.search.verdict.limits import MOST_MISSED

INDEPENDENT_MATCHES = 3  # coincidences that a better optimum needs, as many as fix a pose [matches; derived]
ANOTHER = 0.01  # a better optimum exists although several starts ended at a significant one [probability; calibration]
# Probability that a better pose of a symmetric scene is not among those of its motions.
UNCOMPARED = 1e-3  # [probability; measured, symmetric objects of `benchmarks completeness`]
LOOK_FAILS = 1 / 20  # a local search around a wrong pose misses a better one: 40 of 922 did [probability; calibration]
AGAIN_FAILS = 1 / 3  # probability that a further local search misses it as well: 8 of 29 did [probability; calibration]


def log10_missed(
    basin_count: int,
    decades_a_match: float,
    local_searches: float | int,
    *,
    independent: int = INDEPENDENT_MATCHES,
    symmetric: bool = False,
) -> float:
    """Return log10 of the probability that a better optimum than the best pose exists and was missed.

    The better optimum may lie near the best pose or far from it. The evidence of the matches lowers both probabilities:

        P = 10^(-3 e) (max(2^-k, q) mu1 mu2^(L - 1) + q 2^-k)

    - Basin count k. Let a better optimum attract initial poses at least as often as the best pose. If k independent
      ones ended at one of the two, all ended at the best pose with a probability of at most 2^-k.
    - Near. Initial poses that share a wide optimum end at the same narrow one inside it. However many they are, a
      better one lies near it with the probability q. The first of L local searches around the best pose misses it with
      the probability mu1. Each further one misses it with mu2, which is larger, since local searches miss the same
      optima. With L = 0, mu1 mu2^(L - 1) is replaced by 1.
    - Far. This needs a repetition or a symmetry of the scene, which has the probability q.
    - Matches. A pose with a better one elsewhere explains part of the points by coincidence: it aligns a part of the
      scene or slides along a surface. Each of its matches then has little evidence. A match with e decades of evidence
      is a coincidence with a probability of 10^-e. Matches are dependent; but three fix a pose, and at least three
      others must be independent coincidences: 10^-3e.

    mu1 is `LOOK_FAILS`, mu2 is `AGAIN_FAILS`, q is `ANOTHER`. The term 2^-k is the posterior of unseen optima of
    Boender and Rinnooy Kan for two optima. In P the number of independent coincidences is 3. e is 0 if matches do not
    confirm each other, as in repeated structures. If the motions of a symmetric scene were tried, q of a far optimum is
    `UNCOMPARED`.

    Source: C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
    Math. Programming 1987.

    >>> [round(log10_missed(*basins), 2) for basins in ((0, 0.0, 0), (7, 0.0, 0), (7, 0.0, 1), (1, 1.0, 0))]
    [0.0, -2.0, -3.24, -3.3]
    """
    unseen = near_missed(basin_count, local_searches) + far_missed(basin_count, symmetric=symmetric)
    return min(math.log10(unseen) - independent * max(decades_a_match, 0.0), 0.0)


def near_missed(basin_count: int, local_searches: float | int) -> float:
    """Return the probability that a better optimum near the best pose was missed; arguments as for `log10_missed`."""
    overlooked = LOOK_FAILS * AGAIN_FAILS ** (local_searches - 1) if local_searches else 1.0
    return max(0.5**basin_count, ANOTHER) * overlooked


def far_missed(basin_count: int, *, symmetric: bool = False) -> float:
    """Return the probability that a better optimum far from the best pose was missed.

    The prior probability is `UNCOMPARED` in a symmetric scene, else `ANOTHER`.
    """
    return (UNCOMPARED if symmetric else ANOTHER) * 0.5**basin_count


class Symmetry:
    """Motions that map the matched points of a pose onto other scene points, registered once for equal poses.

    A motion that maps a large part of them could by itself explain a better pose.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._known: list[tuple[NDArray[np.float64], NDArray[np.float64], Motions]] = []

    def of(self, poses: Hypotheses) -> Motions:
        """Return the motions of the first pose."""
        if (motions := self._find(poses)) is None:
            pose, least = poses.pose(), float(self._problem.image.scales[0])
            motions = registered(self._problem, *pose, max(float(poses.scale[0]), least))
            self._known.append((*pose, motions))
        return motions

    def is_known(self, poses: Hypotheses) -> bool:
        """Return True if the motions of the first pose were registered before."""
        return len(poses) > 0 and self._find(poses) is not None

    def is_symmetric(self, poses: Hypotheses) -> bool:
        """Return True if a motion maps `SYMMETRIC` of the matched points of the first pose.

        Motions of another scale are left out if there is a baseline.
        """
        motions = self.of(poses)
        fraction = motions.fraction[motions.scale == 1] if self._problem.baseline else motions.fraction
        return float(fraction.max(initial=0)) >= SYMMETRIC

    def basin_count(self, poses: Hypotheses, *, with_copies: bool = False) -> int:
        """Return the basin count of the first pose and of all poses equal to it.

        With copies, the poses that the motions of the scene confuse with the first one count too. Each is compared
        with it separately, and a better pose elsewhere has the same number of copies.
        """
        first = poses.rotation[:1], poses.translation[:1]
        if with_copies:
            copies = self.of(poses).competitors(first[0][0], first[1][0])
            first = np.concatenate([first[0], copies[0]]), np.concatenate([first[1], copies[1]])
        counted, tolerance = np.zeros(len(poses), bool), SAME
        for pose in zip(*first, strict=True):
            counted |= self._problem.same_as(pose, poses.rotation, poses.translation, tolerance)
        return int(poses.basin_count[counted].sum())

    def _find(self, poses: Hypotheses) -> Motions | None:
        for rotation, translation, motions in self._known:
            if self._problem.same_as(poses.pose(), rotation[None], translation[None], SAME)[0]:
                return motions
        return None


def missed(
    poses: Hypotheses,
    problem: Problem,
    symmetry: Symmetry,
    local_searches: float | int,
    *,
    decades_a_match: float,
) -> float:
    """Return log10 of the probability that the search missed a better optimum than the first of its poses.

    If a motion maps the matched points onto others, matches of a wrong pose are not independent coincidences, and only
    basin counts reduce the value. A prior then reduces the probability of a better pose elsewhere.
    """
    count = symmetry.basin_count(poses)
    value = log10_missed(count, decades_a_match, local_searches)
    if value <= MOST_MISSED and decades_a_match:
        independent = independent_matches(poses, problem)
        value = log10_missed(count, decades_a_match, local_searches, independent=independent)
    if value > MOST_MISSED or not symmetry.is_symmetric(poses):
        return value
    count = symmetry.basin_count(poses, with_copies=True)
    fraction = problem.log10_prior_fraction(*poses.pose())
    return min(log10_missed(count, 0.0, local_searches, symmetric=True) + fraction, 0.0)


def independent_matches(poses: Hypotheses, problem: Problem) -> int:
    """Return the number of matches that must be independent coincidences if the first pose is wrong.

    It is `INDEPENDENT_MATCHES`, unless most matched points lie on a line of the scene. Wrong poses then share these
    matches, one of the other points fixes the rotation about the line, and only the rest are coincidences.
    """
    scale = max(float(poses.scale[0]), float(problem.image.scales[0]))
    points = problem.points3d[matched_points(problem, *poses.pose(), scale)]
    line = find_line(points)
    if line is None:
        return INDEPENDENT_MATCHES
    return int(np.clip((line.distances(points) > line.radius).sum() - 1, 0, INDEPENDENT_MATCHES))
