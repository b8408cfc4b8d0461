"""The stages of the search under a deadline, and from several threads at once."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from planted import plant

from bpnp.loops.parallel import Deadline
from bpnp.search.annealing import anneal_on_clusters, anneal_on_points, finish, run_batch
from bpnp.search.candidates import Candidates
from bpnp.search.kernels.sides import lloyd
from bpnp.search.point_sets import PointSets
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import draw_poses

PASSED = Deadline(0.0)


@pytest.fixture
def scene() -> Scene:
    planted = plant(1, 300, seed=2, noise=1e-4)
    return Scene(PointSets(planted.bearings[0].numpy(), planted.points3d[0].numpy()), 0, DEFAULT)


def starts(scene: Scene, count: int) -> Candidates:
    return Candidates.unscored(
        *draw_poses(scene.spread, scene.bulk3d, count, DEFAULT.recipes[0], None, scene.rng), hits=1
    )


def coarse(scene: Scene, begin: Candidates) -> Candidates:
    """The ends of starts after the coarse stage."""
    sides = scene.clusters([stage.clusters for stage in DEFAULT.coarse])
    return anneal_on_clusters(scene, begin, DEFAULT.coarse, sides, DEFAULT.starts)


def test_clusters_of_each_count_have_the_weight_of_all_points(scene: Scene) -> None:
    few, many = scene.clusters([8, 64])
    for smaller, larger in zip(few, many, strict=True):
        assert len(smaller[1]) == 8
        assert len(larger[1]) == 64
        assert smaller[1].sum() == pytest.approx(300)
        assert larger[1].sum() == pytest.approx(300)


def test_a_deadline_is_so_many_seconds_from_now() -> None:
    assert not Deadline().passed()
    assert not Deadline.after(None).passed()
    assert not Deadline.after(60.0).passed()
    soon = Deadline.after(1e-3)
    time.sleep(0.002)
    assert soon.passed()


def test_every_stage_ends_soon_after_the_deadline_with_its_first_poses(scene: Scene, monkeypatch) -> None:
    """Counted in starts, as seconds depend on the machine."""
    annealed = {"clusters": 0, "points": 0}

    def counted(name: str, function):
        def count(*arguments) -> None:
            annealed[name] += len(arguments[2])
            function(*arguments)

        return count

    for name, kernel in (("clusters", "descend"), ("points", "descend_sparse")):
        function = getattr(__import__("bpnp.search.annealing", fromlist=[kernel]), kernel)
        monkeypatch.setattr(f"bpnp.search.annealing.{kernel}", counted(name, function))
    scene.deadline = PASSED
    found = coarse(scene, starts(scene, 500))
    assert annealed["clusters"] == DEFAULT.starts_a_check * (1 + len(DEFAULT.coarse[0].halvings))
    assert len(found) > 0
    fine = anneal_on_points(scene, found[:5], 0.04 * scene.spread, every=True)
    assert 1 <= annealed["points"] < 5
    before = annealed["points"]
    assert len(finish(scene, fine)) == len(fine)
    assert annealed["points"] == before
    assert len(run_batch(scene, starts(scene, 1200), DEFAULT.coarse, Candidates.none())) > 0


def test_a_limit_that_is_not_reached_changes_nothing(scene: Scene) -> None:
    begin = starts(scene, 100)
    ends = []
    for scene.deadline in (Deadline(), Deadline.after(1e6)):
        scene.rng = np.random.default_rng(5)  # of the clusters
        ends.append(coarse(scene, begin))
    np.testing.assert_array_equal(ends[0].rotation, ends[1].rotation)
    np.testing.assert_array_equal(ends[0].score, ends[1].score)


def test_cluster_centres_are_means_of_their_points_and_an_empty_one_stays() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(50, 3)), rng.normal(size=(30, 3)) + 100]).astype(np.float32)
    first = np.float32([[1, 0, 0], [99, 100, 100], [-5000, 0, 0]])
    with ThreadPoolExecutor(4) as threads:
        for centres, members in threads.map(lambda _: lloyd(points, first, 5), range(8)):
            assert members.tolist() == [50, 30, 0]
            np.testing.assert_allclose(centres[:2], [points[:50].mean(0), points[50:].mean(0)], atol=1e-3)
            assert centres[2].tolist() == [-5000, 0, 0]
