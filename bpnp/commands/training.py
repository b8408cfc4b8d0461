"""`bpnp fit`, `validate` and `test`: Lightning's own command line, with this project's run folder."""

import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

from jsonargparse import Namespace
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from lightning.pytorch.utilities.types import LRSchedulerTypeUnion
from torch.optim import Optimizer

import bpnp.datamodules
from bpnp.commands.parser import OneLineParser, plain
from bpnp.files import claimed, config_content
from bpnp.report.terminal import say
from bpnp.training.callbacks import (
    InterruptedCheckpoint,
    PoseLossWarmup,
    ResultsWriter,
    SafeCheckpointIO,
    interruptible,
)
from bpnp.training.task import BlindPnPTask, TrainingDivergedError

POSE_LOSS: dict[str, tuple[type, str]] = {
    "start_epoch": (int, "first epoch with the pose loss, counted from 0; none for no switch"),
    "weight": (float, "gamma_p of the paper after the switch; none for that of the model, or 1"),
}


class _Parser(OneLineParser, LightningArgumentParser):
    """Lightning's parser with errors of one line."""


class BpnpCLI(LightningCLI):
    """Lightning's CLI with this project's run folder: checkpoints, logs and results under trainer.default_root_dir.

    command: the one to parse and run.
    """

    def __init__(self, command: str, *args: Any, **kwargs: Any) -> None:
        self.command = command
        super().__init__(*args, **kwargs)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """The one that was asked for: its parser alone takes a second to build."""
        return {self.command: super().subcommands()[self.command]}

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        self.config = parser.parse_args(args)

    def init_parser(self, **kwargs: Any) -> LightningArgumentParser:
        parser = _Parser(**kwargs)
        parser.add_argument("-c", "--config", action="config", help="configuration file, or the name of a packaged one")
        return parser

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(ModelCheckpoint, "best_checkpoint")
        parser.add_lightning_class_args(ModelCheckpoint, "last_checkpoint")
        parser.add_lightning_class_args(ResultsWriter, "results")
        for name, (kind, meaning) in POSE_LOSS.items():
            parser.add_argument(f"--pose_loss.{name}", type=kind | None, default=None, help=meaning)
        parser.set_defaults(
            {
                "trainer.default_root_dir": "runs/default",
                "best_checkpoint.monitor": "val/rotation_q2_deg",
                "best_checkpoint.filename": "best",
                "best_checkpoint.enable_version_counter": False,
                "last_checkpoint.filename": "last",
                "last_checkpoint.enable_version_counter": False,
            }
        )
        for name in ("best_checkpoint", "last_checkpoint"):
            parser.link_arguments("trainer.default_root_dir", f"{name}.dirpath", compute_fn=_checkpoint_folder)

    def before_instantiate_classes(self) -> None:
        """Merge `--pose_loss` into the `PoseLossWarmup` of the configuration, or add one.

        Raises:
            ValueError: a weight is set without an epoch.
        """
        given = {name: value for name, value in vars(self._get(self.config, "pose_loss")).items() if value is not None}
        if not given:
            return
        trainer = self._get(self.config, "trainer")
        listed = trainer.callbacks or []
        trainer.callbacks = list(listed) if isinstance(listed, list) else [listed]
        for callback in trainer.callbacks:
            if callback.class_path.rpartition(".")[2] == PoseLossWarmup.__name__:
                callback.init_args.update(Namespace(**given))
                return
        if "start_epoch" not in given:
            raise ValueError(
                "--pose_loss.weight needs --pose_loss.start_epoch, the first epoch with the pose loss. "
                "Use --model.pose_weight for a pose loss in all epochs."
            )
        path = f"{PoseLossWarmup.__module__}.{PoseLossWarmup.__name__}"
        settings = Namespace(start_epoch=given["start_epoch"], weight=given.get("weight"))
        trainer.callbacks.append(Namespace(class_path=path, init_args=settings))

    @staticmethod
    def configure_optimizers(
        lightning_module: LightningModule, optimizer: Optimizer, lr_scheduler: LRSchedulerTypeUnion | None = None
    ) -> Any:
        """Use `--optimizer` and `--lr_scheduler`; without the latter, the schedule of the task."""
        if lr_scheduler is None and isinstance(lightning_module, BlindPnPTask):
            return lightning_module.with_schedule(optimizer)
        return LightningCLI.configure_optimizers(lightning_module, optimizer, lr_scheduler)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """A CSV log always, beside what the configuration logs to, all in the run's folder; a progress bar unless it is
        not wanted."""
        if self._get(self.config, "trainer.enable_progress_bar") is False:
            self.trainer_defaults["callbacks"] = [InterruptedCheckpoint()]
        # Not a default of the trainer: an object among the defaults could not be written to config.yaml.
        plugins = self._get(self.config_init, "trainer.plugins") or []
        plugins = [*(plugins if isinstance(plugins, list) else [plugins]), SafeCheckpointIO()]
        chosen = self._get(self.config_init, "trainer.logger")
        loggers = chosen if isinstance(chosen, list) else [] if chosen in (None, True, False) else [chosen]
        root = self._get(self.config_init, "trainer.default_root_dir")
        if chosen is not False and not any(isinstance(logger, CSVLogger) for logger in loggers):
            loggers = [*loggers, CSVLogger(root, name="logs")]
        return super().instantiate_trainer(**{"plugins": plugins, "logger": loggers} | kwargs)

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        """Our own tables instead of a list of all metrics, and no assignments kept in memory."""
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "test":
            parser.set_defaults({"verbose": False})
        return parser

    def _parse_ckpt_path(self) -> None:
        """Nothing to do: our checkpoints hold no settings of the trainer's. The trainer reads them, once."""

    def _run_subcommand(self, subcommand: str) -> None:
        """In a run folder that no other training holds."""
        self._check_checkpoint(subcommand)
        training = subcommand == "fit" and self.trainer.global_rank == 0
        with claimed(Path(self.trainer.default_root_dir)) if training else nullcontext(), interruptible(self.trainer):
            super()._run_subcommand(subcommand)

    def after_fit(self) -> None:
        """Say where the checkpoints are."""
        for path in sorted(Path(_checkpoint_folder(self.trainer.default_root_dir)).glob("*.ckpt")):
            if self.trainer.is_global_zero and not self.trainer.fast_dev_run:  # type: ignore[attr-defined]
                say(f"wrote {path}")

    def after_test(self) -> None:
        """Raise ValueError if there was nothing to test: Lightning is silent."""
        if not sum(self.trainer.num_test_batches):
            raise ValueError(f"expected problems to test on, got none from {type(self.datamodule).__name__}")

    def _check_checkpoint(self, subcommand: str) -> None:
        """Raise ValueError for `--ckpt_path last` where there is none; warn if untrained weights are evaluated."""
        path = self._get(self.config, "ckpt_path")
        folder = Path(_checkpoint_folder(self.trainer.default_root_dir))
        if path == "last" and not list(folder.glob("last*.ckpt")):
            raise ValueError(f"expected a checkpoint for --ckpt_path last in {folder}, got none; try without it")
        trained = re.search("checkpoint|pretrained", str(self._get(self.config, "model.solver")))
        weights = path or self._get(self.config, "model.weights") or trained
        if subcommand != "fit" and not weights and any(True for _ in self.model.parameters()):
            sys.stderr.write("bpnp: no --ckpt_path: the weights of the solver are untrained\n")


