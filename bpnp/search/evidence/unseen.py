"""The probability that a better optimum than the best pose exists and was not met.

It lies near the best pose or far from it, and what the matches say counts against both:

    P = 10^(-3 e) (max(2^-h, q) F G^(l - 1) + q 2^-h)

- Starts. Let a better optimum attract a start as often as the best pose does, or more often. Of h independent starts
  that ended at one of the two, all ended at the best pose with a probability of at most 2^-h.
- Near. Starts that share a wide optimum end at whichever narrow one lies in their way: however many they are, a better
  one lies beside it with the probability q. A look, starts drawn on purpose around the best pose, fails to meet it with
  the probability F, and each one after that with G, since looks miss the same optima; without a look F G^(l - 1) is 1.
- Far. A pose that exceeds chance and is far from a better one is a rare repetition or symmetry: q.
- Matches. A pose with a better one elsewhere explains a part of the points by coincidence: it aligns a part of the
  scene, or slides along a surface, and each of its matches is worth little. With e decades of evidence a match, a match
  is a coincidence with a probability of 10^-e. Matches depend on each other; but three fix a pose, and at least as many
  others have to be independent coincidences: 10^-3e.

The first is what remains of the posterior of unseen optima of Boender and Rinnooy Kan where only two optima matter.
Source: C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
Math. Programming 1987.
"""

import math

from bpnp.search.evidence.settings import Evidence


def log10_missed(hits: int, decades_a_match: float, looks: int, rule: Evidence) -> float:
    """log10 of the probability that a better optimum was not met.

    hits: independent starts that ended at the best pose. decades_a_match: of its evidence, 0 where its matches are no
    evidence of each other, as in repeated structures. looks: how often its surroundings were searched in vain.

    >>> rule = Evidence()
    >>> [round(log10_missed(*seen, rule), 2) for seen in ((0, 0.0, 0), (7, 0.0, 0), (7, 0.0, 1), (1, 1.0, 0))]
    [0.0, -2.0, -3.24, -3.3]
    """
    unseen = near_missed(hits, looks, rule) + far_missed(hits, rule)
    return min(math.log10(unseen) - rule.independent * max(decades_a_match, 0.0), 0.0)


def near_missed(hits: int, looks: int, rule: Evidence) -> float:
    """Probability that a better optimum beside the best pose was not met."""
    overlooked = rule.look_fails * rule.again_fails ** (looks - 1) if looks else 1.0
    return max(0.5**hits, rule.another) * overlooked


def far_missed(hits: int, rule: Evidence) -> float:
    """Probability that a better optimum far from the best pose was not met."""
    return rule.another * 0.5**hits
