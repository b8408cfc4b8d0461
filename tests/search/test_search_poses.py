"""The training-free search and the refinement find planted poses, and say when they do not."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from planted import degrees_between, directions, plant
from scipy.spatial.transform import Rotation

from bpnp.geometry import bearings
from bpnp.loops.parallel import Deadline
from bpnp.metrics import rotation_error, translation_error
from bpnp.models import Search
from bpnp.models.evaluation import best_poses, refine
from bpnp.search import pool, schedule
from bpnp.search.candidates import Candidates
from bpnp.search.point_sets import PointSets
from bpnp.search.pool import Pool
from bpnp.search.scene import Scene
from bpnp.search.search import search_poses, search_proposed
from bpnp.search.settings import DEFAULT, Draws, RasterSearch, Schedule, SearchSettings
from bpnp.search.starts import PosePrior, super_fibonacci
from bpnp.search.verdict import no_pose
from bpnp.types import Batch

NO_POSE = no_pose("none yet")


@pytest.fixture(scope="module")
def problem():
    return plant(3, 200, seed=4, noise=1e-4)


def found(rotation, translation, problem, degrees):
    error = rotation_error(rotation, problem.rotation)
    shift = translation_error(translation, problem.translation)
    assert (error < degrees).all(), f"rotation errors {error.tolist()}"
    assert (shift < 0.05).all(), f"translation errors {shift.tolist()}"


def search(f, p, prior=None, **options):
    """`search_poses` of each sample: rotation, translation and stats of the best pose."""
    sets = (PointSets(x.double().numpy(), y.double().numpy(), prior=prior) for x, y in zip(f, p, strict=True))
    pose = best_poses((search_poses(each, **options) for each in sets), p)
    return pose.rotation, pose.translation, pose.stats


def test_search_finds_planted_poses(problem):
    rotation, translation, stats = search(problem.bearings, problem.points3d)
    found(rotation, translation, problem, 0.5)
    assert stats.converged.all()
    identity = torch.eye(3, dtype=rotation.dtype).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, atol=1e-5, rtol=0)


def test_the_budget_counts_turns_and_an_easy_problem_needs_few(problem):
    settings = SearchSettings(Schedule(turns=2), starts=96, first_starts=24)
    rng, seen = np.random.default_rng(0), []
    noise = rng.normal(size=(80, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    unrelated = PointSets(directions(noise), rng.normal(size=(80, 3)))
    search_poses(unrelated, settings=settings, progress=lambda batches, _: seen.append(batches))
    assert seen == [1, 2]
    related = PointSets(problem.bearings[1].double().numpy(), problem.points3d[1].double().numpy())
    easy = search_poses(related)
    assert easy.verdict == "confident"
    assert easy.batches <= 4  # 720 starts


def test_neighbours_padding_and_batch_size_do_not_matter(problem):
    padded = Batch.from_arrays(
        [problem.points2d[0].numpy(), problem.points2d[1, :150].numpy()],
        [problem.points3d[0].numpy(), problem.points3d[1, :150].numpy()],
    )
    together = Search()(padded).poses["search"]
    rotation, translation, _ = search(problem.bearings[1:2, :150], problem.points3d[1:2, :150])
    torch.testing.assert_close(together.rotation[1], rotation[0], rtol=0, atol=0)
    torch.testing.assert_close(together.translation[1], translation[0], rtol=0, atol=0)


def test_candidates_are_distinct_and_fall_in_score(problem):
    candidates = search_poses(PointSets(problem.bearings[0].numpy(), problem.points3d[0].numpy())).candidates
    assert (np.diff(candidates.score) <= 0).all()
    for i in range(len(candidates)):
        for j in range(i):
            turn = Rotation.from_matrix(candidates.rotation[i].T @ candidates.rotation[j])
            apart = np.degrees(turn.magnitude()) > 2.9
            assert apart or np.linalg.norm(candidates.translation[i] - candidates.translation[j]) > 0.01


@pytest.mark.parametrize("case", ["three", "line2d", "line3d", "same2d", "same3d"])
def test_what_fixes_no_pose_has_none(problem, case):
    f, p = problem.bearings[:1].clone(), problem.points3d[:1].clone()
    along = torch.linspace(0, 1, f.shape[1]).unsqueeze(-1).to(p)
    if case == "three":
        f, p = f[:, :3], p[:, :3]
    elif case == "line2d":
        f = bearings(along.repeat(1, 2).unsqueeze(0) * 0.1)
    elif case == "line3d":
        p = (along * torch.ones(3).to(p)).unsqueeze(0)
    elif case == "same2d":
        f = f[:, :1].expand_as(f).contiguous()
    else:
        p = p[:, :1].expand_as(p).contiguous()
    # Points of a line within rounding are on it; in two dimensions a bearing on a line has a plane of its own.
    rotation, translation, stats = search(f, p, settings=DEFAULT.limited(4))
    if case != "line2d":
        assert rotation.isnan().all()
        assert translation.isnan().all()
        assert stats.residual.isinf().all()
        assert not stats.converged.any()


def test_a_rough_pose_saves_batches(problem):
    rotation, translation = problem.near(0.05, seed=1)
    prior = PosePrior(rotation[0], translation[0], rotation_sigma_deg=4, translation_sigma=0.1)
    r, t, stats = search(problem.bearings[:1], problem.points3d[:1], prior=prior, settings=DEFAULT.limited(1))
    assert rotation_error(r, problem.rotation[:1]) < 0.5
    assert stats.iterations.item() <= 1


@pytest.mark.parametrize("off", [0.05, 1.0])
def test_a_guess_from_the_same_points_is_tried_first_and_not_believed(problem, off):
    """One near the true pose and one 57 degrees off: the search goes everywhere unless the matches are unique."""
    rotation, translation = (values[0].numpy() for values in problem.near(off, seed=1))
    sets = PointSets(problem.bearings[0].numpy(), problem.points3d[0].numpy())
    result = search_poses(sets, around=PosePrior(rotation, translation, 4.0, 0.1))
    assert result.verdict == "confident"
    assert rotation_error(torch.as_tensor(result.best[0])[None], problem.rotation[:1]) < 0.5
    assert (result.batches <= DEFAULT.schedule.around) == (off < 0.1)


def test_a_search_of_proposals_alone_ends_where_they_leave_a_doubt():
    """A pose among repeated points, whose matches are no evidence of each other: after its looks nothing is left."""
    grid = np.stack(np.meshgrid(*3 * [np.arange(4.0)]), -1).reshape(-1, 3)
    shift, ended = np.array([-1.5, -1.5, 9.0]), []
    sets = PointSets(directions(grid + shift), grid)
    few = DEFAULT.limited(20)
    for least in (few.evidence.missed, -1000.0):  # the latter is never reached
        rule = replace(few, evidence=replace(few.evidence, missed=least))
        ended.append(search_proposed(sets, lambda: (np.eye(3)[None], shift[None]), settings=rule).batches)
    assert max(ended) < 20


def test_poses_that_are_proposed_are_tried_where_the_search_ends_in_doubt():
    """Few starts find nothing; among 200 proposals one is 3 degrees off. Without need nobody is asked."""
    planted = plant(1, 200, seed=5, noise=1e-4, outliers2d=100, outliers3d=100)
    sets = PointSets(planted.bearings[0].double().numpy(), planted.points3d[0].double().numpy())
    rotation, translation = planted.rotation[0].double().numpy(), planted.translation[0].double().numpy()
    others = super_fibonacci(200)
    others[77] = Rotation.from_rotvec([0, np.radians(3), 0]).as_matrix() @ rotation
    once = RasterSearch(Draws(1))
    few = SearchSettings(Schedule(turns=9, patience=0.5, around_each=0), 1, 1, everywhere=once)

    def off(result):
        return np.degrees(Rotation.from_matrix(result.best[0] @ rotation.T).magnitude())

    assert off(search_poses(sets, settings=few)) > 10
    assert off(search_poses(sets, settings=few, proposals=lambda: (others, np.tile(translation, (200, 1))))) < 0.5
    assert search_poses(sets, proposals=pytest.fail).verdict == "confident"
    empty = Pool(Scene(sets, 0, few), sets, NO_POSE)
    alike = schedule.proposed(empty, lambda: (np.tile(others[77], (50, 1, 1)), np.tile(translation, (50, 1))))
    assert alike.hits.sum() == 0  # fifty alike are no evidence


def test_starts_around_a_guess_that_end_alike_are_no_evidence(problem):
    """Many starts beside the true pose end at it, and from anywhere some do."""
    sets = PointSets(problem.bearings[0].numpy(), problem.points3d[0].numpy())
    rotation, translation = (values[0].numpy() for values in problem.near(0.02, seed=1))
    one_turn = DEFAULT.limited(1)
    around = search_poses(sets, around=PosePrior(rotation, translation, 1.0, 0.01), settings=one_turn)
    assert degrees_between(around.best[0], problem.rotation[0].numpy()) < 0.5
    assert (around.candidates.hits == 0).all()
    assert search_poses(sets, settings=DEFAULT.limited(4)).candidates.hits.max() > 0


def test_starts_cover_all_rotations():
    """No rotation is farther from 1152 even ones than 25 degrees; a random set of that size leaves gaps of 30."""
    starts = torch.as_tensor(super_fibonacci(1152))
    torch.testing.assert_close(starts @ starts.mT, torch.eye(3, dtype=starts.dtype).expand_as(starts))
    generator = torch.Generator().manual_seed(0)
    targets = roma.unitquat_to_rotmat(
        torch.nn.functional.normalize(torch.randn(500, 4, dtype=starts.dtype, generator=generator), dim=-1)
    )
    cosine = ((targets.flatten(1) @ starts.flatten(1).T).amax(1) - 1) / 2
    assert torch.rad2deg(torch.acos(cosine)).max() < 25


def test_refine_mends_a_rough_pose_and_leaves_the_missing(problem):
    rotation, translation = problem.near(0.08, seed=2)
    rotation, translation = rotation.unsqueeze(1).clone(), translation.unsqueeze(1).clone()
    rotation[2] = torch.nan
    pose = refine(problem.batch(), rotation, translation)
    assert (rotation_error(pose.rotation, problem.rotation)[:2] < 0.3).all()
    assert (translation_error(pose.translation, problem.translation)[:2] < 0.02).all()
    assert pose.rotation[2].isnan().all()
    assert not pose.stats.converged[2]
    assert pose.stats.converged[:2].all()


def test_search_as_a_solver(problem):
    prediction = Search(settings=DEFAULT.limited(8))(problem.batch())
    assert prediction.assignment is None
    found(prediction.poses["search"].rotation, prediction.poses["search"].translation, problem, 0.5)


def test_wrong_budgets_are_refused(problem):
    with pytest.raises(ValueError, match="expected a positive `time_limit`"):
        Search(time_limit=0.0)
    with pytest.raises(ValueError, match="expected `clutter`"):
        search(problem.bearings, problem.points3d, clutter=1.0)


def test_a_known_share_of_clutter_is_expected_and_the_only_one_tried():
    known = DEFAULT.expecting(0.5)
    assert (known.outliers, known.end_outliers) == (0.5, ())
    assert DEFAULT.expecting(0.0).outliers == DEFAULT.least_outliers


@pytest.mark.parametrize(
    "wrong", [{"schedule": Schedule(turns=0)}, {"starts": 0}, {"first_starts": 0}, {"recipes": ()}, {"outliers": 1.0}]
)
def test_settings_without_a_meaning_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        SearchSettings(**wrong)


def test_a_time_limit_ends_the_search():
    generator = torch.Generator().manual_seed(0)
    f, p = bearings(torch.rand(1, 60, 2, generator=generator)), torch.rand(1, 60, 3, generator=generator)
    *_, stats = search(f, p, deadline=Deadline.after(1e-6))
    assert stats.iterations.item() == 0
    assert np.isinf(stats.residual.item())


def test_points_at_the_end_of_the_world_do_not_matter(problem):
    """A reconstruction's few points far away decide neither where the search starts nor its scale."""
    torch.manual_seed(5)
    points3d, rays = problem.points3d[:1].clone(), problem.bearings[:1].clone()
    far = torch.randperm(points3d.shape[1])[:4]
    points3d[0, far] *= 1e5
    camera = points3d[0, far] @ problem.rotation[0].T + problem.translation[0]
    rays[0, far] = torch.nn.functional.normalize(camera, dim=-1)
    rotation, _, stats = search(rays, points3d, settings=DEFAULT.limited(8))
    assert bool(stats.converged[0])
    assert rotation_error(rotation, problem.rotation[:1]).item() < 1


