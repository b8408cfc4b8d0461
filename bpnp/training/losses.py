"""Losses of an assignment and of a pose (paper Eqs. 11 to 15), one value per sample."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, distributed, nn

from bpnp.geometry import rotation_angle, within_angle
from bpnp.types import Batch, Prediction

MatchingLoss = Literal["correspondence", "likelihood"]
# Least probability, which keeps the logarithm of a padded point finite. Float32 ends at 1e-38; the gradient 1 / P has
# room for a loss scale of training in half precision.
SMALLEST = 1e-30


@dataclass(frozen=True)
class Losses:
    """Terms of L = L_c + gamma_p L_p (paper Eq. 15) of each sample; zero, without a gradient, where undefined."""

    matching: Float[Tensor, " b"]  # L_c, or the matching loss in its place
    matched: Bool[Tensor, " b"]  # samples that have a matching loss
    pose: dict[str, Float[Tensor, " b"]] | None = None  # terms of L_p by name, (b,) each; None without a pose loss
    posed: Bool[Tensor, " b"] | None = None  # samples that have a pose loss
    pose_weight: float = 0.0  # gamma_p
    # Numbers of samples (3,) to divide by: with a matching loss, with a pose loss, and all. None: those of these
    # samples.
    counts: Float[Tensor, " 3"] | None = None

    def over_processes(self) -> "Losses":
        """Return the losses divided by the mean numbers of samples of all processes; each has a part of the batch.

        The mean of the processes' totals, and of their gradients, is then that of one process with the whole batch.
        """
        return replace(self, counts=mean_over_processes(self._counts().float()))

    def _counts(self) -> Tensor:
        if self.counts is not None:
            return self.counts
        posed = self.matched if self.posed is None else self.posed
        return torch.stack([self.matched.sum(), posed.sum(), torch.ones_like(posed).sum()])

    @property
    def total(self) -> Float[Tensor, ""]:
        """L of the batch: the mean of L_c over the samples that have one, and gamma_p times that of L_p.

        NaN if no sample has a matching loss.
        """
        total = self.matching_mean
        return total if self.pose is None else total + self.pose_weight * sum(self.pose_means().values())

    @property
    def matching_mean(self) -> Float[Tensor, ""]:
        """Mean of L_c over the samples that have one; NaN if there are none."""
        return self.matching.sum() / self._counts()[0]

    def mean(self, values: Tensor) -> Float[Tensor, ""]:
        """Return the mean of one value per sample (b,)."""
        return values.sum() / self._counts()[2]

    def pose_means(self) -> dict[str, Float[Tensor, ""]]:
        """Return the mean of each term of L_p over the samples that have one; zero if there are none."""
        if self.pose is None or self.posed is None:
            return {}
        count = self._counts()[1]
        count = torch.where(count > 0, count, 1)
        return {name: values.sum() / count for name, values in self.pose.items()}


def mean_over_processes(values: Tensor) -> Tensor:
    """Return the mean of a tensor over all processes; the tensor itself in a single process."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return values
    total = values.clone()
    distributed.all_reduce(total)
    return total / distributed.get_world_size()


def matching_losses(prediction: Prediction, batch: Batch, *, kind: MatchingLoss, angle: float | None) -> Losses:
    """Return `correspondence_losses` or `matching_likelihood_loss` of each sample's assignment.

    Raise ValueError if the prediction has no assignment, or the batch no labels.
    """
    if prediction.assignment is None:
        raise ValueError("the solver returns no assignment to train; use one that does, such as bpnp.models.BPnPNet")
    matched = torch.ones(len(batch), dtype=torch.bool, device=prediction.assignment.device)
    if kind == "likelihood":
        return Losses(matching_likelihood_loss(prediction, batch), matched)
    losses = correspondence_losses(prediction, batch, angle=angle)
    if losses is None:
        raise ValueError(
            "matching_loss correspondence needs problems with `match3d`; set model.correspondence_angle to train with "
            "true poses alone"
        )
    return Losses(losses, matched)


def own_losses(loss: nn.Module, prediction: Prediction, batch: Batch) -> Losses:
    """Return the values of a user's loss of (Prediction, Batch), one per problem; NaN marks a sample without one.

    Raise ValueError if it does not return one number per problem.
    """
    values = loss(prediction, batch)
    if not isinstance(values, Tensor) or values.shape != (len(batch),):
        found = f"shape {tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__
        raise ValueError(f"{type(loss).__name__} returned {found}; a tensor of shape ({len(batch)},) is needed")
    matched = ~values.isnan()
    return Losses(torch.where(matched, values, 0), matched)


def correspondence_losses(prediction: Prediction, batch: Batch, *, angle: float | None) -> Float[Tensor, " b"] | None:
    """Return L_c of each sample (paper Eq. 11); None without an assignment, or without true matches.

    An angle, in radians, is supervision by the true pose alone with C_ij = [angle(f_i, R_gt p_j + t_gt) <= angle]; a
    point may then have several correspondences.
    """
    if prediction.assignment is None:
        return None
    if angle is None:
        return None if batch.match3d is None else correspondence_loss(prediction.assignment, batch.match3d)
    true = within_angle(batch.points2d, batch.points3d, *true_pose(batch), angle)
    return (prediction.assignment * (1.0 - 2.0 * true)).sum((-2, -1))


