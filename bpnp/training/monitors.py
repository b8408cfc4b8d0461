"""What a training shows while it runs: speed, where the assignment puts its mass, how far apart the features of a set
are, and pictures of a few pairs."""

import os
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_warn
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from bpnp.report.dashboards import image
from bpnp.report.figures import plot_pair, save_figure
from bpnp.report.samples import PairView, views_from
from bpnp.types import Batch, Prediction


class OfflineWandbLogger(WandbLogger):
    """Lightning's W&B logger that sends nothing unless asked: offline where WANDB_MODE is not set.

    Args:
        project, name: of the run.
        save_dir: where the folder of an offline run goes, for `wandb sync`.
    """

    def __init__(self, project: str = "bpnp", name: str | None = None, save_dir: str = "runs") -> None:
        os.makedirs(save_dir, exist_ok=True)
        mode = os.environ.get("WANDB_MODE") or "offline"  # as an argument too: wandb reads its variables only once
        super().__init__(project=project, name=name, save_dir=save_dir, offline=mode == "offline", mode=mode)


class TrainingMonitor(Callback):
    """Logs "train/pairs_per_second" per epoch and, of the first few validation pairs, "val/true_match_mass", the
    probability that the assignment gives to their true matches, and "val/<estimate>_iterations" of each pose.

    Every `every` epochs the same pairs are drawn: to W&B or TensorBoard where one logs, else to files in `pictures`
    of the trainer's default_root_dir.

    Args:
        pairs: how many validation pairs are watched.
        every: epochs between pictures; 0 for none.
    """

    def __init__(self, pairs: int = 4, every: int = 10) -> None:
        if pairs < 1 or every < 0:
            raise ValueError(f"expected pairs >= 1 and every >= 0, got {pairs} and {every}")
        self.pairs = pairs
        self.every = every
        self.watched: Batch | None = None
        self.started = 0.0
        self.seen = 0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.started, self.seen = time.perf_counter(), 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.seen += len(batch)
        if trainer.is_last_batch:
            # Before the validation that ends the epoch, which is no training.
            seconds = time.perf_counter() - self.started
            pairs = self.seen * trainer.world_size
            pl_module.log("train/pairs_per_second", pairs / seconds, on_step=False, on_epoch=True, batch_size=1)

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        if batch_idx == 0 and self.watched is None:
            self.watched = first_pairs(batch, self.pairs)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.watched is None or trainer.sanity_checking:
            return
        batch = self.watched.to(pl_module.device)
        with torch.no_grad():
            prediction = pl_module(batch)
        values = {f"val/{key}": value for key, value in watched_values(prediction, batch).items()}
        pl_module.log_dict(values, batch_size=len(batch), sync_dist=True)
        if self.every and trainer.current_epoch % self.every == 0 and trainer.is_global_zero:
            _draw(trainer, views_from(prediction, batch))


