"""Headings: the scene is turned about its vertical for the network alone, and the pose with most support is kept."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from planted import Planted, padded, plant
from scipy.spatial.transform import Rotation
from small_data import small_net
from torch import Tensor, nn

from bpnp import Batch, BPnPNet
from bpnp.layers import RansacPnP, WeightedPnP
from bpnp.metrics import rotation_error
from bpnp.models import Refinement
from bpnp.models.pose_stages import pose_support

SIZES = (24, 31, 20)


class OneHeading(nn.Module):
    """Features of scene points that are those of their image points, if the scene has one known heading.

    It stands for a network that was trained with this heading: in any other the features are mixed up.
    """

    def __init__(self, scenes: Tensor) -> None:
        super().__init__()
        self.scenes = scenes

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        mean = points.sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        known = self.scenes - self.scenes.sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        heading_is_known = ((points - mean - known) * mask.unsqueeze(-1)).abs().amax((1, 2)) < 1e-3
        index = torch.arange(points.shape[1]).expand(len(points), -1)
        index = torch.where(heading_is_known[:, None], index, (7 * index + 3) % 19)
        return nn.functional.one_hot(index, 32).to(points)


class ImageIndex(nn.Module):
    """Features of image points: the index of each, one-hot."""

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        return nn.functional.one_hot(torch.arange(points.shape[1]), 32).to(points).expand(len(points), -1, -1)


def scenes() -> list[Planted]:
    """Exact problems whose match of 3D point j is 2D point j."""
    found = []
    for i, n in enumerate(SIZES):
        one = plant(1, n, seed=i, dtype=torch.float64)
        order = one.match3d[0]
        points2d = one.points2d[:, order]
        found.append(replace(one, points2d=points2d, match3d=torch.arange(n)[None]))
    return found


def turned(one: Planted, degrees: float, axis: str) -> Planted:
    """The same photo of a scene that is turned about an axis through its origin."""
    about = torch.as_tensor(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
    return replace(one, points3d=one.points3d @ about.T, rotation=one.rotation @ about.T)


def net_of_one_heading(known: Batch, **options: Any) -> BPnPNet:
    return BPnPNet(ImageIndex(), OneHeading(known.points3d), ransac=RansacPnP(), pnp=WeightedPnP(),
                   refinement=Refinement(enabled=False), **options).eval()  # fmt: skip


def errors(net: BPnPNet, batch: Batch, estimate: str = "ransac") -> list[float]:
    assert batch.rotation is not None
    return rotation_error(net(batch).poses[estimate].rotation, batch.rotation).nan_to_num(180).tolist()


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_scene_turned_by_a_planted_heading_gives_the_pose_turned_back(axis: Any) -> None:
    """The network knows one heading of each scene, and gets it turned by -60, -180 and -300 degrees."""
    problems = scenes()
    known = padded(problems)
    batch = padded([turned(one, angle, axis) for one, angle in zip(problems, (-60, -180, -300), strict=True)])
    assert min(errors(net_of_one_heading(known), batch)) > 5
    net = net_of_one_heading(known, headings=6, vertical=axis)
    for estimate in ("ransac", "pnp"):
        assert max(errors(net, batch, estimate)) < 0.1
    expected = torch.eye(max(SIZES))
    for i, n in enumerate(SIZES):
        chosen = net(batch).assignment[i, :n, :n]
        assert torch.equal(chosen.argmax(0), expected[:n, :n].argmax(0))


def test_headings_between_the_known_one_find_nothing() -> None:
    problems = scenes()
    batch = padded([turned(one, -30, "y") for one in problems])
    assert min(errors(net_of_one_heading(padded(problems), headings=6), batch)) > 5


def test_one_heading_is_the_network_without() -> None:
    batch = padded([one.batch() for one in scenes()])
    torch.manual_seed(0)
    net = small_net(normalise=True).eval()
    without = net(batch)
    net.headings = 1
    torch.testing.assert_close(net(batch).assignment, without.assignment, rtol=0, atol=0)
    assert net.train()(batch).poses.keys() == {"ransac", "pnp"}


def test_headings_of_a_problem_do_not_depend_on_its_batch() -> None:
    torch.manual_seed(0)
    net = small_net(normalise=True, refine=False).double().eval()
    net.headings = 4
    together = net(padded(scenes()))
    for i, (one, n) in enumerate(zip(scenes(), SIZES, strict=True)):
        alone = net(one.batch())
        torch.testing.assert_close(together.assignment[i : i + 1, :n, :n], alone.assignment, rtol=0, atol=1e-9)
        for estimate, pose in alone.poses.items():
            torch.testing.assert_close(
                together.poses[estimate].rotation[i : i + 1], pose.rotation, rtol=0, atol=1e-6, equal_nan=True
            )


def test_training_has_one_heading() -> None:
    known = padded(scenes())
    batch = padded([turned(one, -60, "y") for one in scenes()])
    net = net_of_one_heading(known, headings=6)
    assert min(errors(net, batch)) < 0.1
    assert min(errors(net.train(), batch)) > 5


def test_the_support_is_the_probability_that_a_pose_explains() -> None:
    one = scenes()[0]
    batch, n = one.batch(), SIZES[0]
    assignment = torch.eye(n, dtype=torch.float64)[None] / n
    pose = net_of_one_heading(batch)(batch).poses["ransac"]
    assert float(pose_support(assignment, batch, pose)) == pytest.approx(1)
    assert float(pose_support(assignment.roll(1, -1), batch, pose)) < 0.2
    lost = replace(pose, rotation=torch.full_like(pose.rotation, math.nan))
    assert float(pose_support(assignment, batch, lost)) == 0


def test_a_wrong_number_of_headings_is_named() -> None:
    with pytest.raises(ValueError, match="`headings` is 0; it must be 1 or more"):
        BPnPNet(headings=0)