def true_pose(batch: Batch) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Return the true rotations and translations; raise ValueError if the batch has none."""
    if batch.rotation is None or batch.translation is None:
        raise ValueError("the batch has no true `rotation` and `translation`; give them to Batch.from_arrays")
    return batch.rotation, batch.translation


def pose_losses(loss: nn.Module, prediction: Prediction, batch: Batch) -> tuple[dict[str, Tensor], Bool[Tensor, " b"]]:
    """Return the terms of a pose loss, zero and without a gradient where one is NaN, and which samples have all terms.

    Raise ValueError if it does not return one number per problem and term.
    """
    terms = loss(prediction, batch)
    shapes = {name: tuple(values.shape) for name, values in terms.items()} if isinstance(terms, dict) else {}
    if not shapes or set(shapes.values()) != {(len(batch),)}:
        raise ValueError(
            f"{type(loss).__name__} returned {shapes or type(terms).__name__}; a dict of tensors of shape "
            f"({len(batch)},) is needed"
        )
    posed = ~torch.stack(list(terms.values())).isnan().any(0)
    return {name: torch.where(posed, values, 0) for name, values in terms.items()}, posed


def correspondence_loss(assignment: Float[Tensor, "b m n"], match3d: Int[Tensor, "b n"]) -> Float[Tensor, " b"]:
    """Return L_c = sum_ij P_ij (1 - 2 C_ij) (paper Eq. 11) with C from indices; in [-1, 1] if P sums to one.

    `match3d` is the index of the 2D point of each 3D point, -1 for none and for padding.
    """
    matched = assignment.gather(1, match3d.clamp_min(0).unsqueeze(1)).squeeze(1)
    return assignment.sum((-2, -1)) - 2 * (matched * (match3d >= 0)).sum(-1)


def matching_likelihood_loss(prediction: Prediction, batch: Batch) -> Float[Tensor, " b"]:
    """Return the negative log-likelihood, nats, of each point's true correspondence, -log P(j | i) and -log P(i | j).

    It is the mean over the true matches, in both directions; Liu et al. (arXiv:2003.06752) balance the log-likelihoods
    of matches and non-matches under the joint P instead. With dustbins (`unmatched2d`, `unmatched3d`), the mean of
    -log P(dustbin | i) over the points without a match is added, so that their numbers do not matter. Unlike that of
    `correspondence_loss`, the gradient does not vanish where the probability of the true match is small. A probability
    below 1e-30, such as one that is zero in float32, counts as 1e-30 and has no gradient. Raise ValueError for no
    assignment or no `match3d`.
    """
    assignment, match3d = prediction.assignment, batch.match3d
    if assignment is None or match3d is None:
        missing = "the solver returns no assignment" if assignment is None else "the batch has no `match3d`"
        raise ValueError(f"{missing}; matching_loss likelihood needs both")
    index2d = match3d.clamp_min(0)
    paired = (match3d >= 0).to(assignment.dtype)
    # Several 3D points may have the same 2D point.
    paired2d = torch.zeros_like(assignment[:, :, 0]).scatter_reduce(1, index2d, paired, "amax")
    rows, cols = assignment.sum(2), assignment.sum(1)
    rows = rows if prediction.unmatched2d is None else rows + prediction.unmatched2d
    cols = cols if prediction.unmatched3d is None else cols + prediction.unmatched3d
    joint = _log(assignment.gather(1, index2d.unsqueeze(1)).squeeze(1))
    both = 2 * joint - _log(cols) - _log(rows).gather(1, index2d)
    loss = -(both * paired).sum(1) / (2 * paired.sum(1)).clamp_min(1)
    if prediction.unmatched2d is None or prediction.unmatched3d is None:
        return loss
    unmatched2d, unmatched3d = batch.mask2d * (1 - paired2d), batch.mask3d * (1 - paired)
    log_bins = ((_log(prediction.unmatched2d) - _log(rows)) * unmatched2d).sum(1)
    log_bins = log_bins + ((_log(prediction.unmatched3d) - _log(cols)) * unmatched3d).sum(1)
    return loss - log_bins / (unmatched2d.sum(1) + unmatched3d.sum(1)).clamp_min(1)


def _log(probability: Tensor) -> Tensor:
    return probability.clamp_min(SMALLEST).log()


def pose_terms(
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    rotation_gt: Float[Tensor, "b 3 3"],
    translation_gt: Float[Tensor, "b 3"],
) -> dict[str, Float[Tensor, " b"]]:
    """Return the two terms of the pose loss L_p = L_r + L_t (paper Eq. 12).

    They are "rotation", L_r = angle(R, R_gt) in radians (Eq. 13), and "translation", L_t = ||t - t_gt|| in scene units
    (Eq. 14).
    """
    return {
        "rotation": rotation_angle(rotation_gt, rotation),
        "translation": torch.linalg.vector_norm(translation - translation_gt, dim=-1),
    }
