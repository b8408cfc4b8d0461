"""The widths of a prior may be integers, and any kind of float."""

import numpy as np
import pytest

from bpnp import GravityPrior, PosePrior
from bpnp.search.arguments import checked_prior


@pytest.mark.parametrize("kind", [int, float, np.float32, np.int64])
def test_the_standard_deviations_of_a_prior_become_floats(kind: type) -> None:
    prior = checked_prior(PosePrior(np.eye(3), np.zeros(3), kind(5), kind(2)))
    assert isinstance(prior, PosePrior)
    assert [type(value) for value in prior[2:]] == [float, float]
    assert prior[2:] == (5, 2)
    gravity = checked_prior(GravityPrior(np.array([0, -1, 0]), np.array([0, 0, 1]), kind(3)))
    assert isinstance(gravity, GravityPrior)
    assert type(gravity.sigma_deg) is float
