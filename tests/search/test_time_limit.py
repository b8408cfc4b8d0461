"""After a time limit no stage begins another part of its work, says so, and calls no pose confident that it did not
compare. The clock is that of the test; work is counted, not timed."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from moved_clock import LATER, MovedClock
from planted import degrees_between
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from bpnp import Solution, matching, solve, solve_many, verify
from bpnp.matching import POINTS_A_CHECK, count_one_to_one, one_to_one
from bpnp.runtime import Clock, Deadline
from bpnp.search.hypotheses import Hypotheses, to_problem_frame, to_scene_frame
from bpnp.search.inputs import problem_from
from bpnp.search.problem import Problem
from bpnp.search.refine import annealing
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.solvers import _proposals_of_matcher

K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> MovedClock:
    return MovedClock(monkeypatch)


class CountedTree:
    """scipy's tree, which counts the points that are looked up."""

    looked_up = 0

    def __init__(self, points: Any) -> None:
        self.tree = matching.scipy_tree(points)

    def query(self, points: Any, *arguments: Any, **options: Any) -> Any:
        CountedTree.looked_up += len(points)
        return self.tree.query(points, *arguments, **options)


def scene_and_pixels(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in a cube, their pixels in any order, and the planted rotation; the translation is (0, 0, 5)."""
    rng = np.random.default_rng(seed)
    points, turn = rng.uniform(-1, 1, (count, 3)), Rotation.random(random_state=seed).as_matrix()
    camera = points @ turn.T + [0, 0, 5]
    pixels = (camera[:, :2] / camera[:, 2:]) @ K[:2, :2].T + K[:2, 2] + rng.normal(0, 0.3, (count, 2))
    return points, pixels[rng.permutation(count)], turn


def test_matches_by_components_are_those_of_the_dense_assignment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "POINTS_A_CHECK", 5)
    monkeypatch.setattr(matching, "DENSE_MATCHES", 0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        projected, image = rng.uniform(0, 20, (120, 2)), rng.uniform(0, 20, (100, 2))
        squared = cdist(image, projected) ** 2
        rows, columns = linear_sum_assignment(np.where(squared <= 1, squared, 1000.0))
        near = squared[rows, columns] <= 1
        pairs = one_to_one(image, projected, 1.0)
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) == near.sum()
        assert len(pairs) == count_one_to_one(image, projected, 1.0)
        assert squared[tuple(pairs.T)].sum() == pytest.approx(squared[rows, columns][near].sum(), rel=1e-6)
        assert (np.diff(pairs[:, 0]) > 0).all()


def test_matching_stops_at_the_limit(clock: MovedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """8,000 unrelated points have one component of thousands, which an assignment cannot leave."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(matching, "scipy_tree", matching.cKDTree, raising=False)
    monkeypatch.setattr(matching, "cKDTree", CountedTree)
    monkeypatch.setattr(CountedTree, "looked_up", 0)
    clock.stop_at("search.schedule.multistart", after=True)
    assignments = clock.count_late("matching.min_weight_full_bipartite_matching")
    maxima = clock.count_late("matching.maximum_bipartite_matching")
    fits = clock.count_late("search.match_fit.fit_pose")
    solution = solve(rng.uniform(-0.5, 0.5, (8000, 2)), rng.normal(size=(8000, 3)), solver="search", time_limit=5)
    assert solution.found
    assert not assignments
    assert not maxima
    assert not fits
    assert CountedTree.looked_up <= 2 * POINTS_A_CHECK
    assert "matches" in solution.stats.unfinished
    assert "search" in solution.stats.unfinished
    assert "not decided in 5 s" in solution.reason
    i, j = solution.matches.T
    assert len(np.unique(i)) == len(np.unique(j)) == solution.inlier_count
    assert Solution.from_json(solution.to_json()).stats == solution.stats


def test_points_are_assigned_while_there_is_time(clock: MovedClock) -> None:
    """The largest component alone would take longer than is left; it gets its mutual nearest neighbours."""
    projected = np.concatenate([np.random.default_rng(0).uniform(0, 1, (300, 2)), [[9, 9], [9.5, 9]]])
    image = projected + [0.2, 0]
    late = Deadline(1e-5)
    exact, cut = (one_to_one(image, projected, 0.25, deadline=end) for end in (Deadline(), late))
    assert late.unfinished == {"matches"}
    assert len(exact) > len(cut) > 0
    assert [300, 300] in cut.tolist()
    assert len(np.unique(cut[:, 0])) == len(np.unique(cut[:, 1])) == len(cut)


def test_no_focal_length_is_tried_after_the_limit(clock: MovedClock) -> None:
    """The limit passes at the end of the first search. It speaks of the limit of the call, not of its own part."""
    points, pixels, _ = scene_and_pixels(150)
    clock.stop_at("search.focal_length.solve_problems", after=True)
    searches = clock.count_late("search.focal_length.solve_problems")
    steps = clock.count_late("search.focal_length._anneal_pose")
    solution = solve(pixels, points, image_size=(640, 480), solver="search", time_limit=10)
    assert not searches
    assert not steps
    assert solution.verdict != "confident"
    assert "focal lengths" in solution.stats.unfinished


@pytest.mark.parametrize("calls", [1, 3])
def test_a_fit_of_the_focal_length_ends_at_the_limit(clock: MovedClock, calls: int) -> None:
    """Of several fits with twelve rounds each, the one that runs takes its step, and no other begins."""
    points, pixels, _ = scene_and_pixels(150)
    count = 0

    def once(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        nonlocal count
        count += 1
        clock.time = LATER if count >= calls else clock.time
        return original(*arguments, **options)

    clock.wrap("search.focal_length._anneal_pose", once)
    fits = clock.count_late("search.focal_length.fit_lens")
    searches = clock.count_late("search.focal_length.solve_problems")
    solution = solve(pixels, points, K, focal_error=0.2, solver="search", time_limit=10)
    assert count == calls
    assert not fits
    assert not searches
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "camera_untested")
    assert solution.reason.endswith("not decided in 10 s, a longer time limit may decide it")


def test_a_part_of_the_time_is_not_the_limit_of_the_sentence(clock: MovedClock) -> None:
    """Each of five focal lengths has two of ten seconds."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, 480, (100, 2))
    clock.stop_at("search.schedule.multistart", after=True)
    solution = solve(pixels, rng.normal(size=(100, 3)), image_size=(640, 480), solver="search", time_limit=10)
    assert "not decided in 10 s" in solution.reason


def test_no_competing_pose_is_proposed_after_the_limit(clock: MovedClock) -> None:
    points, pixels, turn = scene_and_pixels(150)
    clock.stop_at("search.loop.contest")
    proposals = clock.count_late("search.verdict.rivals.symmetries.repeated_poses")
    lenses = clock.count_late("search.verdict.rivals.lens.fit_lens")
    solution = solve(pixels, points, K, solver="search", time_limit=10)
    assert degrees_between(solution.rotation, turn) < 1
    assert not proposals
    assert not lenses
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "untested")
    assert solution.stats.unfinished == ("competing poses", "matches", "refinement")
    assert "not decided in 10 s" in solution.reason


def test_no_other_focal_length_is_searched_after_the_limit(clock: MovedClock) -> None:
    """Seventy points leave a chance that another focal length fits, for which the search runs again."""
    points, pixels, turn = scene_and_pixels(70)
    clock.stop_at("search.verdict.rivals.symmetries._repeated", after=True)
    searches = clock.count_late("search.verdict.rivals.lens.search_around")
    fits = clock.count_late("search.verdict.rivals.lens.fit_lens")
    solution = verify(pixels, points, turn, [0, 0, 5], K)
    assert not searches
    assert not fits
    assert solution.verdict == "ambiguous"
    assert "focal lengths" in solution.stats.unfinished or "competing poses" in solution.stats.unfinished
    assert "not decided in 10 s" in solution.reason


def test_a_matcher_is_not_asked_without_time_for_it(clock: MovedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network cannot be interrupted: 20,000 points of a scene take its attention half a minute."""
    rng, asked = np.random.default_rng(2), list[Any]()
    problem = problem_from(rng.uniform(-0.5, 0.5, (200, 2)), rng.normal(size=(20_000, 3)), None)
    nothing = np.empty((0, 3, 3)), np.empty((0, 3))
    monkeypatch.setattr("bpnp.search.propose.networks.proposed", lambda *_: asked.append(_) or nothing)
    for limit, unfinished in ((10.0, {"matcher"}), (1000.0, set[str]())):
        propose = _proposals_of_matcher(problem, 0, deadline := Deadline(limit))
        assert propose is not None
        assert [len(part) for part in propose()] == [0, 0]
        assert deadline.unfinished == unfinished
    assert len(asked) == 1


def test_a_rig_compares_no_pose_after_the_limit(clock: MovedClock) -> None:
    points, pixels, turn = scene_and_pixels(120)
    aside = (points @ turn.T + [0.5, 0, 5])[:, :2] / (points @ turn.T + [0.5, 0, 5])[:, 2:]
    second = aside @ K[:2, :2].T + K[:2, 2]
    rig = [(np.eye(3), np.zeros(3)), (np.eye(3), np.array([0.5, 0, 0]))]
    clock.stop_at("search.loop.contest")
    proposals = clock.count_late("search.rig.poses.repeated_poses")
    assignments = clock.count_late("matching.min_weight_full_bipartite_matching")
    solution = solve([pixels, second], points, K, rig=rig)
    assert not proposals
    assert not assignments
    assert degrees_between(solution.rotation, turn) < 1
    assert (solution.verdict, solution.reason_code) == ("ambiguous", "untested")
    assert "not decided in 10 s" in solution.reason


def test_each_of_many_problems_has_its_own_limit(clock: MovedClock) -> None:
    """The limit of the first problem cuts nothing of the second, whose clock starts when it begins."""
    points, pixels, turn = scene_and_pixels(150)
    clock.stop_at("search.loop.contest")
    first, second = solve_many([pixels, pixels], points, K, solver="search")
    assert first.verdict == "ambiguous"
    assert second.verdict == "confident"
    assert second.stats.unfinished == ()


def test_an_ending_leaves_the_search_half_of_the_time() -> None:
    begun = Clock.now()
    deadline = Deadline(begun + 100).before(10.0)
    assert deadline.at == begun + 90
    assert deadline.final == begun + 100
    assert Deadline(begun + 100).before(1000.0).at == pytest.approx(begun + 50, abs=1)
    part = deadline.share(0.5)
    assert part.at == pytest.approx(begun + 45, abs=1)
    assert part.final == deadline.final
    assert not part.passed("search")
    assert Deadline(begun).ended("search")
    past = Deadline(begun, begun + 100)
    assert past.passed("search")
    assert not past.ended("matches")
    assert past.unfinished == {"search"}
    assert not Deadline().before(10.0).passed()
    assert Deadline().share(0.5).at == np.inf


@pytest.mark.parametrize(("seconds", "fits"), [(1.0, False), (0.001, True)])
def test_an_annealing_on_many_points_is_begun_only_if_it_ends_in_time(
    seconds: float, fits: bool, clock: MovedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step takes so many seconds of 2.5; the steps after it would take more than one of them."""
    monkeypatch.setattr(annealing, "TIMED_PAIRS", 0.0)
    points, pixels, turn = scene_and_pixels(60)
    rays = np.column_stack([(pixels - K[:2, 2]) / K[0, 0], np.ones(60)])
    problem = Problem.of(rays / np.linalg.norm(rays, axis=1, keepdims=True), points)
    scene = SearchFrame(problem, 0, DEFAULT, Deadline.after(2.5))
    problem_turn, shift = problem.from_user(turn, np.array([0, 0, 5.0]))
    start = to_scene_frame(Hypotheses.from_poses(problem_turn[None], shift[None]), scene)
    start = annealing.anneal_on_points(scene, start, 0.05)
    whole = list[bool]()

    def step(original: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        clock.time += seconds
        whole.append(options.get("steps") is None)
        return original(*arguments, **options)

    clock.wrap("search.refine.annealing.anneal_on_points", step)
    ended = annealing.finish(scene, start)
    assert degrees_between(to_problem_frame(ended, scene).rotation[0], problem_turn) < 1
    assert any(whole) == fits
    assert not whole[0]
