"""Training and evaluation of a blind PnP solver: losses, metrics and the optimiser around any `Batch -> Prediction`."""

import inspect
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR
from torchmetrics import MetricCollection

from bpnp.checks import check_within
from bpnp.layers.implicit import BackwardStats
from bpnp.layers.pnp import WeightedPnP
from bpnp.metrics import MeanOverProblems, PoseQuartiles, PoseRecall, prediction_errors
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.refinement import REFINED, refinement_enabled
from bpnp.models.weights import (
    AnyModule,
    TrainedNet,
    build_module,
    build_solver,
    describe_module,
    fitting_state,
    is_description,
    is_plain,
    module_or_default,
    read_checkpoint,
)
from bpnp.precision import exact_products
from bpnp.training.chamfer import ChamferLoss
from bpnp.training.losses import (
    Losses,
    MatchingLoss,
    correspondence_losses,
    matching_losses,
    mean_over_processes,
    own_losses,
    pose_losses,
)
from bpnp.training.monte_carlo import MonteCarloPoseLoss
from bpnp.training.pose_loss import PoseLoss
from bpnp.training.predictions import in_scene_frame
from bpnp.training.reprojection import ReprojectionLoss
from bpnp.types import Batch, Prediction

Stage = Literal["val", "test"]
OptimizerSettings = list[tuple[str, list[dict[str, Any]]]]  # class of each optimizer, and its groups without parameters
REBUILT = {"solver", "weights"}  # options that are not saved under "task": the checkpoint has their result
LOSSES = ("loss", "pose_loss")  # options that are saved as descriptions of modules
PACKAGED_LOSSES = (PoseLoss, MonteCarloPoseLoss, ChamferLoss, ReprojectionLoss)
POSED = "pnp"  # estimate of the pose loss, which has a derivative
DECAYED = 0.02  # factor on the learning rate after the decay
WIDEST_MATCH = 0.5  # largest `correspondence_angle`, radians; larger values are probably degrees
MOST_SKIPPED = 20  # consecutive steps without a finite gradient that end the run
TOO_COARSE = ("bf16-true", "16-true")  # precisions in which even the points would have three digits


class TrainingDivergedError(RuntimeError):
    """Error after 20 consecutive optimiser steps without a finite loss and gradient."""


@dataclass
class Evaluation:
    """Metrics of the problems of one loader in an epoch."""

    poses: dict[str, MetricCollection]  # by estimate
    loss: MeanOverProblems
    numbers: set[int] = field(default_factory=set)  # indices of the problems so far


