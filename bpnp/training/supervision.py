"""What an assignment is trained with: its true pairs, the true pose, or neither."""

from typing import Literal

import torch
from torch import Tensor

from bpnp.training.losses import (
    correspondence_loss,
    correspondence_loss_from_pose,
    matching_likelihood_loss,
    self_supervised_loss,
)
from bpnp.types import Batch, Prediction

MatchingLoss = Literal["correspondence", "likelihood", "reprojection"]


def matching_losses(
    prediction: Prediction, batch: Batch, *, kind: MatchingLoss, angle: float | None, estimate: str
) -> tuple[Tensor, Tensor]:
    """The loss of each sample's assignment, and which samples have one; the others' is zero, without a gradient.

    kind: correspondence (`correspondence_losses`, with `angle`), likelihood (`matching_likelihood_loss`), or
        reprojection, which looks at no label (`self_supervised_loss` under the pose `estimate`). Raises ValueError for
        a prediction without an assignment, or a batch without the labels that the kind needs.
    """
    if prediction.assignment is None:
        raise ValueError("expected a solver with an assignment to train, got none; try bpnp.models.BPnPNet")
    everyone = torch.ones(len(batch), dtype=torch.bool, device=prediction.assignment.device)
    if kind == "likelihood":
        return matching_likelihood_loss(prediction, batch), everyone
    if kind == "reprojection":
        pose = prediction.poses[estimate]
        return self_supervised_loss(prediction.assignment, batch, pose), pose.stats.converged
    known = correspondence_losses(prediction, batch, angle=angle)
    if known is None:
        raise ValueError(
            "expected pairs with `match3d` for matching_loss correspondence, got none; try matching_loss reprojection"
        )
    return known, everyone


def correspondence_losses(prediction: Prediction, batch: Batch, *, angle: float | None) -> Tensor | None:
    """L_c per sample (paper Eq. 9); None if there is no assignment, or nothing to compare it with.

    angle: None for the true pairs; else all pairs within it, radians, under the true pose.
    """
    if prediction.assignment is None:
        return None
    if angle is None:
        return None if batch.match3d is None else correspondence_loss(prediction.assignment, batch.match3d)
    rotation, translation = known_values(batch.rotation, "rotation"), known_values(batch.translation, "translation")
    return correspondence_loss_from_pose(
        prediction.assignment, batch.points2d, batch.points3d, rotation, translation, angle=angle
    )


def known_values(value: Tensor | None, name: str) -> Tensor:
    """What a batch holds. Raises ValueError where it holds nothing."""
    if value is None:
        raise ValueError(f"expected a batch with its true `{name}`, got None")
    return value
