"""Training and evaluation of a blind PnP solver: losses, metrics and the optimiser around any `Batch -> Prediction`."""

import time
from typing import Any, Literal, cast

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torchmetrics import MetricCollection

from bpnp.metrics import MeanOverPairs, PoseQuartiles, PoseRecall
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.checkpoint import check_solver
from bpnp.training.losses import RELEASED_BOUNDS, pose_loss
from bpnp.training.supervision import MatchingLoss, correspondence_losses, known_values, matching_losses
from bpnp.types import Batch, Prediction

Stage = Literal["train", "val", "test"]
CHECK_EVERY = 50  # steps between two looks at the skipped ones on a GPU


class TrainingDivergedError(RuntimeError):
    """Too many optimiser steps in a row had no finite loss or gradient."""


class BlindPnPTask(LightningModule):
    """Any solver, trained with L = L_c + pose_weight * L_p (paper Eqs. 9 to 13) and Adam.

    Args:
        solver: module that maps a Batch to a Prediction; its class attribute `estimates` names its poses, the first of
            which is reported without its name (`val/rotation_q2_deg`) and selects checkpoints.
        learning_rate: of Adam; the paper has 1e-5.
        weight_decay: of Adam; the paper has 0, the released code 1e-3.
        pose_weight: gamma_p of Eq. 13. While it is 0 no pose is solved in training; `PoseLossWarmup` raises it.
        pose_estimate: the estimate that L_p looks at.
        bounded_pose_loss: clamp L_p at pi/2 and 1.0 as the released code does; the paper's loss is unbounded.
        matching_loss: what trains the assignment: correspondence for the paper's L_c (Eq. 9); likelihood for the
            negative log likelihood of each point's partner (`matching_likelihood_loss`); reprojection for the angle
            between the pairs under the solved pose_estimate, without labels (Eq. 2).
        correspondence_angle: with L_c, supervise by the pose alone: pairs within this angle (radians) count as
            correspondences; null for the true ones.
        max_skipped_steps: end the run after so many steps in a row without a finite loss and gradient.
    """

    def __init__(
        self,
        solver: nn.Module | None = None,
        *,
        learning_rate: float = 1e-5,
        weight_decay: float = 0.0,
        pose_weight: float = 0.0,
        pose_estimate: str = "pnp",
        bounded_pose_loss: bool = False,
        matching_loss: MatchingLoss = "correspondence",
        correspondence_angle: float | None = None,
        max_skipped_steps: int = 20,
    ) -> None:
        super().__init__()
        self.solver = BPnPNet() if solver is None else solver
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.pose_weight = pose_weight
        self.pose_estimate = pose_estimate
        self.pose_bounds = RELEASED_BOUNDS if bounded_pose_loss else None
        if matching_loss != "correspondence" and correspondence_angle is not None:
            raise ValueError(f"expected `correspondence_angle` with matching_loss correspondence, got {matching_loss}")
        self.matching_loss = matching_loss
        self.correspondence_angle = correspondence_angle
        self.max_skipped_steps = max_skipped_steps
        # Steps left out in all, and in a row: on the device, so that counting them never waits for it.
        self.skipped: Tensor
        self.register_buffer("skipped", torch.zeros(2, dtype=torch.long), persistent=False)
        self.estimates: tuple[str, ...] = tuple(getattr(self.solver, "estimates", ()))
        self.pose_metrics = nn.ModuleDict(
            {
                f"{stage}_{name}": MetricCollection([PoseQuartiles(), PoseRecall()])
                for stage in ("val", "test")
                for name in self.estimates
            }
        )
        self.loss_metrics = nn.ModuleDict({stage: MeanOverPairs() for stage in ("val", "test")})

    def forward(self, batch: Batch) -> Prediction:
        return self.solver(batch)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        prediction = self.solver(batch, poses=self.pose_weight > 0 or self.matching_loss == "reprojection")
        loss = self.losses(prediction, batch, "train").mean()
        self._log_train(loss=loss, skipped_steps=self.skipped[0].float())
        # A loss that is not finite makes every gradient NaN, in every process, and so leaves out the step.
        return loss * torch.where(loss.isfinite(), 1.0, torch.nan)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluate(batch, "val")

    def test_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """The prediction, the seconds that it took, and the correspondence loss per pair; for the results writer."""
        return self._evaluate(batch, "test")

    def predict_step(self, batch: Batch, batch_idx: int) -> Prediction:
        return self.solver(batch)

    def losses(self, prediction: Prediction, batch: Batch, stage: Stage) -> Tensor:
        """L_c + gamma_p L_p per sample; a sample whose pose did not converge has no L_p, and is counted."""
        matching, trained = matching_losses(
            prediction, batch, kind=self.matching_loss, angle=self.correspondence_angle, estimate=self.pose_estimate
        )
        if stage == "train":
            correspondence = self.matching_loss == "correspondence"
            known = matching if correspondence else self.correspondence_losses(prediction, batch)
            logged = {} if known is None else {"correspondence_loss": known.mean()}
            if not correspondence:
                logged |= {"matching_loss": matching.sum() / trained.sum(), "left_out": 1 - trained.float().mean()}
            self._log_train(**logged, **_assignment_stats(prediction))
        # A mean over the batch is then one over the samples that have a loss; without any it is NaN, and no step.
        matching = matching * (len(trained) / trained.sum())
        if self.pose_weight == 0:
            return matching
        pose = prediction.poses[self.pose_estimate]
        solved = pose.stats.converged
        rotation_gt = known_values(batch.rotation, "rotation")
        translation_gt = known_values(batch.translation, "translation")
        # A pose that was not found is NaN; the truth in its place has a loss, and no gradient, that are masked out.
        rotation = torch.where(solved[:, None, None], pose.rotation, rotation_gt)
        translation = torch.where(solved[:, None], pose.translation, translation_gt)
        errors = pose_loss(rotation, translation, rotation_gt, translation_gt, bounds=self.pose_bounds) * solved
        if stage == "train":
            self._log_train(without_pose=1 - solved.float().mean(), pose_loss=errors.sum() / solved.sum())
        return matching + self.pose_weight * errors

    def correspondence_losses(self, prediction: Prediction, batch: Batch) -> Tensor | None:
        """L_c per sample; None if the solver has no assignment or the batch nothing to compare it with."""
        return correspondence_losses(prediction, batch, angle=self.correspondence_angle)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Without a finite gradient the step is left out, by the optimiser itself and on its device."""
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for g in gradients]))
        broken = ~norm.isfinite()
        optimizer.found_inf = broken.float()  # type: ignore[attr-defined]
        self.skipped += broken
        self.skipped[1] *= broken
        self._log_train(gradient_norm=norm)
        if (self.device.type == "cpu" or self.global_step % CHECK_EVERY == 0) and (
            int(self.skipped[1]) >= self.max_skipped_steps
        ):
            raise TrainingDivergedError(
                f"expected finite losses and gradients, got {int(self.skipped[1])} steps in a row without, at step "
                f"{self.global_step}; try a lower model.learning_rate or trainer.gradient_clip_val"
            )

    def configure_optimizers(self) -> OptimizerLRScheduler:
        parameters = [p for p in self.parameters() if p.requires_grad]
        return torch.optim.Adam(parameters, lr=self.learning_rate, weight_decay=self.weight_decay, fused=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The solver's class and settings, from which `BPnPNet.from_checkpoint` builds it again."""
        settings = getattr(self.solver, "settings", {})
        checkpoint["solver"] = {"class": type(self.solver).__name__, "settings": dict(settings)}
        checkpoint["skipped_steps"] = self.skipped.tolist()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        check_solver(checkpoint.get("solver", {}), type(self.solver).__name__, getattr(self.solver, "settings", {}))
        self.skipped.copy_(torch.tensor(checkpoint.get("skipped_steps", (0, 0))))

    def on_validation_epoch_end(self) -> None:
        self._log_metrics("val")

    def on_test_epoch_end(self) -> None:
        self._log_metrics("test")

    def _evaluate(self, batch: Batch, stage: Stage) -> dict[str, Any]:
        prediction, seconds = self._timed(batch)
        for name, pose in prediction.poses.items():
            self._pose_metrics(stage, name).update(pose, batch)
        losses = self.correspondence_losses(prediction, batch)
        if losses is not None:
            self._loss_metric(stage).update(losses, batch.index)
        return {"prediction": prediction, "seconds": seconds, "losses": losses}

    def _pose_metrics(self, stage: Stage, estimate: str) -> MetricCollection:
        return cast(MetricCollection, self.pose_metrics[f"{stage}_{estimate}"])

    def _loss_metric(self, stage: Stage) -> MeanOverPairs:
        return cast(MeanOverPairs, self.loss_metrics[stage])

    def _timed(self, batch: Batch) -> tuple[Prediction, float]:
        _wait(self.device)
        start = time.perf_counter()
        prediction = self.solver(batch)
        _wait(self.device)
        return prediction, time.perf_counter() - start

    def _log_train(self, **values: Tensor | float) -> None:
        self.log_dict({f"train/{k}": v for k, v in values.items()}, on_step=True, on_epoch=False, batch_size=1)

    def _log_metrics(self, stage: Stage) -> None:
        for i, name in enumerate(self.estimates):
            metrics = self._pose_metrics(stage, name)
            values = metrics.compute()
            metrics.reset()
            self._log_all({f"{stage}/{name}/{k}": v for k, v in values.items()})
            if i == 0:
                self._log_all({f"{stage}/{k}": v for k, v in values.items()})
        loss = self._loss_metric(stage)
        if loss.update_called:
            self._log_all({f"{stage}/correspondence_loss": loss.compute()})
            loss.reset()

    def _log_all(self, values: dict[str, Tensor]) -> None:
        # The metrics have already been gathered over processes.
        self.log_dict({k: v.float() for k, v in values.items()})


def _assignment_stats(prediction: Prediction) -> dict[str, Tensor]:
    stats = prediction.assignment_stats
    if stats is None:
        return {}
    return {
        "sinkhorn_iterations": stats.iterations.float().mean(),
        "sinkhorn_unconverged": 1 - stats.converged.float().mean(),
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
