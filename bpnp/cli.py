"""The command line: `bpnp fit|validate|test|predict` are Lightning's own, the others are typed functions."""

import difflib
import logging
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lightning import LightningDataModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from bpnp.commands import COMMANDS
from bpnp.commands.parser import OneLineParser, first_line, run_command
from bpnp.configs import config_names, packaged_config
from bpnp.files import claimed
from bpnp.training.plugins import InterruptedCheckpoint, SafeCheckpointIO, interruptible
from bpnp.training.results_writer import ResultsWriter
from bpnp.training.task import BlindPnPTask, TrainingDivergedError

LIGHTNING = {
    "fit": "Train a solver.",
    "validate": "Evaluate a solver on the validation pairs.",
    "test": "Evaluate a solver on the test pairs and write their results.",
    "predict": "Write the poses of pairs whose true pose need not be known.",
}


class _Parser(OneLineParser, LightningArgumentParser):
    """Lightning's parser with errors of one line."""


class BpnpCLI(LightningCLI):
    """Lightning's CLI with this project's run folder: checkpoints, logs and results under trainer.default_root_dir."""

    def init_parser(self, **kwargs: Any) -> LightningArgumentParser:
        parser = _Parser(**kwargs)
        parser.add_argument("-c", "--config", action="config", help="configuration file, or the name of a packaged one")
        return parser

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
            self.trainer_defaults["callbacks"] = [InterruptedCheckpoint()]
        # Not a default of the trainer: an object among the defaults could not be written to config.yaml.
        plugins = self._get(self.config_init, "trainer.plugins") or []
        own = [*(plugins if isinstance(plugins, list) else [plugins]), SafeCheckpointIO()]
        trainer = super().instantiate_trainer(**{"plugins": own} | kwargs)
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

    def _run_subcommand(self, subcommand: str) -> None:
        """In a run folder that no other training holds."""
        self._check_checkpoint(subcommand)
        training = subcommand == "fit" and self.trainer.global_rank == 0
        with claimed(Path(self.trainer.default_root_dir)) if training else nullcontext(), interruptible(self.trainer):
            super()._run_subcommand(subcommand)

    def _check_checkpoint(self, subcommand: str) -> None:
        """Raise ValueError for `--ckpt_path last` where there is none; warn if untrained weights are evaluated."""
        path = self._get(self.config, "ckpt_path")
        folder = Path(_checkpoint_folder(self.trainer.default_root_dir))
        if path == "last" and not list(folder.glob("last*.ckpt")):
            raise ValueError(f"expected a checkpoint for --ckpt_path last in {folder}, got none; try without it")
        trained = [name for name in ("checkpoint", "pretrained") if name in str(self._get(self.config, "model.solver"))]
        if subcommand != "fit" and path is None and not trained and any(True for _ in self.model.parameters()):
            print("bpnp: no --ckpt_path: the weights of the solver are untrained", file=sys.stderr)


def _checkpoint_folder(root: str) -> str:
    return str(Path(root) / "checkpoints")


def main(args: Sequence[str] | None = None) -> None:
    """Run a command. A mistake of the user's ends in one line on stderr and exit status 2, not in a traceback."""
    arguments = list(sys.argv[1:] if args is None else args)
    logging.captureWarnings(True)
    _quieten()
    try:
        _run(arguments)
    except (ValueError, OSError, TrainingDivergedError, MisconfigurationException) as error:
        if os.environ.get("BPNP_TRACEBACK"):
            raise
        # Names of files that are not UTF-8 reach us as surrogates, which a terminal cannot show.
        print(f"bpnp: error: {error}".encode("utf-8", "replace").decode(), file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("bpnp: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _run(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(help_text())
    elif arguments[0] == "--version":
        print(f"bpnp {version('bpnp')}")
    elif arguments[0] in LIGHTNING:
        _lightning(_with_packaged_configs(arguments))
    else:
        name, *rest = arguments
        command = COMMANDS[_known(name, [*LIGHTNING, *COMMANDS], "a command")]
        if isinstance(command, Mapping):
            if not rest or rest[0] in ("-h", "--help"):
                lines = (f"  {word:<14}{first_line(own)}" for word, own in command.items())
                print("\n".join([f"usage: bpnp {name} WHAT [options]", "", *lines]))
                return
            word, *rest = rest
            name, command = f"{name} {word}", command[_known(word, list(command), f"one of bpnp {name}")]
        run_command(name, command, rest)


def _known(name: str, names: Sequence[str], what: str) -> str:
    if name in names:
        return name
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}?" if close else f"try {', '.join(names)}"
    raise ValueError(f"expected {what}, got {name!r}; {hint}")


def help_text() -> str:
    """What `bpnp --help` shows: every command in a line."""
    own = {
        name: "Pack a data set, once: " + ", ".join(command) if isinstance(command, Mapping) else first_line(command)
        for name, command in COMMANDS.items()
    }
    lines = [f"  {name:<17}{text}" for name, text in (own | LIGHTNING).items()]
    return "\n".join(
        [
            "usage: bpnp COMMAND [options]",
            "",
            "Camera pose from 2D and 3D points that nobody has matched.",
            "",
            *lines,
            "",
            "bpnp COMMAND --help shows the options of a command, bpnp --version the version.",
            f"Packaged configurations, for --config: {', '.join(config_names())}.",
        ]
    )


def _with_packaged_configs(arguments: Sequence[str]) -> list[str]:
    """The arguments with the file in place of the name of a packaged configuration."""
    found = list(arguments)
    for i, text in enumerate(arguments):
        if text in ("-c", "--config") and i + 1 < len(arguments):
            found[i + 1] = packaged_config(arguments[i + 1])
        elif text.startswith("--config="):
            found[i] = f"--config={packaged_config(text.removeprefix('--config='))}"
    return found


def _lightning(arguments: list[str]) -> None:
    BpnpCLI(
        BlindPnPTask,
        LightningDataModule,
        subclass_mode_data=True,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
        trainer_defaults={
            "callbacks": [RichProgressBar(), InterruptedCheckpoint()],
            "max_epochs": 200,
            "num_sanity_val_steps": 0,
        },
        parser_kwargs={"prog": "bpnp", "allow_abbrev": False},
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
