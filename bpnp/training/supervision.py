"""What a solver is trained with: the true pairs of an assignment, the true pose, or neither."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.training.losses import (
    correspondence_loss,
    correspondence_loss_from_pose,
    matching_likelihood_loss,
    pose_loss,
    self_supervised_loss,
)
from bpnp.types import Batch, Pose, Prediction

MatchingLoss = Literal["correspondence", "likelihood", "reprojection"]


@dataclass(frozen=True)
class Losses:
    """The terms of L = L_c + gamma_p L_p (paper Eq. 13) for each sample; zero, without a gradient, where there is none.

    matched, posed: the samples that have a matching loss, and a pose loss.
    """

    matching: Float[Tensor, " b"]
    matched: Bool[Tensor, " b"]
    pose: Float[Tensor, " b"] | None = None
    posed: Bool[Tensor, " b"] | None = None
    pose_weight: float = 0.0

    @property
    def total(self) -> Float[Tensor, " b"]:
        """L, whose mean over the batch has the mean of L_c over the samples with one; NaN if no sample has."""
        matching = self.matching * (len(self.matched) / self.matched.sum())
        return matching if self.pose is None else matching + self.pose_weight * self.pose


def matching_losses(prediction: Prediction, batch: Batch, *, kind: MatchingLoss, angle: float | None) -> Losses:
    """The loss of each sample's assignment.

    kind: correspondence (`correspondence_losses`, with `angle`), likelihood (`matching_likelihood_loss`), or
        reprojection, which looks at no label (`self_supervised_loss` under the pose "pnp").
    Raises ValueError for a prediction without an assignment, or a batch without the labels that the kind needs.
    """
    if prediction.assignment is None:
        raise ValueError("expected a solver with an assignment to train, got none; try bpnp.models.BPnPNet")
    everyone = torch.ones(len(batch), dtype=torch.bool, device=prediction.assignment.device)
    if kind == "likelihood":
        return Losses(matching_likelihood_loss(prediction, batch), everyone)
    if kind == "reprojection":
        pose = prediction.poses["pnp"]
        return Losses(self_supervised_loss(prediction.assignment, batch, pose), pose.stats.converged)
    known = correspondence_losses(prediction, batch, angle=angle)
    if known is None:
        raise ValueError(
            "expected pairs with `match3d` for matching_loss correspondence, got none; try matching_loss reprojection"
        )
    return Losses(known, everyone)


def own_losses(loss: nn.Module, prediction: Prediction, batch: Batch) -> Losses:
    """The values of a user's loss. Raises ValueError unless they are one number a pair."""
    values = loss(prediction, batch)
    if not isinstance(values, Tensor) or values.shape != (len(batch),):
        got = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        raise ValueError(f"expected a tensor of shape ({len(batch)},) from {type(loss).__name__}, got {got}")
    matched = ~values.isnan()
    return Losses(torch.where(matched, values, 0), matched)


def correspondence_losses(prediction: Prediction, batch: Batch, *, angle: float | None) -> Float[Tensor, " b"] | None:
    """L_c per sample (paper Eq. 9); None if there is no assignment, or nothing to compare it with.

    angle: None for the true pairs; else all pairs within it, radians, under the true pose.
    """
    if prediction.assignment is None:
        return None
    if angle is None:
        return None if batch.match3d is None else correspondence_loss(prediction.assignment, batch.match3d)
    points = batch.points2d, batch.points3d
    return correspondence_loss_from_pose(prediction.assignment, *points, *_true_pose(batch), angle=angle)


def pose_losses(pose: Pose, batch: Batch) -> Float[Tensor, " b"]:
    """L_p per sample (paper Eq. 10); zero, without a gradient, where the pose did not converge."""
    solved, truth = pose.stats.converged, _true_pose(batch)
    # A pose that was not found is NaN; the truth in its place has a loss, and no gradient, that are masked out.
    rotation = torch.where(solved[:, None, None], pose.rotation, truth[0])
    translation = torch.where(solved[:, None], pose.translation, truth[1])
    return pose_loss(rotation, translation, *truth) * solved


def _true_pose(batch: Batch) -> tuple[Tensor, Tensor]:
    if batch.rotation is None or batch.translation is None:
        raise ValueError("expected a batch with its true `rotation` and `translation`, got None")
    return batch.rotation, batch.translation
