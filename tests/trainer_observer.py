"""Callback that records a Trainer in a run of the command, and the runs that tests make with it."""

from pathlib import Path
from typing import Any, ClassVar

import torch
from lightning import Callback, LightningModule, Trainer
from small_data import MESHES, SMALL_NET
from torch import Tensor
from torch.optim import Optimizer

from bpnp.cli import main

OBSERVED = "--trainer.callbacks=trainer_observer.Observer"


class Observer(Callback):
    """Record of the last run: learning rates, problems, weights and pose weights of each step."""

    trainer: ClassVar[Trainer]
    task: ClassVar[LightningModule]
    rates: ClassVar[list[float]] = []
    problems: ClassVar[list[tuple[str, ...]]] = []
    gradient: ClassVar[Tensor]  # of the last step, as one vector; 0 for a weight without one
    weights: ClassVar[list[Tensor]] = []  # before the first step, and after each batch
    pose_weights: ClassVar[list[float]] = []
    validated: ClassVar[list[int]] = []  # batch numbers
    dtypes: ClassVar[set[torch.dtype]] = set()  # of features

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        Observer.trainer, Observer.task = trainer, pl_module
        for record in (self.rates, self.problems, self.weights, self.pose_weights, self.validated, self.dtypes):
            record.clear()
        self.weights.append(flat(pl_module))
        linear = next(module for module in pl_module.modules() if isinstance(module, torch.nn.Linear))
        linear.register_forward_hook(lambda module, inputs, output: self.dtypes.add(output.dtype))

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        self.rates.append(optimizer.param_groups[0]["lr"])
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in pl_module.parameters()]
        Observer.gradient = torch.cat([gradient.flatten() for gradient in gradients])

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.weights.append(flat(pl_module))
        self.problems.append(batch.ids)
        self.pose_weights.append(float(pl_module.pose_weight))  # type: ignore[arg-type]

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: int
    ) -> None:
        self.validated.append(batch_idx)


def flat(module: LightningModule) -> Tensor:
    """Return all weights as one vector."""
    return torch.cat([p.detach().flatten() for p in module.parameters()])


def command(folder: Path, *options: str, word: str = "fit") -> list[str]:
    """Arguments of a run of the quickstart with a small network and few problems, under `folder`/run."""
    small = [word, "--config=quickstart", *MESHES, *SMALL_NET, "--trainer.enable_progress_bar=false"]
    return [*small, f"--trainer.default_root_dir={folder}/run", f"--data.cache_dir={folder}", *options]


def fit(folder: Path, *options: str) -> None:
    """Train, observed, without validation unless the options have it."""
    main(command(folder, OBSERVED, *options))