def _checkpoint_folder(root: str) -> str:
    return str(Path(root) / "checkpoints")


def run_training(arguments: Sequence[str]) -> None:
    """Parse the arguments of fit, validate or test, and run it.

    Raises ValueError for a mistake of the user's, and for a training that diverged.
    """
    for name in dir(bpnp.datamodules):  # those that are imported are listed by --help and have short names
        getattr(bpnp.datamodules, name)
    own_task = _names_a_task(arguments)
    try:
        BpnpCLI(
            arguments[0],
            LightningModule if own_task else BlindPnPTask,
            LightningDataModule,
            subclass_mode_model=own_task,
            subclass_mode_data=True,
            seed_everything_default=0,
            save_config_kwargs={"overwrite": True},
            trainer_defaults={
                "callbacks": [RichProgressBar(), InterruptedCheckpoint()],
                "max_epochs": 200,
                "num_sanity_val_steps": 0,
            },
            parser_kwargs={"prog": "bpnp", "allow_abbrev": False},
            args=list(arguments),
        )
    except (MisconfigurationException, TrainingDivergedError, ValueError) as error:
        raise ValueError(plain(str(error))) from error


def _names_a_task(arguments: Sequence[str]) -> bool:
    """Whether the options or a configuration file name a LightningModule in place of BlindPnPTask."""
    words = [word for text in arguments for word in text.split("=", 1)]
    files = [Path(value) for name, value in pairwise(words) if name in ("-c", "--config")]
    models = [config_content(file).get("model") for file in files if file.is_file()]
    named = any(isinstance(model, str) or (isinstance(model, dict) and "class_path" in model) for model in models)
    return named or not {"--model", "--model.class_path"}.isdisjoint(words)