class FeatureSpread(Callback):
    """Logs "train/feature_spread_2d" and "_3d", and warns once when the features collapse: where all points of a set
    have the same feature the assignment is uniform, and the loss stays where it is.

    The spread is the mean distance of a set's features from their mean; of unit vectors in all directions it is 1.

    Args:
        threshold: a spread below it counts as collapsed.
        patience: steps in a row below the threshold before the warning.
        every: steps from one measurement to the next.
        names: feature nets of the solver, called with points and mask.
    """

    def __init__(
        self,
        threshold: float = 0.05,
        patience: int = 300,
        every: int = 10,
        names: Sequence[str] = ("features2d", "features3d"),
    ) -> None:
        if threshold < 0 or patience < 1 or every < 1:
            raise ValueError(
                f"expected threshold >= 0, patience >= 1 and every >= 1, got {threshold}, {patience} and {every}"
            )
        self.threshold = threshold
        self.patience = patience
        self.every = every
        self.names = tuple(names)
        self.spread: dict[str, Tensor] = {}
        self.collapsed_since: int | None = None
        self.warned = False
        self._measuring = False
        self._hooks: list[RemovableHandle] = []

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        solver = pl_module.get_submodule("solver")
        missing = [name for name in self.names if not isinstance(getattr(solver, name, None), nn.Module)]
        if missing:
            raise ValueError(f"expected nets of {type(solver).__name__}, got {missing}; try others in `names`")
        self._hooks = [getattr(solver, name).register_forward_hook(partial(self._measure, name)) for name in self.names]

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for hook in self._hooks:
            hook.remove()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self._measuring = trainer.global_step % self.every == 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if not self._measuring:
            return
        self._measuring = False
        values = {f"train/feature_spread_{name.removeprefix('features')}": v for name, v in self.spread.items()}
        pl_module.log_dict(values, on_step=True, on_epoch=False, batch_size=1)
        lowest = float(torch.stack(list(self.spread.values())).min())
        if lowest >= self.threshold:
            self.collapsed_since = None
        elif self.collapsed_since is None:
            self.collapsed_since = trainer.global_step
        elif trainer.global_step - self.collapsed_since >= self.patience and not self.warned:
            self.warned = True
            rank_zero_warn(
                f"expected features that differ from point to point, got a spread of {lowest:.2g} at step "
                f"{trainer.global_step}, below {self.threshold} since step {self.collapsed_since}: the features have "
                "collapsed; try a lower model.learning_rate, a warm-up, or `centre` of the solver's features"
            )

    def _measure(self, name: str, net: nn.Module, inputs: tuple[Any, ...], features: Tensor) -> None:
        if self._measuring:
            self.spread[name] = feature_spread(features.detach(), inputs[1]).mean()

    def state_dict(self) -> dict[str, Any]:
        return {"collapsed_since": self.collapsed_since, "warned": self.warned}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.collapsed_since, self.warned = state_dict["collapsed_since"], state_dict["warned"]


def feature_spread(features: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, " b"]:
    """Mean distance of the features of each set's real points from their mean."""
    weight = mask.to(features.dtype)
    count = weight.sum(1)
    mean = (features * weight.unsqueeze(-1)).sum(1, keepdim=True) / count[:, None, None]
    return (torch.linalg.vector_norm(features - mean, dim=-1) * weight).sum(1) / count


def first_pairs(batch: Batch, count: int) -> Batch:
    """The first pairs of a batch, on the CPU."""
    parts: dict[str, Any] = {
        name: value[:count].cpu() if isinstance(value, torch.Tensor) else value and value[:count]
        for name, value in vars(batch).items()
    }
    return Batch(**parts)


def watched_values(prediction: Prediction, batch: Batch) -> dict[str, torch.Tensor]:
    """Mean over the pairs of the probability on true matches, and of the iterations of each pose."""
    values = {f"{name}_iterations": pose.stats.iterations.float().mean() for name, pose in prediction.poses.items()}
    if prediction.assignment is not None and batch.match3d is not None:
        matched = batch.match3d >= 0
        mass = prediction.assignment.gather(1, batch.match3d.clamp(min=0)[:, None]).squeeze(1)
        values["true_match_mass"] = mass.where(matched, 0).sum(-1).mean()
    return values


def _draw(trainer: Trainer, views: list[PairView]) -> None:
    drawn = False
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):
            logger.log_image("val/pairs", [image(plot_pair(view), caption=view.id) for view in views])
            drawn = True
        elif isinstance(logger, TensorBoardLogger):
            for number, view in enumerate(views):
                logger.experiment.add_figure(f"val/pair{number}", plot_pair(view), trainer.global_step)
            drawn = True
    if not drawn and trainer.loggers:
        folder = os.path.join(trainer.default_root_dir, "pictures", f"epoch_{trainer.current_epoch:04d}")
        for number, view in enumerate(views):
            save_figure(plot_pair(view), os.path.join(folder, f"pair{number}.png"))