@pytest.mark.parametrize("spread", [0.1, 0.01, 0.003, 0.0008])
def test_narrow_views_are_solved_like_wide_ones(spread: float) -> None:
    """80 points of unit extent seen under `spread` radians from far away, noise of 0.002 of it, 10 outliers a side."""
    rng = np.random.default_rng(1)
    points, noise = rng.normal(size=(90, 3)), 0.002 * spread * rng.normal(size=(80, 3))
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.2, np.sqrt(2) / spread])
    camera = points[:80] @ rotation.T + translation
    outliers = np.column_stack([spread * rng.normal(size=(10, 2)), np.ones(10)])
    rays = np.concatenate([directions(camera) + noise, outliers])
    aside = Rotation.random(rng=rng).as_matrix()  # the view is not along the camera's axis
    rays = directions(rays) @ aside.T
    found = search_poses(PointSets(rays, points))
    turned, moved = found.best
    assert found.verdict == "confident"
    assert np.degrees(Rotation.from_matrix(turned.T @ aside @ rotation).magnitude()) < 0.2
    assert np.linalg.norm(moved - aside @ translation) < 0.002 * translation[2]
    assert found.residual == pytest.approx(0.002 * spread, rel=0.3)


def test_a_search_in_doubt_looks_beside_its_best_pose(monkeypatch):
    """All batches end at a pose that beats chance and is 4 degrees off, as in a wide optimum beside the right one."""
    planted = plant(1, 200, seed=5, noise=1e-3, outliers2d=20, outliers3d=20)
    sets = PointSets(planted.bearings[0].double().numpy(), planted.points3d[0].double().numpy())
    truth, middle = planted.rotation[0].double().numpy(), sets.points3d.mean(0)
    wrong = Rotation.from_rotvec([np.radians(4), 0, 0]).as_matrix() @ truth
    translation = planted.translation[0].double().numpy() + (truth - wrong) @ middle

    def ends(scene, *_):
        pose = Candidates.unscored(*scene.enter(wrong[None], translation[None]), hits=1)
        return replace(pose, scale=np.full(1, 0.03, np.float32), score=np.full(1, 4, np.float32)), 1.0

    monkeypatch.setattr(schedule, "multistart", ends)
    monkeypatch.setattr(pool, "finish", lambda scene, poses, annealed=None: poses)
    result = search_poses(sets, settings=DEFAULT.limited(3))
    assert result.verdict == "confident"
    assert degrees_between(result.best[0], truth) < 0.5


