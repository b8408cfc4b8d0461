"""The probability that a better optimum than the best pose exists and was not met.

Three observations speak against one. Each is a factor, and their product is compared with `Evidence.missed`.

- Starts. Let a better optimum attract a start as often as the best pose does, or more often. Of h independent starts
  that ended at one of the two, all ended at the best pose with a probability of at most 2^-h.
- Matches. A pose with a better one beside it explains a part of the points by coincidence: it aligns a part of the
  scene, or slides along a surface, and each of its matches is worth little. With e decades of evidence a match a single
  match is a coincidence with a probability of 10^-e. Matches depend on each other, but a wrong rigid pose has no more
  than six degrees of freedom to bring about coincidences with, so that beyond what these fit it needs as many more
  that are independent: 10^-6e.
- Looks. Starts drawn on purpose around the best pose find a better one within some 15 degrees and 15 % of the distance.
  They did so in 12 of 12 cases, so that one fails with a probability of 1/14 (Laplace's rule of succession).

The first is what remains of the posterior of unseen optima of Boender and Rinnooy Kan where only two optima matter.
Source: C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
Math. Programming 1987.
"""

import math

from bpnp.search.settings import Evidence


def log10_missed(hits: int, decades_a_match: float, looks: int, rule: Evidence) -> float:
    """log10 of the probability that a better optimum was not met.

    hits: independent starts that ended at the best pose. decades_a_match: of its evidence, 0 where its matches are no
    evidence of each other, as in repeated structures. looks: how often its surroundings were searched in vain.

    >>> rule = Evidence()
    >>> [round(log10_missed(*seen, rule), 2) for seen in ((10, 0.0, 0), (0, 0.5, 0), (6, 0.0, 1))]
    [-3.01, -3.0, -2.95]
    """
    return -hits * math.log10(2) - rule.independent * max(decades_a_match, 0.0) + looks * math.log10(rule.look_fails)
