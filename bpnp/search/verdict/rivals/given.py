"""What was given: a pose that contradicts its prior is not confident, since one of the two is wrong."""

from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.reasons import objection

MOST_SIGMAS = 5.0  # deviation from a prior, of rotation or position [standard deviations; convention]


def given(case: Case) -> Case:
    """Return a case against which its prior speaks; those of the views of a map are only where a search begins.

    This rival is the last one: a pose with this reason has passed every other test.
    """
    sigmas = case.problem.prior_sigmas(*case.pose)
    if case.problem.cosines3d is not None or sigmas <= MOST_SIGMAS:
        return case
    return case.against(objection("contradicts_prior", sigmas=sigmas))
