"""The tracker of examples/led_tracker.py on planted poses: a prediction, the fallback, and no pose where none is."""

import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.examples import load
from bpnp.search.propose import repetitions
from bpnp.search.verdict import decide, uncertainty

sys.path.append(str(Path(__file__).parents[1] / "examples"))
led_tracker: Any = __import__("led_tracker")

RING = load("leds")  # 17 LEDs


class Frame(NamedTuple):
    """The dots of a frame, pixels, and the true pose."""

    dots: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def frame_at(turn: float, shift: float) -> Frame:
    """The ring turned by `turn` degrees about its axis and moved by `shift` metres: LEDs that face the camera, 0.3
    pixels off, and three lamps."""
    rng = np.random.default_rng(round(10 * turn))
    rotation = RING.rotation @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
    translation = RING.translation + [shift, 0, 0]
    seen = RING.points3d @ rotation.T + translation
    facing = (seen * (RING.normals3d @ rotation.T)).sum(-1) < 0
    dots = seen[facing, :2] / seen[facing, 2:] @ RING.camera[:2, :2].T + RING.camera[:2, 2]
    dots += rng.normal(0, 0.3, dots.shape)
    lamps = rng.uniform(dots.min(0) - 40, dots.max(0) + 40, (3, 2))
    return Frame(rng.permutation(np.concatenate([dots, lamps])), rotation, translation)


def tracker() -> Any:
    return led_tracker.LedTracker(RING.points3d, RING.normals3d, RING.camera, time_limit=100.0)


def assert_near(solution: Any, frame: Frame) -> None:
    assert solution is not None
    assert np.degrees(Rotation.from_matrix(solution.rotation @ frame.rotation.T).magnitude()) < 3
    np.testing.assert_allclose(solution.translation, frame.translation, atol=0.02)


def test_a_device_is_followed_by_predictions() -> None:
    """The first frame is searched, and every eighth one; the others are predicted."""
    tracked, searched = tracker(), []
    tracked.check_every = 8
    for k in range(10):
        frame = frame_at(2.0 + 2.0 * k, 0.003 * k)
        assert_near(tracked.update(frame.dots), frame)
        searched.append(tracked.searched)
    assert searched == [k in (0, 8) for k in range(10)]


def test_a_device_that_was_hidden_or_moved_is_found_again() -> None:
    """Three dots are no pose; the frame after them is searched, and a jump by 150 degrees is followed."""
    tracked = tracker()
    before, after, jumped = frame_at(2, 0), frame_at(40, 0.1), frame_at(250, -0.1)
    assert_near(tracked.update(before.dots), before)
    assert tracked.update(before.dots[:3]) is None
    assert tracked.prediction() is None
    assert_near(tracked.update(after.dots), after)
    assert tracked.searched
    assert_near(tracked.update(jumped.dots), jumped)
    assert not tracked.searched  # the prediction was tried, and did not hold


def test_a_prediction_goes_on_as_the_device_moved() -> None:
    """Three poses a constant turn and step apart, two of them given to the tracker."""
    step = Rotation.from_euler("xyz", [2, -1, 3], degrees=True).as_matrix()
    tracked = tracker()
    tracked.poses = [(np.eye(3), np.array([0, 0, 1.0])), (step, np.array([0.01, 0, 1.02]))]
    prior = tracked.prediction()
    np.testing.assert_allclose(prior.rotation, step @ step, atol=1e-12)
    np.testing.assert_allclose(prior.translation, [0.02, 0, 1.04])


def test_a_frame_computes_each_test_of_its_pose_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verdict and covariance share them, and what depends on the device alone is computed in its first frame."""
    first, second = frame_at(2, 0), frame_at(40, 0.1)
    options = {"normals3d": RING.normals3d, "time_limit": None}
    assert bpnp.solve(first.dots, RING.points3d, RING.camera, **options).verdict == "confident"
    counts: Counter[str] = Counter()

    def count(module: Any, name: str) -> None:
        function = getattr(module, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            counts[name] += 1
            return function(*arguments, **options)

        monkeypatch.setattr(module, name, counted)

    for name in ("linearise", "_of_louis"):
        count(uncertainty, name)
    count(decide, "systematic_misfit")
    for name in ("extent_and_spacing", "self_motions"):
        count(repetitions, name)
    assert bpnp.solve(second.dots, RING.points3d, RING.camera, **options).verdict == "confident"
    assert counts == {"linearise": 1, "_of_louis": 1, "systematic_misfit": 1}


@pytest.mark.slow
def test_the_example_prints_its_run(capsys: pytest.CaptureFixture[str]) -> None:
    results = led_tracker.main(["--seconds", "1"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in results)
    assert results["wrong by more than 3 degrees, % of all"] == 0
    assert results["median error, degrees"] < 2
