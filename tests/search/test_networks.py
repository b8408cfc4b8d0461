"""Inputs of a network and their axes, and the use that a search makes of the proposed poses."""

from typing import Any, Literal

import numpy as np
import pytest
import torch
from planted import Answering, plant, seen
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, solve, solve_many
from bpnp.models import Matcher
from bpnp.search.inputs import problem_from
from bpnp.search.propose import networks
from bpnp.search.settings import DEFAULT
from bpnp.search.solvers import Options, solve_problems
from bpnp.types import Batch, Prediction

VIEW = Rotation.from_euler("xyz", [100, -35, 60], degrees=True).as_matrix()


def scene(clutter: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image, points, and pose of 40 points seen by a camera a few degrees off VIEW; and `clutter` on both sides."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(40, 3)) @ VIEW
    rotation, translation = Rotation.from_rotvec([0.1, -0.05, 0.02]).as_matrix() @ VIEW, np.array([0.2, -0.1, 7.0])
    image = seen(points, rotation, translation)
    clutter2d, clutter3d = rng.uniform(image.min(), image.max(), (clutter, 2)), rng.normal(size=(clutter, 3))
    return np.concatenate([image, clutter2d]), np.concatenate([points, clutter3d]), rotation, translation


@pytest.mark.parametrize("far", [0.0, 1e4])
def test_a_network_for_views_gets_the_points_in_its_coordinates_and_its_pose_is_taken_back(far: float) -> None:
    image, points, rotation, translation = scene()
    shift = np.array([0.3, -0.2, 6.0])  # of the view; far: of the scene from its origin
    turned, points = points @ VIEW.T, points + far
    net = Answering(rotation @ VIEW.T, translation - rotation @ VIEW.T @ shift, "view").eval()
    prior = PosePrior(VIEW, shift - VIEW @ np.full(3, far), 20.0, 2.0)
    solution = solve(image, points, solver=net, prior=prior)
    np.testing.assert_allclose(net.batches[0].points3d[0], turned + shift, atol=1e-4)
    np.testing.assert_allclose(solution.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(solution.translation, translation - rotation @ np.full(3, far), atol=1e-5 * (1 + far))


def test_a_prior_without_translation_places_the_points_where_the_image_shows_them() -> None:
    image, points, rotation, translation = scene()
    net = Answering(np.eye(3), np.zeros(3), "view").eval()
    solve(image, points, solver=net, prior=PosePrior(VIEW, None, 20.0))
    entered = net.batches[0].points3d[0].numpy()
    np.testing.assert_allclose(entered - entered[0], (points - points[0]) @ VIEW.T, atol=1e-4)
    seen = entered[:, :2] / entered[:, 2:]
    np.testing.assert_allclose(np.median(seen, 0), np.median(image, 0), atol=0.05)
    assert np.linalg.norm(seen.std(0)) == pytest.approx(np.linalg.norm(image.std(0)), rel=0.25)


@pytest.mark.parametrize("place", ["solver", "prior"])
def test_a_network_for_views_without_a_prior_is_one_clear_error(place: str) -> None:
    planted = plant(1, 30)
    net: Any = Matcher(channels=16, depth=1, heads=2, neighbours=3, frame="view").eval()
    with pytest.raises(ValueError, match=r"a view near the photo, and there is no `prior`; give prior=PosePrior"):
        solve(planted.points2d[0], planted.points3d[0], **{place: net})


class Knowing(Matcher):
    """Gives `share` of its assignment to the true pairs, the first 40 of both sides, the rest evenly to all pairs."""

    def __init__(self, share: float = 1.0, frame: Literal["any", "view"] = "view") -> None:
        super().__init__(channels=16, depth=1, heads=2, neighbours=3, frame=frame)
        self.share = share

    def match(self, batch: Batch) -> Prediction:
        m, n = batch.points2d.shape[1], batch.points3d.shape[1]
        assignment = torch.full((1, m, n), (1 - self.share) / (2 * m * n))
        assignment[0, range(40), range(40)] += self.share / 80
        return Prediction(assignment)

    def forward(self, batch: Batch) -> Prediction:
        raise AssertionError("the assignment is needed, not the poses")


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["any", "view"])
def test_a_matcher_with_one_inlier_in_twenty_solves_a_problem_alone_and_in_a_batch(
    frame: Literal["any", "view"],
) -> None:
    image, points, rotation, translation = scene(clutter=60)
    prior = PosePrior(VIEW, np.array([0.0, 0.0, 7.0]), 10.0, 0.5)
    noise = np.random.default_rng(3).normal(size=points.shape)
    one: dict[str, Any] = {"solver": Knowing(0.05, frame).eval(), "prior": prior}
    found, other = solve_many([image, image], [points, noise], **one)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-4)
    np.testing.assert_allclose(found.translation, translation, atol=1e-3)
    assert (found.verdict, other.verdict != "confident") == ("confident", True)
    alone = solve(image, points, **one)
    np.testing.assert_array_equal(alone.rotation, found.rotation)
    np.testing.assert_array_equal(alone.matches, found.matches)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prior", "name"),
    [
        (PosePrior(VIEW, np.array([0.2, -0.1, 7.0]), 8.0, 0.5), "matcher-maps"),
        (None, "matcher-sfm"),
        (GravityPrior(np.array([0, 1.0, 0]), np.array([0, 0, -1.0])), None),
    ],
)
def test_an_undecided_search_asks_the_matcher_and_a_confident_one_does_not(
    prior: PosePrior | GravityPrior | None, name: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, str]] = []

    def propose(weights: str, problem, seed: int) -> tuple[np.ndarray, np.ndarray]:
        asked.append((seed, weights))
        return np.empty((0, 3, 3)), np.empty((0, 3))

    monkeypatch.setattr(networks, "packaged_matcher", str)
    monkeypatch.setattr(networks, "proposed", propose)
    if name is not None:
        image, points, *_ = scene()
        assert solve(image, points, prior=prior).verdict == "confident"
        assert asked == []
    rng = np.random.default_rng(0)
    noise2d, noise3d = rng.uniform(-0.5, 0.5, (150, 2)), rng.normal(size=(150, 3))
    problem = problem_from(noise2d, noise3d, None, prior=prior)
    monkeypatch.setattr("bpnp.search.schedule.UNAIDED_ROUNDS", 4)
    brief = DEFAULT.limited(24)
    alone, helped = (
        solve_problems({0: problem}, Options(asks=asks, seed=3, settings=brief))[0].solution for asks in (False, True)
    )
    assert asked == ([] if name is None else [(3, name)])
    assert alone.verdict == helped.verdict != "confident"


def test_a_matcher_given_as_solver_proposes_the_poses_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, calls, original = np.random.default_rng(5), [], networks.proposed
    points = rng.normal(size=(120, 3))
    image = seen(points, VIEW, np.array([0, 0, 7.0]))

    def counted(*options: Any) -> Any:
        calls.append(options)
        return original(*options)

    monkeypatch.setattr(networks, "proposed", counted)
    solution = solve(rng.permutation(image), points, solver=Matcher.from_pretrained("matcher-sfm"))
    assert len(calls) == 1
    assert solution.verdict == "confident"
    np.testing.assert_allclose(solution.rotation, VIEW, atol=1e-5)
