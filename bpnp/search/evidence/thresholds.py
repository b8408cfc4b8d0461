"""The constants of the verdict: what evidence a pose is accepted for, and when a search without it ends."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Evidence:
    """When a pose is accepted (`bpnp.search.verdict`). Logarithms to base 10.

    false_alarms: of the number of false alarms, at most, for "confident". It is a bound; on unrelated points an
    exhaustive search stayed above 1 in 999 of 1000 cases, and never came below 0.1.
    lead: by which every different pose must have more: a wrong pose leads so by chance once in a thousand. other_deg,
        other_shift: poses with rotations farther apart, or translations by this share of their length, are different.
    loose_deg: error of the rotation about its least certain axis that is exceeded once in a thousand, at most.
    hits: batches of starts that must have found the pose, so that a better one is unlikely to have been missed: the
    first four have 720 starts, of which 5 are within 30 degrees of any rotation. Of so many batches well_matched_hits
    are enough where the share well_matched is matched: it leaves a better pose little to explain. Or
    matched, over_chance: this share of the points is matched, and so many times the share expected by chance. A pose
    that was just found is accepted after another batch; at once if the share well_matched is matched.
    stalled: so many full batches of starts that do not better the best log-likelihood by `better` nats a bearing end
    the search, as do enough_hits at one pose, if its residuals are below plausible_scale, in half the spacing of the
    bearings, and its matched share above plausible_matched; wrong poses of sparse points had up to a quarter.
    """

    false_alarms: float = -2.0
    lead: float = 3.0
    other_deg: float = 2.0
    other_shift: float = 0.05
    loose_deg: float = 3.0
    hits: int = 4
    well_matched: float = 0.6
    well_matched_hits: int = 2
    matched: float = 0.2
    over_chance: float = 6.0
    stalled: float = 4.0
    better: float = 0.002
    enough_hits: int = 12
    plausible_scale: float = 2.0
    plausible_matched: float = 0.25
