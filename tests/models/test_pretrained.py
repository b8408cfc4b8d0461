"""The packaged weights: found by name, offline, and good on shapes that they were not trained on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_data import small_net

from bpnp import Batch, BPnPNet, Matcher, solve
from bpnp.datamodules import MeshDataModule, Outliers, SyntheticMapDataModule
from bpnp.metrics import rotation_error, translation_error
from bpnp.models.weights import (
    LEARNED,
    TrainedNet,
    checkpoint_path,
    describe_module,
    pack_weights,
    pretrained_names,
)

pytestmark = pytest.mark.slow


def views_of_shapes(count: int, folder: Path, **options: Any) -> Batch:
    """Draw problems of test shapes, 64 points each."""
    sizes = {"num_points": 64, "pool_size": 64, "test_shapes": count, "batch_size": count}
    data = MeshDataModule(**sizes, cache_dir=str(folder), **options)
    data.setup("test")
    return next(iter(data.test_dataloader()))


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Batch:
    """From every side."""
    return views_of_shapes(24, tmp_path_factory.mktemp("c"), rotation="so3")


def test_an_unknown_name_of_weights_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="there are no packaged weights '../x'; the names are .*procedural-so3"):
        BPnPNet.from_pretrained("../x")


@pytest.mark.parametrize("name", pretrained_names())
def test_packaged_networks_have_the_refined_pose(name: str) -> None:
    """Their cards recommend it; the recipes of the paper, which some were trained with, switch it off."""
    assert TrainedNet.from_pretrained(name).estimates == ("ransac", "pnp", "refined")


def medians(name: str, batch: Batch) -> dict[str, float]:
    """Rotation error of each estimate; chance is beyond 90 degrees."""
    assert batch.rotation is not None
    net = BPnPNet.from_pretrained(name)
    assert not net.training
    with torch.no_grad():
        poses = net(batch).poses
    return {key: float(rotation_error(pose.rotation, batch.rotation).median()) for key, pose in poses.items()}


def test_the_weights_find_unseen_shapes_from_every_side(unseen: Batch) -> None:
    found = medians(LEARNED, unseen)
    assert found["ransac"] < 3
    assert found["pnp"] < 1
    assert found["refined"] < 1


def test_a_learned_prior_is_the_packaged_net_in_any_unit(unseen: Batch) -> None:
    assert unseen.rotation is not None
    x, p = unseen.points2d[0], 7 * unseen.points3d[0] + torch.tensor([5.0, -3.0, 1.0])
    solution = solve(x, p, prior="learned")
    of_net = solve(x, p, prior=BPnPNet.from_pretrained(LEARNED))
    np.testing.assert_array_equal(solution.rotation, of_net.rotation)
    assert solution.verdict == "confident"
    relative = torch.as_tensor(solution.rotation)[None]
    assert float(rotation_error(relative, unseen.rotation[:1].double())) < 1


def test_the_weights_of_the_paper_have_its_inference_and_show_what_its_pose_loss_does(tmp_path: Path) -> None:
    """Drawn shapes that were not trained on, 500 points each: L_p lowers the layer's translation error (Table 1)."""
    data = MeshDataModule(num_points=500, pool_size=500, test_shapes=16, batch_size=16, seed=5, cache_dir=str(tmp_path))
    data.setup("test")
    batch = next(iter(data.test_dataloader()))
    assert batch.rotation is not None
    assert batch.translation is not None
    shift = {}
    for name in ("paper-lc", "paper-lclp"):
        net = BPnPNet.from_pretrained(name)
        assert (net.rounds, net.transport.mu, net.ransac.backend, net.pnp.solver) == (0, 0.1, "opencv", "lbfgs")
        net.refinement.enabled = False
        with torch.no_grad():
            poses = net(batch).poses
        shift[name] = float(translation_error(poses["pnp"].translation, batch.translation).median())
        for pose in poses.values():
            assert float(rotation_error(pose.rotation, batch.rotation).median()) < 20
    assert shift["paper-lclp"] < 0.8 * shift["paper-lc"]


@pytest.fixture(scope="module")
def cluttered(tmp_path_factory: pytest.TempPathFactory) -> Batch:
    """Draw problems as in the paper, with half as many outliers as pairs on each side."""
    return views_of_shapes(16, tmp_path_factory.mktemp("c"), test_outliers=Outliers(ratio=0.5))


