"""Arrays that are no arrays of real numbers are refused in one sentence, and priors that no number format can hold."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from planted import degrees_between, seen
from scipy.spatial.transform import Rotation

from bpnp import Batch, GravityPrior, PosePrior, solve, verify
from bpnp.search.arguments import numbers

RNG = np.random.default_rng(3)
SCENE = RNG.normal(size=(30, 3))
ROTATION, TRANSLATION = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix(), np.array([0.1, 0.2, 6.0])
IMAGE = seen(SCENE, ROTATION, TRANSLATION)[RNG.permutation(30)]
Function = Callable[[Any, Any], Any]
FUNCTIONS: list[Function] = [
    lambda image, scene: solve(image, scene),
    lambda image, scene: verify(image, scene, ROTATION, TRANSLATION),
    lambda image, scene: Batch.from_arrays(image, scene),
    lambda image, scene: Batch.from_arrays([image], [scene]),
]


@pytest.mark.parametrize("call", FUNCTIONS)
def test_masked_points_are_not_used_without_their_mask(call: Function) -> None:
    for masked, name in ((0, "points2d"), (1, "points3d")):
        sides = [np.ma.array(side, mask=np.zeros_like(side, bool)) for side in (IMAGE, SCENE)]
        call(*sides)  # nothing is masked
        sides[masked][4] = np.ma.masked
        with pytest.raises(ValueError, match=rf"`{name}` is a masked array with {2 + masked} masked values; give only"):
            call(*sides)


@pytest.mark.parametrize("call", FUNCTIONS)
@pytest.mark.parametrize(
    "change",
    [
        lambda side: side.astype(complex),
        lambda side: side > 0,
        lambda side: side.astype(str),
        lambda side: np.full(side.shape, None),
        lambda side: pd.DataFrame(side).astype(object).where(side > 0, None),
        lambda side: torch.from_numpy(side).to_sparse(),
        lambda side: torch.from_numpy(side).to(torch.complex64),
        lambda side: side.astype("datetime64[s]"),
    ],
    ids=["complex", "bool", "strings", "None", "frame", "sparse", "complex tensor", "dates"],
)
def test_what_is_no_array_of_real_numbers_is_refused(call: Function, change: Callable[[Any], Any]) -> None:
    for sides, name in (((change(IMAGE), SCENE), "points2d"), ((IMAGE, change(SCENE)), "points3d")):
        with pytest.raises(ValueError, match=f"`{name}` "):
            call(*sides)


def test_tensors_with_a_gradient_and_frames_are_arrays() -> None:
    tensor = torch.from_numpy(SCENE).requires_grad_()
    frame = pd.DataFrame(SCENE, columns=["points", "vertices", "z"])  # named as attributes of clouds and meshes
    for values in (tensor, frame):
        np.testing.assert_array_equal(numbers("points3d", values), SCENE)
        assert degrees_between(solve(IMAGE, values).rotation, ROTATION) < 1


@pytest.mark.parametrize("sigma", [1e-300, 1e-9, 0.0, -1.0, math.nan, -math.inf])
def test_a_deviation_that_is_no_number_of_degrees_is_refused(sigma: float) -> None:
    for prior, name in (
        (PosePrior(ROTATION, TRANSLATION, sigma), "rotation_sigma_deg"),
        (PosePrior(ROTATION, TRANSLATION, 5.0, sigma), "translation_sigma"),
        (GravityPrior(ROTATION[:, 1], np.array([0, 1, 0]), sigma), "sigma_deg"),
    ):
        with pytest.raises(ValueError, match=f"`prior.{name}` is .*(give 1e-0. or more|it must be a positive number)"):
            solve(IMAGE, SCENE, prior=prior)


@pytest.mark.parametrize("sigma", [1e3, 1e300, math.inf])
def test_a_wide_prior_tells_nothing(sigma: float) -> None:
    without = solve(IMAGE, SCENE)
    for prior in (
        PosePrior(ROTATION, TRANSLATION, sigma, sigma),
        GravityPrior(1e-300 * ROTATION[:, 1], np.array([0, 1e300, 0]), sigma),
    ):
        solution = solve(IMAGE, SCENE, prior=prior)
        assert (solution.verdict, solution.inlier_count) == (without.verdict, without.inlier_count)
        assert degrees_between(solution.rotation, ROTATION) < 1
