"""Class probabilities of both sides: what the evidence makes of them, what they decide, and what is refused."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import seen, view_with_outliers

import bpnp
from bpnp.arrays import Array

SHARP = 1.48  # the likeliest of four classes is right in 70 %


def probabilities(rng: np.random.Generator, label: NDArray[np.int64], sharp: float = SHARP) -> Array:
    """The posterior of four classes given scores that are normal about `sharp` for the right one and 0 for others."""
    scores = rng.standard_normal((len(label), 4))
    scores[np.arange(len(label)), label] += sharp
    shares = np.exp(sharp * scores)
    return shares / shares.sum(1, keepdims=True)


@pytest.fixture(scope="module")
def view() -> Any:
    """Bearings, points, pose, and the labels of both: 40 correspondences and 60 outliers a side."""
    rng = np.random.default_rng(9)
    bearings, points, rotation, translation = view_with_outliers(rng, 40, 60)
    labels2d, labels3d = rng.integers(0, 4, (2, 100))
    labels3d[:40] = labels2d[:40]
    return bearings, points, rotation, translation, labels2d, labels3d


def test_probabilities_of_one_act_as_labels_and_equal_ones_as_none(view: Any) -> None:
    *sides_and_pose, labels2d, labels3d = view

    def judge(**labels: Any) -> tuple[float, Array]:
        found = bpnp.verify(*sides_and_pose, refine=False, **labels)
        return found.log10_false_alarms, found.covariance

    certain = judge(labels2d=np.eye(4)[labels2d], labels3d=np.eye(4)[labels3d])
    equal = judge(labels2d=np.full((100, 4), 0.25), labels3d=np.full((100, 4), 0.25))
    for soft, hard in ((certain, judge(labels2d=labels2d, labels3d=labels3d)), (equal, judge())):
        assert soft[0] == pytest.approx(hard[0], abs=1e-3)
        np.testing.assert_allclose(soft[1], hard[1], rtol=1e-4)
    assert certain[0] < equal[0] - 10
    nested = judge(labels2d=np.eye(4)[labels2d].tolist(), labels3d=np.eye(4)[labels3d].tolist())
    assert nested[0] == certain[0]


def test_class_probabilities_decide_between_two_equal_objects() -> None:
    rng = np.random.default_rng(9)
    shape, label = rng.uniform(-0.7, 0.7, (50, 3)), rng.integers(0, 4, 50)
    points = np.concatenate([shape, shape + [3.0, 0, 0]])
    classes3d = np.concatenate([probabilities(rng, label, 3.0), probabilities(rng, (label + 1) % 4, 3.0)])
    image = seen(shape, np.eye(3), [3.0, 0, 6])
    classes2d = probabilities(rng, (label + 1) % 4)
    classes: dict[str, Any] = {"labels2d": classes2d, "labels3d": classes3d}
    right, twin = (np.eye(3), [0, 0, 6.0]), (np.eye(3), [3.0, 0, 6.0])
    assert bpnp.verify(image, points, *right).verdict != "confident"
    assert bpnp.verify(image, points, *right, **classes).verdict == "confident"
    assert bpnp.verify(image, points, *twin, **classes).verdict == "failed"