def test_the_matcher_finds_matches_among_outliers(cluttered: Batch) -> None:
    """The most probable match of a paired point is the true one or a near one; of 96, chance is in the middle."""
    assert cluttered.rotation is not None
    net = Matcher.from_pretrained("matcher-clutter")
    moved = replace(cluttered, points3d=7 * cluttered.points3d + torch.tensor([5.0, -3.0, 1.0]))
    with torch.no_grad():
        prediction = net(moved)
    partner = cluttered.match3d.clamp_min(0)
    true = prediction.assignment.gather(1, partner.unsqueeze(1))
    rank = (prediction.assignment > true).sum(1)[cluttered.match3d >= 0]
    assert float(rank.float().median()) <= 1
    alone, paired = ((cluttered.match3d < 0) & cluttered.mask3d), cluttered.match3d >= 0
    assert prediction.unmatched3d[alone].median() > 1.3 * prediction.unmatched3d[paired].median()
    assert float(rotation_error(prediction.poses["ransac"].rotation, cluttered.rotation).median()) < 5
    assert float(rotation_error(prediction.poses["refined"].rotation, cluttered.rotation).median()) < 1.5


def test_the_matcher_is_a_prior_and_a_solver_of_solve(cluttered: Batch) -> None:
    assert cluttered.rotation is not None
    points = cluttered.points2d[0], cluttered.points3d[0]
    for way in ({"prior": Matcher.from_pretrained("matcher-clutter")}, {"solver": checkpoint_path("matcher-clutter")}):
        relative = torch.as_tensor(solve(*points, **way).rotation)[None]
        assert float(rotation_error(relative, cluttered.rotation[:1].double())) < 5


def test_the_matcher_for_maps_finds_matches_in_the_axes_of_the_view() -> None:
    """Use synthetic maps; a match is as improbable as any other pair if the points are rotated away."""
    data = SyntheticMapDataModule(frame="view", num_points=128, outliers=0.5, test_problems=8, seed=7)
    data.setup("test")
    batch = next(iter(data.test_dataloader()))
    net = Matcher.from_pretrained("matcher-maps")
    assert net.frame == "view"
    turned = replace(batch, points3d=batch.points3d[..., [1, 2, 0]])
    right, wrong = (shares_of_partners(net, each) for each in (batch, turned))
    assert right > 0.2
    assert right > 4 * wrong


def shares_of_partners(net: Matcher, batch: Batch) -> float:
    """Return the median probability of the true match of 3D points that have one."""
    with torch.no_grad():
        assignment = net.match(batch).assignment
    true = assignment.gather(1, batch.match3d.clamp_min(0).unsqueeze(1)).squeeze(1) / assignment.sum(1)
    return float(true[batch.match3d >= 0].median())


def test_packing_keeps_the_net_in_half_the_space(tmp_path: Path, unseen: Batch) -> None:
    net = small_net(normalise=True).eval()
    content = {
        "solver": describe_module(net),
        "state_dict": {f"solver.{key}": value for key, value in net.state_dict().items()} | {"skipped": torch.zeros(2)},
        "optimizer_states": [torch.zeros(1000)],
    }
    torch.save(content, tmp_path / "whole.ckpt")
    pack_weights(tmp_path / "whole.ckpt", tmp_path / "out" / "packed.ckpt")
    assert set(torch.load(tmp_path / "out" / "packed.ckpt", weights_only=True)) == {"solver", "state_dict"}
    assert (tmp_path / "out" / "packed.ckpt").stat().st_size < 0.6 * (tmp_path / "whole.ckpt").stat().st_size
    pack_weights(tmp_path / "whole.ckpt", tmp_path / "out" / "later.ckpt", steps=7)
    assert torch.load(tmp_path / "out" / "later.ckpt", weights_only=True)["global_step"] == 7
    packed = BPnPNet.from_checkpoint(tmp_path / "out" / "packed.ckpt")
    with torch.no_grad():
        np.testing.assert_allclose(packed.cost(unseen), net.cost(unseen), atol=5e-3)
    content["state_dict"]["solver.features2d.enter.bias"] = torch.full((16,), 1e6)
    torch.save(content, tmp_path / "large.ckpt")
    with pytest.raises(
        ValueError, match="solver.features2d.enter.bias of .*large.ckpt has weights beyond the range of float16"
    ):
        pack_weights(tmp_path / "large.ckpt", tmp_path / "large_packed.ckpt")
    assert not (tmp_path / "large_packed.ckpt").exists()
