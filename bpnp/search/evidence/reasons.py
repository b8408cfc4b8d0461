"""Sentences that give the reason of a verdict (`Solution.reason`)."""

MIRRORED = "the mirror image of the scene has a significant pose: check the directions of its axes"
LEAST_SHOWN = 0.05  # decades that are shown as 0.0


def confident(log10_false_alarms: float, lead: float, bound_deg: float, focal: float = 0.0) -> str:
    """Return the reason of a confident pose.

    Args:
        log10_false_alarms: of the pose.
        lead: decades within which no competing pose lies.
        bound_deg: 99.9 % bound of the rotation, degrees.
        focal: 99.9 % bound of the focal length, as a fraction; 0 if it is given.

    Examples:
        >>> confident(-69.1, 3.0, 0.213)
        'No competing pose within 3 decades; log10 NFA -69.1; rotation known to 0.2 deg (99.9 %)'
        >>> confident(-9.1, 3.0, 5.2, 0.634)
        'No competing pose within 3 decades; log10 NFA -9.1; rotation known to 5 deg, focal length to 63 % (99.9 %)'
    """
    known = f"rotation known to {rounded(bound_deg)} deg"
    if focal:
        known += f", focal length to {rounded(100 * focal)} %"
    return f"No competing pose within {lead:g} decades; {nfa(log10_false_alarms)}; {known} (99.9 %)"


def against(what: str, log10_false_alarms: float) -> str:
    """Return the reason of a pose that is not confident.

    Args:
        what: The objection, a clause.
        log10_false_alarms: log10 NFA of the pose.

    Examples:
        >>> against("its 4 matches do not fix the rotation", -5.02)
        'Its 4 matches do not fix the rotation; log10 NFA -5.0'
    """
    return f"{what[0].upper()}{what[1:]}; {nfa(log10_false_alarms)}"


def insignificant(log10_false_alarms: float, most: float) -> str:
    """Return the reason of a pose that is not significant; `most` is the largest significant log10 NFA."""
    return f"Not significant: {nfa(log10_false_alarms)}, and at most {most:g} is needed"


def competing(degrees: float, margin: float) -> str:
    """Return the clause of a competing pose, `degrees` away and less likely by `margin` decades (log10)."""
    return f"a competing pose {degrees:.0f} deg away fits about as well (margin {margin:.1f} decades)"


def incomplete(log10_missed: float) -> str:
    """Return the clause of an incomplete search; `log10_missed` is log10 of its miss probability."""
    return f"a better pose may exist (miss probability up to {number(min(log10_missed, 0.0))})"


def undecided(reason: str, seconds: float) -> str:
    """Return the reason of a pose that is undecided at the time limit of the search."""
    return f"{reason}; not decided in {seconds:.3g} s, a longer time limit may decide it"


def rounded(bound: float) -> str:
    """Format a bound: one digit below ten, whole numbers above."""
    return f"{bound:.1g}" if bound < 9.5 else f"{bound:.0f}"


def nfa(log10_false_alarms: float) -> str:
    """Format the logarithm of a number of false alarms."""
    shown = 0.0 if abs(log10_false_alarms) < LEAST_SHOWN else log10_false_alarms
    return f"log10 NFA {shown:.1f}"


def number(log10: float) -> str:
    """Format 10^x as a short number."""
    return f"{10**log10:.2g}" if -3 < log10 < 5 else f"1e{log10:.0f}"