def test_of_points_that_have_no_label_in_common_no_pose_is_found():
    rng = np.random.default_rng(4)
    sets = PointSets(directions(rng.normal(size=(300, 3)) + [0, 0, 4]), rng.normal(size=(280, 3)))
    sets = replace(sets, labels2d=np.ones(300, np.int64), labels3d=np.full(280, 2))
    result = search_poses(sets)
    assert result.verdict == "failed"
    assert result.batches == 0
    assert not len(result.candidates)


def test_a_doubtful_pose_near_a_prior_gets_all_sources_in_turn(problem, monkeypatch):
    """docs/search.md: a raster search near the prior, a batch drawn from it, a batch from anywhere, and so on."""
    sets = PointSets(problem.bearings[0].double().numpy(), problem.points3d[0].double().numpy())
    rotation, translation = (values[0].double().numpy() for values in problem.near(1.0, seed=1))
    settings = replace(DEFAULT, schedule=replace(DEFAULT.schedule, near=0, looks=0))
    pool = Pool(Scene(sets, 0, settings), replace(sets, prior=PosePrior(rotation, translation, 5.0, 0.1)), NO_POSE)
    found = replace(Candidates.none(), log10_false_alarms=np.zeros(0))
    asked = []
    for name in ("search_near", "multistart_near", "multistart"):
        monkeypatch.setattr(schedule, name, lambda *_, name=name: (asked.append(name), (found, 1.0))[1])
    one = Candidates.unscored(np.eye(3, dtype=np.float32)[None], np.ones((1, 3), np.float32))
    pool.candidates = replace(one, log10_false_alarms=np.array([-1.0]))
    turns = schedule.turns(pool, None, None)
    for _ in range(6):
        next(turns)
    assert asked == ["search_near", "multistart_near", "multistart"] * 2


def test_a_look_that_betters_nothing_is_counted_at_once(problem):
    """And one that the deadline cut short is not."""
    sets = PointSets(problem.bearings[0].double().numpy(), problem.points3d[0].double().numpy())
    for deadline, looks in ((Deadline(), 1), (Deadline.after(0.0), 0)):
        pool = Pool(Scene(sets, 0, DEFAULT, deadline), sets, NO_POSE)
        pose = problem.rotation[0].double().numpy()[None], problem.translation[0].double().numpy()[None]
        entered, one = Candidates.unscored(*pool.scene.enter(*pose)), np.ones(1, np.float32)
        pool.merge(replace(entered, scale=1e-3 * one, score=5 * one, matched=one))
        assert pool.alarms < 0
        unseen = pool.missed
        pool.look_around(pool.leader)
        pool.merge(Candidates.none())
        assert pool.looks(pool.leaders()) == looks
        assert (pool.missed < unseen) == bool(looks)
