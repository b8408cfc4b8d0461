"""Completeness of a search: the probability that a better pose exists and was not visited."""

import math

from bpnp.search.config import Evidence


def log10_missed(
    basin_count: int,
    decades_a_match: float,
    local_searches: float | int,
    settings: Evidence,
    *,
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

    The term 2^-k is the posterior of unseen optima of Boender and Rinnooy Kan for two optima.
    Source: C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
    Math. Programming 1987.

    Args:
        basin_count: Number k of independent initial poses that ended at the best pose or at one that is not different.
        decades_a_match: Evidence e of a match; 0 if matches do not confirm each other, as in repeated structures.
        local_searches: Number L of local searches around the best pose that found no better one.
        settings: Constants; mu1 is `settings.look_fails`, mu2 is `settings.again_fails`, q is `settings.another`.
        symmetric: Use `settings.uncompared` as q of a far optimum, since the scene's motions were tried.

    >>> settings = Evidence()
    >>> [round(log10_missed(*basins, settings), 2) for basins in ((0, 0.0, 0), (7, 0.0, 0), (7, 0.0, 1), (1, 1.0, 0))]
    [0.0, -2.0, -3.24, -3.3]
    """
    unseen = near_missed(basin_count, local_searches, settings) + far_missed(basin_count, settings, symmetric=symmetric)
    return min(math.log10(unseen) - settings.independent * max(decades_a_match, 0.0), 0.0)


def near_missed(basin_count: int, local_searches: float | int, settings: Evidence) -> float:
    """Return the probability that a better optimum near the best pose was missed; arguments as for `log10_missed`."""
    overlooked = settings.look_fails * settings.again_fails ** (local_searches - 1) if local_searches else 1.0
    return max(0.5**basin_count, settings.another) * overlooked


def far_missed(basin_count: int, settings: Evidence, *, symmetric: bool = False) -> float:
    """Return the probability that a better optimum far from the best pose was missed.

    The prior probability is `settings.uncompared` in a symmetric scene, else `settings.another`.
    """
    return (settings.uncompared if symmetric else settings.another) * 0.5**basin_count
