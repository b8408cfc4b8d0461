"""How far apart the features of a set are, while a network is trained."""

from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.utilities.rank_zero import rank_zero_warn
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from bpnp.models.nets.normalisation import centred
from bpnp.training.plugins import feature_nets


class FeatureSpread(Callback):
    """Logs "train/feature_spread_2d" and "_3d", and warns once when the features collapse: where all points of a set
    have the same feature the assignment is uniform, and the loss stays where it is.

    The spread is the mean distance of a set's features from their mean; of unit vectors in all directions it is 1.

    Args:
        threshold: a spread below it counts as collapsed.
        patience: steps in a row below the threshold before the warning.
        every: steps from one measurement to the next.
    """

    def __init__(self, threshold: float = 0.05, patience: int = 300, every: int = 10) -> None:
        if threshold < 0 or patience < 1 or every < 1:
            raise ValueError(
                f"expected threshold >= 0, patience >= 1 and every >= 1, got {threshold}, {patience} and {every}"
            )
        self.threshold, self.patience, self.every = threshold, patience, every
        self.spread: dict[str, Tensor] = {}
        self.collapsed_since: int | None = None
        self.warned = False
        self._measuring = False
        self._hooks: list[RemovableHandle] = []

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        nets = feature_nets(pl_module)
        self._hooks = [net.register_forward_hook(partial(self._measure, side)) for side, net in nets.items()]

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
        values = {f"train/feature_spread_{side}": value for side, value in self.spread.items()}
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

    def _measure(self, side: str, net: nn.Module, inputs: tuple[Any, ...], features: Tensor) -> None:
        if self._measuring:
            self.spread[side] = feature_spread(features.detach(), inputs[1]).mean()

    def state_dict(self) -> dict[str, Any]:
        return {"collapsed_since": self.collapsed_since, "warned": self.warned}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.collapsed_since, self.warned = state_dict["collapsed_since"], state_dict["warned"]


def feature_spread(features: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, " b"]:
    """Mean distance of the features of each set's real points from their mean."""
    return (torch.linalg.vector_norm(centred(features, mask), dim=-1) * mask).sum(1) / mask.sum(1)