class BlindPnPTask(LightningModule):
    """Training and evaluation of any solver, with L = L_c + pose_weight * L_p (paper Eqs. 11 to 15) and Adam.

    Args:
        solver: Module that maps a Batch to a Prediction. Its class attribute `estimates` is a tuple of the names of its
            poses. Checkpoints are selected by `val/pose_error`, the median rotation error (radians) plus the median
            translation error (scene units) of the estimate "pnp", or of the first estimate if there is no "pnp".
            `val/rotation_q2_deg`, without a name, is that of the first estimate. If the solver has a method
            `match(batch)` that returns a prediction without poses, training steps that need no pose call it. None for a
            `BPnPNet` with its default options.
        weights: Initial weights of the solver: a name of packaged weights (docs/model-card.md), or a checkpoint. The
            optimiser and the step count start from zero; `--ckpt_path` resumes those of a run. None for the weights
            that the solver has.
        learning_rate: Learning rate of Adam, 1e-5 by default, as in the paper.
        weight_decay: Weight decay of Adam; 0 in the paper and by default, 1e-3 in the authors' code.
        warmup_steps: Number of optimiser steps in which the learning rate rises from zero, default 0.
        decay_start: First step of the decay, a half cosine to a fiftieth of the learning rate; None for no decay.
        decay_steps: Number of steps of the decay, default 1000.
        pose_weight: gamma_p of Eq. 15, the weight of `pose_loss`. While it is 0, the default, training computes no
            pose, unless the solver has no `match` or `loss` needs a pose. `PoseLossWarmup` sets it from an epoch on.
        pose_loss: Module from (Prediction, Batch) to the terms of the pose loss by name, one value per problem each
            (b,), NaN for a problem without one, such as one whose pose "pnp" did not converge. None for `PoseLoss()`,
            the paper's L_r and L_t.
        matching_loss: Loss of the assignment: "correspondence", the default, for the paper's L_c (Eq. 11), or
            "likelihood" for the negative log-likelihood of each point's correspondence (`matching_likelihood_loss`).
        correspondence_angle: With L_c: an image point and a scene point correspond if the true pose projects the scene
            point within this angle of the image point, radians, at most 0.5. None for the true correspondences.
        loss: Module that replaces `matching_loss`, from (Prediction, Batch) to one value per problem (b,), NaN for a
            problem without a loss. If it has an attribute `needs_pose` that is False, it gets a prediction without
            poses in training; without the attribute it gets the poses. None for `matching_loss`.
        refine_validation: Refine the poses in validation too, as in a test. That takes most of the time of a
            validation. Default False.
    """

    def __init__(
        self,
        solver: TrainedNet | AnyModule | None = None,
        *,
        weights: str | None = None,
        learning_rate: float = 1e-5,
        weight_decay: float = 0.0,
        warmup_steps: int = 0,
        decay_start: int | None = None,
        decay_steps: int = 1000,
        pose_weight: float = 0.0,
        pose_loss: PoseLoss | AnyModule | None = None,
        matching_loss: MatchingLoss = "correspondence",
        correspondence_angle: float | None = None,
        loss: AnyModule | None = None,
        refine_validation: bool = False,
    ) -> None:
        super().__init__()
        if weights is None:
            self.solver = module_or_default(solver, BPnPNet)
        else:
            content = read_checkpoint(weights)
            self.solver = build_solver(content) if solver is None else module_or_default(solver, BPnPNet)
            self._adopt(content, weights, allow_added=True)
        self.loss = None if loss is None else module_or_default(loss, nn.Module)
        self.pose_loss = module_or_default(pose_loss, PoseLoss)
        self.save_hyperparameters(
            {
                "solver": describe_module(self.solver),
                "weights": weights,
                "learning_rate": learning_rate,
                "weight_decay": weight_decay,
                "warmup_steps": warmup_steps,
                "decay_start": decay_start,
                "decay_steps": decay_steps,
                "pose_weight": pose_weight,
                "pose_loss": None if pose_loss is None else describe_module(self.pose_loss),
                "matching_loss": matching_loss,
                "correspondence_angle": correspondence_angle,
                "loss": None if self.loss is None else describe_module(self.loss),
                "refine_validation": refine_validation,
            }
        )
        self.learning_rate, self.weight_decay, self.pose_weight = learning_rate, weight_decay, pose_weight
        check_within(0, math.inf, learning_rate=learning_rate, weight_decay=weight_decay, pose_weight=pose_weight)
        check_within(0, math.inf, warmup_steps=warmup_steps, decay_start=decay_start or 0)
        check_within(1, math.inf, decay_steps=decay_steps)
        self.warmup_steps, self.decay_start, self.decay_steps = warmup_steps, decay_start, decay_steps
        if matching_loss != "correspondence" and correspondence_angle is not None:
            raise ValueError(
                f"`correspondence_angle` is for the matching loss correspondence, not for {matching_loss}; leave it out"
            )
        if correspondence_angle is not None and not 0 < correspondence_angle <= WIDEST_MATCH:
            raise ValueError(
                f"correspondence_angle is {correspondence_angle:g} radians ({math.degrees(correspondence_angle):.0f} "
                f"deg). Use an angle in radians, above 0 and at most {WIDEST_MATCH}, such as 0.01."
            )
        self.matching_loss, self.correspondence_angle = matching_loss, correspondence_angle
        self.skipped_steps = 0
        self.consecutive_skipped_steps = 0
        self.optimizer_settings: OptimizerSettings = []  # as configured
        self.saved_settings: OptimizerSettings = []  # those of the checkpoint that is resumed
        self.refine_validation = refine_validation
        self.evaluations: list[Evaluation] = []  # of the loaders of this epoch
        self.table_metrics: set[str] = set()  # names of the metrics in the tables of a test
        estimates: tuple[str, ...] | str = getattr(self.solver, "estimates", ())
        if isinstance(estimates, str):
            raise ValueError(f"`estimates` of the solver is {estimates!r}; it is a tuple of names: ({estimates!r},)")
        estimates = tuple(estimates)
        validated = tuple(name for name in estimates if refine_validation or name != REFINED)
        self.estimates: dict[Stage, tuple[str, ...]] = {"val": validated, "test": estimates}
        if pose_weight > 0 and estimates:
            self.check_pose_loss(estimates)

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls,
        checkpoint_path: str | Path,
        map_location: Any = "cpu",
        hparams_file: None = None,
        strict: bool | None = None,
        weights_only: bool | None = None,
        *,
        parts: Iterable[type[nn.Module]] = (),
        **kwargs: Any,
    ) -> "BlindPnPTask":
        """Build the task of a checkpoint: its solver, its weights, and the options of its training.

        Packaged weights have no options of a training; the task then has the defaults of the constructor.

        Args:
            checkpoint_path: File, or the name of packaged weights.
            map_location: Device of the weights. Default: the CPU.
            hparams_file: Rejected unless None; the checkpoint has the hyperparameters.
            strict: False allows missing and unexpected weights outside of the solver, such as those of a `loss`. The
                weights of the solver always have to fit. Default: None, as True.
            weights_only: False is rejected; a checkpoint is read as data. Default: None, as True.
            parts: Classes outside this package that the solver or the loss is made of. Default: none.
            **kwargs: Constructor arguments that replace those of the checkpoint.

        Returns:
            The task in training mode, as Lightning returns it; call `eval()` to predict without a Trainer.

        Raises:
            FileNotFoundError: There is no such file, and no packaged weights of that name.
            ValueError: The file is no checkpoint of a task, or does not fit a `solver` among `kwargs`.

        >>> from bpnp.training import BlindPnPTask
        >>> BlindPnPTask.load_from_checkpoint("procedural-so3").solver.rounds
        8
        """
        if hparams_file is not None or weights_only is False:
            raise ValueError("hparams_file and weights_only=False are not accepted: a checkpoint is read as data")
        content = read_checkpoint(checkpoint_path, map_location=map_location)
        accepted = constructor_arguments(cls)
        options = {key: value for key, value in content.get("task", {}).items() if key in accepted} | kwargs
        try:
            for name in LOSSES:
                if is_description(options.get(name)):
                    options[name] = build_module(options[name], (*PACKAGED_LOSSES, *parts))
            if options.get("solver") is None:
                options["solver"] = build_solver(content, parts)
            task = cls(**options)
            task.on_load_checkpoint(content)
            task.load_state_dict(content["state_dict"], strict=strict is not False)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{checkpoint_path}: {error}") from error
        return task

    def forward(self, batch: Batch) -> Prediction:
        """Return the prediction of the solver.

        Args:
            batch: Problems.
        """
        return self.solver(batch)

    def setup(self, stage: str) -> None:
        """Forget the optimisers and the skipped steps of an earlier training; a resumed one restores its own.

        Raises:
            ValueError: The precision of the trainer is too coarse for points and poses.
        """
        if (precision := self.trainer.precision) in TOO_COARSE:
            raise ValueError(
                f"trainer.precision is {precision}, in which points and poses have three digits; use "
                f"{precision.removesuffix('true')}mixed, 32-true or 64-true"
            )
        if stage == "fit":
            self.skipped_steps = self.consecutive_skipped_steps = 0
            self.saved_settings = []

    def on_train_batch_start(self, batch: object, batch_idx: int) -> None:
        """Check the batch."""
        check_batch(batch)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of a batch, NaN if it is not finite, and log its parts."""
        needs_pose = self.pose_weight > 0 or (self.loss is not None and getattr(self.loss, "needs_pose", True))
        solve = self.solver if needs_pose else getattr(self.solver, "match", self.solver)
        prediction = solve(batch)
        with exact_products(self.device):
            losses = self.losses(prediction, batch).over_processes()
            figures = self._figures(losses, prediction, batch)
        loss = losses.total
        self._log_train(skipped_steps=float(self.skipped_steps), **figures)
        # Make every gradient NaN in every process if the loss is not finite; the step is then skipped.
        return loss * torch.where(loss.isfinite(), 1.0, torch.nan)

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> dict[str, Any]:
        """Return the prediction, its seconds, L_c of each problem or None, and the errors of each estimate.

        L_c (paper Eq. 11) is computed whatever the loss of the training; it is None if it is undefined.
        """
        return self._evaluate(batch, "val", dataloader_idx, first=batch_idx == 0)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> dict[str, Any]:
        """Return the prediction, its seconds, L_c of each problem or None, and the errors of each estimate.

        L_c (paper Eq. 11) is computed whatever the loss of the training; it is None if it is undefined.
        """
        return self._evaluate(batch, "test", dataloader_idx, first=batch_idx == 0)

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> Prediction:
        """Return the prediction with `ids`, and with poses in the coordinates that the scene was given in."""
        return in_scene_frame(self.solver(batch), batch)

    def on_validation_epoch_start(self) -> None:
        """Start the metrics of each loader."""
        self._start_evaluation(self.estimates["val"], self.trainer.num_val_batches)

    def on_test_epoch_start(self) -> None:
        """Start the metrics of each loader."""
        self._start_evaluation(self.estimates["test"], self.trainer.num_test_batches)

    def on_predict_epoch_start(self) -> None:
        """Start the numbers of the problems of each loader."""
        self._start_evaluation((), self.trainer.num_predict_batches)

    def on_validation_batch_start(self, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Number the problems: a data module that collates with `Batch.from_arrays` counts each batch from 0."""
        check_batch(batch)
        number_globally(batch, self.evaluations[dataloader_idx].numbers, processes=self.trainer.world_size)

    on_test_batch_start = on_predict_batch_start = on_validation_batch_start

    def on_validation_batch_end(self, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Log the metrics of one of several loaders after its last batch, as Lightning then returns them by loader."""
        if len(self.evaluations) > 1 and batch_idx + 1 == self.trainer.num_val_batches[dataloader_idx]:
            self._log_metrics("val", dataloader_idx)

    def on_test_batch_end(self, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Log the metrics of one of several loaders after its last batch, as Lightning then returns them by loader."""
        if len(self.evaluations) > 1 and batch_idx + 1 == self.trainer.num_test_batches[dataloader_idx]:
            self._log_metrics("test", dataloader_idx)

    def losses(self, prediction: Prediction, batch: Batch) -> Losses:
        """Return the matching loss and, with a `pose_weight`, the pose loss of the samples that have one.

        Args:
            prediction: Prediction of the solver.
            batch: Problems with what the losses need: true matches or true poses.

        Returns:
            The terms of L (paper Eq. 15) of each sample.

        Raises:
            ValueError: The prediction or the batch lacks what a loss needs.
        """
        if self.loss is not None:
            losses = own_losses(self.loss, prediction, batch)
        else:
            losses = matching_losses(prediction, batch, kind=self.matching_loss, angle=self.correspondence_angle)
        if self.pose_weight == 0:
            return losses
        self.check_pose_loss(tuple(prediction.poses))
        terms, posed = pose_losses(self.pose_loss, prediction, batch)
        return replace(losses, pose=terms, posed=posed, pose_weight=self.pose_weight)

    def check_pose_loss(self, estimates: tuple[str, ...]) -> None:
        """Raise ValueError if the pose of the pose loss, "pnp", is not among the estimates of the solver.

        Args:
            estimates: Names of the poses of the solver.
        """
        if POSED not in estimates:
            raise ValueError(
                f"The pose loss needs the pose {POSED!r}, and {type(self.solver).__name__} returns "
                f"{', '.join(map(repr, estimates)) or 'no pose'}. Set model.pose_weight to 0 and use no PoseLossWarmup."
            )

    def on_train_epoch_end(self) -> None:
        """Log the fractions of samples without a solved gradient and of clipped columns of the derivative."""
        stats = [getattr(module, "backward_stats", None) for module in self.solver.modules()]
        counts = [each for each in stats if isinstance(each, BackwardStats)]
        clipped = [module.clipped for module in self.solver.modules() if isinstance(module, WeightedPnP)]
        self._log_fraction(
            "backward_failed", sum(each.unconverged for each in counts), sum(each.samples for each in counts)
        )
        self._log_fraction(
            "clipped_columns", sum(each.clipped for each in clipped), sum(each.columns for each in clipped)
        )
        for each in counts:
            each.reset()
        for column_count in clipped:
            column_count.reset()
        # In the last epoch of StochasticWeightAveraging, which only updates batch norms, Lightning steps without a
        # backward pass, with the remaining gradients.
        self.zero_grad()

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Log the gradient norm; if it is not finite, count the step and drop all gradients.

        No optimiser of torch changes a parameter without a gradient, or its state.

        Raises:
            TrainingDivergedError: 20 consecutive steps had no finite gradient.
        """
        norm = torch.nn.utils.get_total_norm([p.grad for p in self.parameters() if p.grad is not None])
        self._log_train(gradient_norm=norm)
        if norm.isfinite():
            self.consecutive_skipped_steps = 0
            return
        for parameter in self.parameters():
            parameter.grad = None
        self.skipped_steps += 1
        self.consecutive_skipped_steps += 1
        if self.consecutive_skipped_steps >= MOST_SKIPPED:
            raise TrainingDivergedError(
                f"The loss or its gradient was not finite in {self.consecutive_skipped_steps} consecutive steps up to "
                f"step {self.global_step}. Use a lower model.learning_rate or set trainer.gradient_clip_val."
            )

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Return Adam with the learning-rate schedule of this task."""
        trained = (p for p in self.parameters() if p.requires_grad)
        # A fused optimizer unscales the gradients of mixed precision itself, after they have been clipped.
        fused = "mixed" not in self.trainer.precision
        return self.with_schedule(Adam(trained, lr=self.learning_rate, weight_decay=self.weight_decay, fused=fused))

    def with_schedule(self, optimizer: Optimizer) -> OptimizerLRScheduler:
        """Add the learning-rate schedule of this task to an optimiser.

        Args:
            optimizer: Optimiser with the peak learning rate.

        Returns:
            The optimiser with the warm-up and the decay, or the optimiser alone if the task has neither.
        """
        if not self.warmup_steps and self.decay_start is None:
            return optimizer
        # The factor depends only on the step, because a resumed run may have another schedule; `SequentialLR` would
        # restore its milestones and its rate from the checkpoint.
        schedule = LambdaLR(optimizer, lambda _: self.rate_factor(self.trainer.global_step))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_fit_start(self) -> None:
        """Record the configured optimisers before a checkpoint replaces their settings.

        Raises:
            ValueError: The checkpoint was trained with other optimisers.
        """
        for config in self.trainer.lr_scheduler_configs:
            _scale_schedule(config.scheduler)
        self.optimizer_settings = [(type(each).__name__, _settings_of(each)) for each in self.trainer.optimizers]
        ours, theirs = ([name for name, _ in each] for each in (self.optimizer_settings, self.saved_settings))
        if theirs and theirs != ours:
            raise ValueError(
                f"The checkpoint was trained with {', '.join(theirs)}, and this run uses {', '.join(ours)}. Use the "
                "same optimizer, or start a new training with --model.weights."
            )

    def on_train_start(self) -> None:
        """Change the restored optimisers where this run has other settings than that of the checkpoint.

        Another learning rate scales the scheduled one.
        """
        configured = zip(self.trainer.optimizers, self.optimizer_settings, self.saved_settings, strict=False)
        for optimizer, (_, own), (_, saved) in configured:
            for group, ours, theirs in zip(optimizer.param_groups, own, saved, strict=True):
                rate = "initial_lr" if "initial_lr" in ours.keys() & theirs.keys() else "lr"
                scheduled = group["lr"] * (ours[rate] / theirs[rate]) if theirs[rate] else ours[rate]
                group.update({key: value for key, value in ours.items() if value != theirs.get(key)}, lr=scheduled)
        for config in self.trainer.lr_scheduler_configs:
            if hasattr(config.scheduler, "base_lrs"):
                groups = zip(config.scheduler.optimizer.param_groups, config.scheduler.base_lrs, strict=True)
                config.scheduler.base_lrs = [group.get("initial_lr", base) for group, base in groups]

    def rate_factor(self, step: int) -> float:
        """Return the factor on the learning rate: a linear rise, one, and a half cosine down to a fiftieth.

        Args:
            step: Number of optimiser steps so far.
        """
        rise = min(1.0, (step + 1) / (self.warmup_steps + 1))
        if self.decay_start is None:
            return rise
        done = min(1.0, max(0.0, (step - self.decay_start) / self.decay_steps))
        return rise * (DECAYED + (1 - DECAYED) * (1 + math.cos(math.pi * done)) / 2)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add descriptions of the solver and of the task, from which they are built again.

        They have their own names, because a LightningCLI overwrites options of the command line by what it finds under
        Lightning's "hyper_parameters".
        """
        checkpoint["solver"] = describe_module(self.solver)
        saved = checkpoint.pop(self.CHECKPOINT_HYPER_PARAMS_KEY, {})
        checkpoint.pop(self.CHECKPOINT_HYPER_PARAMS_NAME, None)
        checkpoint["task"] = {
            key: value for key, value in saved.items() if key not in REBUILT and (is_plain(value) or key in LOSSES)
        }
        checkpoint["skipped_steps"] = [self.skipped_steps, self.consecutive_skipped_steps]
        checkpoint["optimizer_settings"] = self.optimizer_settings

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Load the solver's weights, and restore the counts of skipped steps."""
        self._adopt(checkpoint, None if self._trainer is None else self.trainer.ckpt_path)
        self.skipped_steps, self.consecutive_skipped_steps = checkpoint.get("skipped_steps", (0, 0))
        self.saved_settings = checkpoint.get("optimizer_settings", [])

    def _adopt(self, content: Mapping[str, Any], file: str | Path | None, *, allow_added: bool = False) -> None:
        """Load the solver's weights, and print the settings in which it differs from the checkpoint on purpose.

        The file is that of the message, None if unknown; `allow_added` is as for `fitting_state`.
        """
        try:
            state, adjusted = fitting_state(content, self.solver, allow_added=allow_added)
        except ValueError as error:
            raise ValueError(error if file is None else f"{file}: {error}") from error
        self.solver.load_state_dict(state)
        if adjusted:
            rank_zero_info(f"the network is that of the checkpoint with {', '.join(adjusted)}")

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of the only loader of a validation."""
        if len(self.evaluations) == 1:
            self._log_metrics("val", 0)

    def on_test_epoch_end(self) -> None:
        """Log the metrics of the only loader of a test."""
        if len(self.evaluations) == 1:
            self._log_metrics("test", 0)

    def _start_evaluation(self, estimates: tuple[str, ...], batches: Sequence[int | float]) -> None:
        """Start new metrics of the estimates for each loader, which has a number of batches."""
        if len(batches) > 1 and math.inf in batches:
            raise ValueError("one of several loaders has no length; set trainer.limit_val_batches, or that of the test")
        self.evaluations = [
            Evaluation(
                {name: MetricCollection([PoseQuartiles(), PoseRecall()]).to(self.device) for name in estimates},
                MeanOverProblems().to(self.device),
            )
            for _ in batches
        ]

    def _evaluate(self, batch: Batch, stage: Stage, loader: int, *, first: bool) -> dict[str, Any]:
        with refinement_enabled(self.solver, stage == "test" or self.refine_validation):
            _wait(self.device)
            start = time.perf_counter()
            prediction = self.solver(batch)
            _wait(self.device)
        seconds = time.perf_counter() - start
        if first:
            check_prediction(prediction, batch, self.estimates[stage], type(self.solver).__name__)
        with exact_products(self.device):
            errors = prediction_errors(prediction, batch)
            for name in self.estimates[stage]:
                self.evaluations[loader].poses[name].update(errors[name])
            losses = correspondence_losses(prediction, batch, angle=self.correspondence_angle)
        if losses is not None:
            self.evaluations[loader].loss.update(losses, batch.index)
        return {"prediction": prediction, "seconds": seconds, "losses": losses, "errors": errors}

    def _log_train(self, **values: Tensor | float) -> None:
        for name, value in values.items():
            self.log(f"train/{name}", value, on_step=True, on_epoch=False, prog_bar=name == "loss", batch_size=1)

    def _log_fraction(self, name: str, part: int, whole: int) -> None:
        """Log a fraction over all processes, unless there is nothing in any of them."""
        counts = torch.tensor([part, whole], device=self.device)
        # A collective call: all processes make it, also one that has nothing to count.
        part, whole = self.trainer.strategy.reduce(counts, reduce_op="sum").tolist()
        if whole:
            self.log(f"train/{name}", part / whole, sync_dist=True)

    @torch.no_grad()
    def _figures(self, losses: Losses, prediction: Prediction, batch: Batch) -> dict[str, Tensor]:
        """Return the values that a training step logs, of the batches of all processes."""
        figures = {"loss": losses.total}
        replaced = self.loss is not None or self.matching_loss != "correspondence"
        correspondence: Tensor | None = losses.matching
        if replaced:
            correspondence = correspondence_losses(prediction, batch, angle=self.correspondence_angle)
            figures["matching_loss"] = losses.matching_mean
            figures["left_out"] = 1 - losses.mean(losses.matched)
        if correspondence is not None:
            figures["correspondence_loss"] = losses.mean(correspondence)
        if losses.pose is not None and losses.posed is not None:
            figures["without_pose"] = 1 - losses.mean(losses.posed)
            means = losses.pose_means()
            figures |= {f"{name}_loss": value for name, value in means.items()}
            figures["pose_loss"] = torch.stack(list(means.values())).sum()
        stats = prediction.assignment_stats
        if stats is not None:
            figures["sinkhorn_iterations"] = losses.mean(stats.iterations)
            figures["sinkhorn_unconverged"] = 1 - losses.mean(stats.converged)
        shares = torch.stack([value.to(losses.matching) for value in figures.values()])
        return dict(zip(figures, mean_over_processes(shares), strict=True))

    def _log_metrics(self, stage: Stage, loader: int) -> None:
        """Log the metrics of a loader, to whose names Lightning adds its index if there are several."""
        evaluation = self.evaluations[loader]
        suffix = f"/dataloader_idx_{loader}" if len(self.evaluations) > 1 else ""

        def log(figures: Mapping[str, Tensor], *, logger: bool | None = None) -> None:
            # The metrics have already been gathered over processes; without `sync_dist`, Lightning warns of each.
            self.log_dict(
                {key: value.float() for key, value in figures.items()},
                logger=logger,
                sync_dist=True,
                on_step=False,
                on_epoch=True,
                batch_size=1,
            )
            self.table_metrics |= {f"{key}{suffix}" for key in figures}

        for i, name in enumerate(self.estimates[stage]):
            values = evaluation.poses[name].compute()
            for prefix in (f"{stage}/{name}", stage) if i == 0 else (f"{stage}/{name}",):
                # The logs have the estimate's name; without it, callbacks can monitor any solver.
                log(
                    {f"{prefix}/{key}": value for key, value in values.items()},
                    logger=False if prefix == stage else None,
                )
            if name == (POSED if POSED in self.estimates[stage] else self.estimates[stage][0]):
                # L_p of the median errors (paper Eq. 12), which selects checkpoints.
                log({f"{stage}/pose_error": torch.deg2rad(values["rotation_q2_deg"]) + values["translation_q2"]})
        # compute() is a collective call: all processes make it, or none.
        if self.trainer.strategy.reduce_boolean_decision(evaluation.loss.update_called, all=False):
            log({f"{stage}/correspondence_loss": evaluation.loss.compute()})


def constructor_arguments(cls: type) -> set[str]:
    """Return the names of the arguments of a constructor, and of the base classes that its `**kwargs` pass them to."""
    names: set[str] = set()
    for each in cls.__mro__:
        parameters = inspect.signature(each.__init__).parameters.values()  # type: ignore[misc]
        names |= {parameter.name for parameter in parameters}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return names


def _settings_of(optimizer: Optimizer) -> list[dict[str, Any]]:
    """Return what a checkpoint can hold of the parameter groups, which are not the parameters."""
    return [{key: value for key, value in group.items() if is_plain(value)} for group in optimizer.param_groups]


def _scale_schedule(scheduler: Any) -> None:
    """Use a rate that was set after the scheduler was made, such as by `LearningRateFinder`, as the initial one."""
    groups, rates = scheduler.optimizer.param_groups, getattr(scheduler, "base_lrs", ())
    for group, last, initial in zip(groups, scheduler.get_last_lr(), rates, strict=False):
        if initial and group["lr"] != last:
            group.update(initial_lr=group["lr"], lr=group["lr"] * last / initial)


def check_batch(batch: object) -> None:
    """Raise ValueError if the data module returns something other than a Batch."""
    if not isinstance(batch, Batch):
        raise ValueError(
            f"the loaders of the data module return a {type(batch).__name__}, not a Batch; use a `collate_fn` that "
            "returns Batch.from_arrays(...)"
        )


def check_prediction(prediction: object, batch: Batch, estimates: tuple[str, ...], solver: str) -> None:
    """Raise ValueError unless a solver returns a Prediction with all its estimates, one pose per problem."""
    if not isinstance(prediction, Prediction):
        raise ValueError(
            f"{solver} returned a {type(prediction).__name__}, not a Prediction; use "
            "`return Prediction(poses={name: Pose(rotation, translation, stats)})`"
        )
    if absent := [name for name in estimates if name not in prediction.poses]:
        raise ValueError(
            f"Prediction.poses of {solver} has no {', '.join(absent)}, which its `estimates` name, among "
            f"{list(prediction.poses)}; use one name in both"
        )
    required = (len(batch), 3, 3), (len(batch), 3)
    for name, pose in prediction.poses.items():
        shapes = tuple(pose.rotation.shape), tuple(pose.translation.shape)
        if shapes != required:
            raise ValueError(
                f"{solver} returned rotations {shapes[0]} and translations {shapes[1]} of {name!r} instead of "
                f"{required[0]} and {required[1]}; return one pose per problem, NaN where none was found"
            )


def number_globally(batch: Batch, numbers: set[int], *, processes: int) -> None:
    """Renumber the problems of a batch after all earlier ones, `numbers`, if one of its numbers was used before.

    Numbers of the batch are added. Raise ValueError if they repeat among several processes that evaluate together,
    since these do not have each other's numbers.
    """
    index = batch.index.tolist()
    if len(set(index)) < len(index) or not numbers.isdisjoint(index):
        if processes > 1:
            raise ValueError(
                f"some of the numbers {index} in `Batch.index` repeat; use Batch.from_arrays(..., index=...) with the "
                "position of each problem in its data set"
            )
        first = max(numbers, default=-1) + 1
        unnamed = [name == str(number) for name, number in zip(batch.ids, index, strict=True)]
        batch.ids = tuple(str(first + i) if unnamed[i] else name for i, name in enumerate(batch.ids))
        batch.index = torch.arange(first, first + len(index), device=batch.index.device)
        index = batch.index.tolist()
    numbers.update(index)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
