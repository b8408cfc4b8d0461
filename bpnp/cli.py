"""The command line: `bpnp fit|validate|test|predict` are Lightning's own, the other commands are plain ones."""

import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lightning import LightningDataModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from bpnp.commands import convert_weights, prepare
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.localization import localize_command, solve_command
from bpnp.report import report_command, view_command
from bpnp.report.dashboards import wandb_command
from bpnp.table import table_command
from bpnp.training.plugins import SafeCheckpointIO
from bpnp.training.results_writer import ResultsWriter
from bpnp.training.task import BlindPnPTask, TrainingDivergedError

DESCRIPTION = """Camera pose from 2D and 3D points that nobody has matched.

Find a pose:             bpnp solve POINTS2D POINTS3D, bpnp localize --model sparse/0
Train and evaluate:      bpnp {fit,validate,test,predict} --config configs/quickstart.yaml
Read results:            bpnp report RUN..., bpnp view RUN PAIR, bpnp wandb RUN...
Compare methods:         bpnp table --data configs/psb.yaml --methods METHOD...
Prepare data:            bpnp prepare DATASET SOURCE
Released weights:        bpnp convert-weights FILE OUT
"""
COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "solve": solve_command,
    "localize": localize_command,
    "report": partial(report_command, photos=photo_finder),
    "view": partial(view_command, photos=photo_finder),
    "wandb": wandb_command,
    "table": table_command,
    "prepare": prepare,
    "convert-weights": convert_weights,
}


class BpnpCLI(LightningCLI):
    """Lightning's CLI with this project's run folder: checkpoints, logs and results under trainer.default_root_dir."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_lightning_class_args(ModelCheckpoint, "best_checkpoint")
        parser.add_lightning_class_args(ModelCheckpoint, "last_checkpoint")
        parser.add_lightning_class_args(ResultsWriter, "results")
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

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """A CSV log always, whatever else the configuration logs to; a progress bar unless it is not wanted."""
        if self._get(self.config, "trainer.enable_progress_bar") is False:
            self.trainer_defaults["callbacks"] = []
        trainer = super().instantiate_trainer(**kwargs)
        wanted = self._get(self.config, "trainer.logger") is not False
        if wanted and not any(isinstance(logger, CSVLogger) for logger in trainer.loggers):
            trainer.loggers = [*trainer.loggers, CSVLogger(trainer.default_root_dir, name="logs")]
        return trainer

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        """Our own tables instead of a list of all metrics, and no assignments kept in memory."""
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "test":
            parser.set_defaults({"verbose": False})
        if subcommand == "predict":
            parser.set_defaults({"return_predictions": False})
        return parser

    def _parse_ckpt_path(self) -> None:
        """Nothing to do: our checkpoints hold no settings of the trainer's. The trainer reads them, once."""


def _checkpoint_folder(root: str) -> str:
    return str(Path(root) / "checkpoints")


def main(args: Sequence[str] | None = None) -> None:
    """Run a command. A mistake of the user's ends in one line on stderr and exit status 2, not in a traceback."""
    arguments = list(sys.argv[1:] if args is None else args)
    logging.captureWarnings(True)
    _quieten()
    try:
        if arguments and arguments[0] in COMMANDS:
            COMMANDS[arguments[0]](arguments[1:])
        else:
            _lightning(arguments)
    except (ValueError, OSError, TrainingDivergedError, MisconfigurationException) as error:
        if os.environ.get("BPNP_TRACEBACK"):
            raise
        print(f"bpnp: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("bpnp: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _lightning(arguments: list[str]) -> None:
    BpnpCLI(
        BlindPnPTask,
        LightningDataModule,
        subclass_mode_data=True,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
        trainer_defaults={
            "callbacks": [RichProgressBar()],
            "plugins": [SafeCheckpointIO()],
            "max_epochs": 200,
            "num_sanity_val_steps": 0,
        },
        parser_kwargs={"description": DESCRIPTION, "prog": "bpnp", "allow_abbrev": False},
        args=arguments,
    )


def _quieten() -> None:
    """Third-party advice that does not apply here."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").addFilter(
        lambda record: "Tip:" not in record.getMessage()
    )
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Using `DistributedSampler` with the dataloaders.*")
    warnings.filterwarnings("ignore", message=".*Experiment logs directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", message=".*LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*smaller than the logging interval.*")
