"""The pose loss as a module: its limits, samples without it, and what a checkpoint keeps of it."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from planted import Planted, plant, posed
from scipy.spatial.transform import Rotation
from small_data import quiet_trainer, small_net
from torch import Tensor, nn

from bpnp import Batch, Prediction
from bpnp.training import BlindPnPTask, PoseLoss
from bpnp.training.losses import pose_losses

ANGLES, SHIFTS = (0.3, 2.0, 1.5, 3.0), (0.2, 0.4, 1.7, 5.0)


def off_by(planted: Planted) -> tuple[Tensor, Tensor]:
    """Rotations and translations that are off by `ANGLES`, by scipy, and by `SHIFTS`, with gradients."""
    turns = Rotation.from_rotvec(np.outer(ANGLES, [0.6, 0.0, 0.8])).as_matrix()
    rotation = torch.from_numpy(turns) @ planted.rotation
    translation = planted.translation + torch.tensor(SHIFTS).double()[:, None] * torch.tensor([0.0, 0.6, -0.8]).double()
    return rotation.requires_grad_(), translation.requires_grad_()


def test_a_term_below_its_limit_is_that_without_one_and_above_it_has_no_gradient() -> None:
    planted = plant(4, 8)
    found = {}
    for name, loss in {"free": PoseLoss(), "capped": PoseLoss(max_rotation=math.pi / 2, max_translation=1.0)}.items():
        pose = off_by(planted)
        terms = loss(Prediction(poses={"pnp": posed(*pose)}), planted.batch())
        found[name] = terms, torch.autograd.grad(sum(values.sum() for values in terms.values()), pose)
    (free, slopes), (capped, capped_slopes) = found["free"], found["capped"]
    assert free["rotation"].tolist() == pytest.approx(ANGLES)
    assert free["translation"].tolist() == pytest.approx(SHIFTS)
    assert capped["rotation"].tolist() == pytest.approx([0.3, math.pi / 2, 1.5, math.pi / 2])
    assert capped["translation"].tolist() == pytest.approx([0.2, 0.4, 1, 1])
    for slope, capped_slope, below in zip(slopes, capped_slopes, ([0, 2], [0, 1]), strict=True):
        above = [k for k in range(4) if k not in below]
        assert slope.flatten(1).any(1).all()
        assert torch.equal(capped_slope[below], slope[below])
        assert not capped_slope[above].any()


def test_a_sample_without_a_pose_has_no_pose_loss_and_no_gradient() -> None:
    planted = plant(2, 8)
    pose = planted.near(0.1)
    rotation, translation = (torch.where(torch.tensor([True, False]).view(-1, *[1] * (x.ndim - 1)), x, torch.nan)
                             for x in pose)  # fmt: skip
    translation = translation.requires_grad_()
    prediction = Prediction(poses={"pnp": posed(rotation, translation, [True, False])})
    terms, having = pose_losses(PoseLoss(max_translation=1.0), prediction, planted.batch())
    assert having.tolist() == [True, False]
    assert {name: values[1].item() for name, values in terms.items()} == {"rotation": 0, "translation": 0}
    (slope,) = torch.autograd.grad(terms["translation"].sum(), translation)
    assert slope[0].norm() == pytest.approx(1)
    assert not slope[1].any()


class Depth(nn.Module):
    """A user's pose loss: the error of the distance."""

    def forward(self, prediction: Prediction, batch: Batch) -> dict[str, Tensor]:
        return {"depth": (prediction.poses["pnp"].translation - batch.translation)[:, 2].abs()}


def test_the_total_has_the_terms_of_a_users_pose_loss() -> None:
    planted = plant(2, 8)
    task = BlindPnPTask(small_net(), pose_weight=0.5, pose_loss=Depth())
    rotation, translation = planted.pose
    moved = posed(rotation, translation + torch.tensor([9, 9, 0.3]))
    losses = task.losses(Prediction(planted.permutation(), poses={"pnp": moved}), planted.batch())
    assert losses.pose_means().keys() == {"depth"}
    assert float(losses.total) == pytest.approx(-1 + 0.5 * 0.3)


def test_a_pose_loss_of_another_shape_is_one_error() -> None:
    planted = plant(2, 8)
    prediction = Prediction(poses={"pnp": posed(*planted.pose)})
    with pytest.raises(ValueError, match=r"Answer returned Tensor; a dict of tensors of shape \(2,\) is needed"):
        pose_losses(Answer(torch.zeros(2)), prediction, planted.batch())
    with pytest.raises(ValueError, match=r"returned \{'a': \(1,\)\}; a dict of tensors of shape \(2,\)"):
        pose_losses(Answer({"a": torch.zeros(1)}), prediction, planted.batch())
    with pytest.raises(ValueError, match="`max_rotation` is -1.0"):
        PoseLoss(max_rotation=-1.0)


class Answer(nn.Module):
    """A loss that returns a given value."""

    def __init__(self, value: object) -> None:
        super().__init__()
        self.value = value

    def forward(self, *_: object) -> object:
        return self.value


def test_a_checkpoint_keeps_the_limits(tmp_path: Path) -> None:
    task = BlindPnPTask(small_net(), pose_loss=PoseLoss(max_translation=2.0))
    trainer = quiet_trainer(tmp_path, max_epochs=0)
    trainer.strategy.connect(task)
    trainer.save_checkpoint(tmp_path / "task.ckpt")
    again = BlindPnPTask.load_from_checkpoint(tmp_path / "task.ckpt")
    assert (again.pose_loss.max_rotation, again.pose_loss.max_translation) == (None, 2.0)
