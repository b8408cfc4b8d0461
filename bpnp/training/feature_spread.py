"""How far apart the features of a set are, while a network is trained."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from lightning import LightningModule, Trainer
from lightning.pytorch import Callback
from lightning.pytorch.utilities.rank_zero import rank_zero_warn
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle


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
