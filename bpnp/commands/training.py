"""`bpnp fit`, `validate`, `test` and `predict`: Lightning's command line with the run folder of this project.

The network is that of the checkpoint: the description in `--ckpt_path` or `--model.weights` gives the defaults of
`model.solver`. Options that a configuration leaves out are those of the checkpoint, and `BlindPnPTask` rejects options
that contradict it. A training that is resumed has all its options of the model from the checkpoint, and its pose loss,
but for those that the command names.
"""

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from inspect import signature
from itertools import pairwise
from pathlib import Path
from pydoc import locate
from typing import Any

import yaml
from jsonargparse import Namespace, get_loader, set_loader
from lightning import Callback, LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelSummary, ProgressBar, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from lightning.pytorch.utilities.types import LRSchedulerTypeUnion
from torch.optim import Optimizer
from yaml import YAMLError

import bpnp.datamodules
from bpnp.bounded_files import check_yaml
from bpnp.checks import check_within
from bpnp.commands.parser import OneLineParser
from bpnp.files import config_content, lock_folder, write_text
from bpnp.models.bpnpnet import BPnPNet
from bpnp.models.weights import PARTS, class_name, is_description, networks, read_checkpoint
from bpnp.report.terminal import console, say
from bpnp.report.training_run import training_of_checkpoint, wandb_run
from bpnp.training.callbacks import WARMUP, ParameterCount, PoseLossWarmup, ProgressLines, ResultsWriter
from bpnp.training.checkpoints import (
    BestCheckpoint,
    InterruptedCheckpoint,
    LastCheckpoint,
    SafeCheckpointIO,
    newest_checkpoint,
    raise_on_interrupt,
)
from bpnp.training.loggers import TrainingRunLogger, record_wandb_run
from bpnp.training.predictions import PredictionWriter
from bpnp.training.task import PACKAGED_LOSSES, BlindPnPTask

DEFAULT_ROOT = "runs/default"
YAML_VALUE = get_loader("yaml")  # jsonargparse's own

POSE_LOSS: dict[str, tuple[type, str]] = {
    "start_epoch": (int, "first epoch with the pose loss, counted from 0; null for no switch"),
    "weight": (float, "gamma_p of the paper after the switch; null for that of the model, or 1"),
}

UNTRAINED = (
    "The network is untrained (no --ckpt_path, no --model.weights); a search such as `refined` can do without it."
)

CHECKPOINTS = {"best_checkpoint": BestCheckpoint, "last_checkpoint": LastCheckpoint}


class _Parser(OneLineParser, LightningArgumentParser):
    """Lightning's parser with errors of one line."""


class LimitedTrainer(Trainer):
    """Lightning's Trainer, whose limits are a number of batches (int) or a fraction of them (float), 1 for one batch.

    `typing` may give Lightning's annotation Optional[Union[int, float]] as an equal Optional[Union[float, int]] that it
    has in its cache. The parser then reads a limit of 1 as 1.0, all batches. An annotation with bars is not cached.

    Args:
        limit_train_batches: Number or fraction of the training batches of an epoch. Default: all.
        limit_val_batches: Number or fraction of the validation batches. Default: all.
        limit_test_batches: Number or fraction of the test batches. Default: all.
        limit_predict_batches: Number or fraction of the batches of a prediction. Default: all.
        **kwargs: Other options of the Trainer.
    """

    def __init__(
        self,
        *,
        limit_train_batches: int | float | None = None,
        limit_val_batches: int | float | None = None,
        limit_test_batches: int | float | None = None,
        limit_predict_batches: int | float | None = None,
        **kwargs: Any,
    ) -> None:
        check_within(1, math.inf, accumulate_grad_batches=kwargs.get("accumulate_grad_batches", 1))
        super().__init__(
            limit_train_batches=limit_train_batches,
            limit_val_batches=limit_val_batches,
            limit_test_batches=limit_test_batches,
            limit_predict_batches=limit_predict_batches,
            **kwargs,
        )


class RunConfig(SaveConfigCallback):
    """Write the configuration into the numbered folder of the CSV log, and log it to the other loggers.

    The W&B run of a training is recorded in the same folder.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs | {"save_to_log_dir": False})

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write the configuration as YAML, and log its main options."""
        numbered = [logger.log_dir for logger in trainer.loggers if isinstance(logger, CSVLogger)]
        name = "config.yaml" if numbered or stage == "fit" else f"config-{stage}.yaml"
        text = self.parser.dump(self.config, skip_none=False)
        write_text(Path(numbered[0] if numbered else trainer.default_root_dir) / name, text)
        content = self.config.as_dict()
        wanted = ("data", "optimizer", "lr_scheduler", "seed_everything", "ckpt_path")
        options = {key: content[key] for key in wanted if content.get(key) is not None}
        given = content["trainer"]
        options["trainer"] = {key: given[key] for key in ("max_epochs", "precision", "gradient_clip_val")}
        for logger in trainer.loggers:
            if not isinstance(logger, CSVLogger):
                logger.log_hyperparams(options)
            if isinstance(logger, WandbLogger) and numbered and stage == "fit":
                record_wandb_run(logger, Path(numbered[0]))


class Bar(RichProgressBar):
    """Progress bar without the number of the log folder, which it would show as `v_num: 0.000`."""

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Return the logged values."""
        return {name: value for name, value in super().get_metrics(trainer, pl_module).items() if name != "v_num"}


class BpnpCLI(LightningCLI):
    """Lightning's CLI with the run folder of this project: checkpoints, logs and results in trainer.default_root_dir.

    The context managers `held` end after the run.
    """

    resumed: Mapping[str, Any] = {}  # checkpoint of the training that is resumed

    def __init__(self, command: str, held: ExitStack, *args: Any, **kwargs: Any) -> None:
        self.command, self.held = command, held
        super().__init__(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out open context managers, because `ddp_spawn` pickles the parser, which refers to the CLI."""
        return self.__dict__ | {"held": None}

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """Return only the command that is run, because building the parser of each takes a second."""
        return {self.command: super().subcommands()[self.command]}

    def init_parser(self, **kwargs: Any) -> LightningArgumentParser:
        """Return the parser with `--config`."""
        parser = _Parser(**kwargs)
        parser.add_argument("-c", "--config", action="config", help="configuration file, or the name of a packaged one")
        return parser

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the options of the callbacks and of the pose loss, and this project's defaults."""
        self.options = parser
        for name, callback in CHECKPOINTS.items():
            parser.add_lightning_class_args(callback, name)
        parser.add_lightning_class_args(ResultsWriter, "results")
        parser.add_lightning_class_args(PredictionWriter, "predictions")
        for name, (kind, meaning) in POSE_LOSS.items():
            parser.add_argument(f"--pose_loss.{name}", type=kind | None, default=None, help=meaning)
        parser.set_defaults(
            {
                "trainer.default_root_dir": DEFAULT_ROOT,
                "best_checkpoint.monitor": "val/rotation_q2_deg" if self.subclass_mode_model else "val/pose_error",
                "best_checkpoint.filename": "best",
                "best_checkpoint.enable_version_counter": False,
                "last_checkpoint.filename": "last",
                "last_checkpoint.enable_version_counter": False,
            }
        )
        for name in CHECKPOINTS:
            parser.link_arguments("trainer.default_root_dir", f"{name}.dirpath", compute_fn=_checkpoint_folder)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse the arguments; options of `model.solver` that are not given are those of the checkpoint."""
        if self.command == "test":
            self.options.set_defaults({"verbose": False})  # disable Lightning's table of all metrics
        elif self.command == "predict":
            self.options.set_defaults({"return_predictions": False})  # PredictionWriter writes them
        words = [word for word in args if not word.startswith("--print_config")]
        # Options of a part need a class of the solver, which may be that of the checkpoint; its parts are then read.
        network = [] if self.subclass_mode_model else [f"--model.solver={BPnPNet.__module__}.{BPnPNet.__qualname__}"]
        self.config = parser.parse_args([self.command, *network, *words[1:]])
        config = self.config[self.command]
        path = config.get("ckpt_path")
        folder = Path(_checkpoint_folder(config["trainer.default_root_dir"]))
        if path == "last":
            path = str(newest_checkpoint(folder))
        elif path == "best" and (folder / "best.ckpt").is_file():
            path = str(folder / "best.ckpt")
        named = config.get("model.class_path")
        options = "model" if named is None else "model.init_args"
        weights = path or config.get(f"{options}.weights")
        saved: dict[str, Any] = {}
        if weights and (named is None or issubclass(_find_class(named), BlindPnPTask)):
            content = read_checkpoint(weights)
            self.resumed = content if path and self.command == "fit" else {}
            saved = _model_options(weights, content, self.resumed.get("task", {}), config["model"])
        if saved:
            if network and "solver" in saved:
                network = [f"--model.solver={saved['solver']['class_path']}"]
            root = f"--trainer.default_root_dir={config['trainer.default_root_dir']}"  # other options refer to it
            given = parser.parse_args([self.command, root, *network, *words[1:]], defaults=False)[self.command]
            chosen = given.get(f"{options}.solver")
            kept = {name: value for name, value in saved.items() if f"{options}.{name}" not in given}
            if "solver" in saved:
                kept["solver"] = _with_options(
                    saved["solver"], chosen.as_dict() if isinstance(chosen, Namespace) else chosen
                )
            args = [self.command, *network, *args[1:], *(f"--model.{name}={_as_yaml(kept[name])}" for name in kept)]
        self.config = parser.parse_args(args)
        config = self.config[self.command]
        config["ckpt_path"] = path
        joined = self.command == "test" or (self.command == "fit" and _is_in(path, folder))
        for logger in _as_list(config.get("trainer.logger")):
            _log_in(logger, config["trainer.default_root_dir"])
            if joined and path is not None and Path(path).is_file():
                join_training(logger, path, self.command)

    def before_instantiate_classes(self) -> None:
        """Merge `--pose_loss` into the `PoseLossWarmup` of the configuration, or add one.

        Raise ValueError for a weight without an epoch, or a schedule without an optimizer.
        """
        given = self.config[self.command]
        if given.get("lr_scheduler") is not None and given.get("optimizer") is None:
            raise ValueError(
                "--lr_scheduler needs --optimizer, such as --optimizer Adam --optimizer.lr 1e-4. Without both, "
                "--model.warmup_steps and --model.decay_start are a schedule."
            )
        options = {name: value for name, value in vars(given["pose_loss"]).items() if value is not None}
        trainer = given["trainer"]
        if (joined := self.resumed.get("callbacks", {}).get(WARMUP)) is not None and not _has_switch(trainer.callbacks):
            options = {name: joined[name] for name in POSE_LOSS} | options
        if not options:
            return
        callbacks = trainer.callbacks or []
        trainer.callbacks = list(callbacks) if isinstance(callbacks, list) else [callbacks]
        for callback in trainer.callbacks:
            if _has_switch(callback):
                callback.init_args.update(Namespace(**options))
                return
        if "start_epoch" not in options:
            raise ValueError(
                "--pose_loss.weight needs --pose_loss.start_epoch, the first epoch with the pose loss. "
                "Use --model.pose_weight for a pose loss in all epochs."
            )
        path = f"{PoseLossWarmup.__module__}.{PoseLossWarmup.__name__}"
        settings = Namespace(start_epoch=options["start_epoch"], weight=options.get("weight"))
        trainer.callbacks.append(Namespace(class_path=path, init_args=settings))

    @staticmethod
    def configure_optimizers(
        lightning_module: LightningModule, optimizer: Optimizer, lr_scheduler: LRSchedulerTypeUnion | None = None
    ) -> Any:
        """Use `--optimizer` and `--lr_scheduler`; without the latter, the schedule of the task."""
        if isinstance(lightning_module, BlindPnPTask):
            rates = ", ".join(f"{group['lr']:g}" for group in optimizer.param_groups)
            rank_zero_info(
                f"{type(optimizer).__name__} with learning rate {rates}; model.learning_rate and model.weight_decay "
                f"are not used{', and no schedule of the model' if lr_scheduler is not None else ''}"
            )
            if lr_scheduler is None:
                return lightning_module.with_schedule(optimizer)
        return LightningCLI.configure_optimizers(lightning_module, optimizer, lr_scheduler)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Add a CSV log and safe checkpoints; show progress as a bar in a terminal, else as one line per epoch."""
        options = self.config_init[self.command]["trainer"]
        root = options["default_root_dir"]
        callbacks: list[Callback] = [InterruptedCheckpoint(_checkpoint_folder(root))]
        bar = options["enable_progress_bar"] is not False and console().is_interactive
        if not any(isinstance(callback, ProgressBar) for callback in _as_list(options["callbacks"])):
            callbacks.append(Bar() if bar else ProgressLines())
            kwargs["enable_progress_bar"] = bar
        own = any(isinstance(callback, ModelSummary) for callback in _as_list(options["callbacks"]))
        if options["enable_model_summary"] is None and not own:  # Lightning's ends with "Total FLOPs: 0"
            callbacks.append(ParameterCount())
            kwargs["enable_model_summary"] = False
        self.trainer_defaults["callbacks"] = callbacks
        if options["enable_checkpointing"] is False:
            self.options.callback_keys = [key for key in self.options.callback_keys if key not in CHECKPOINTS]
        # Not a default of the trainer: an object among the defaults could not be written to config.yaml.
        kwargs["plugins"] = [*_as_list(options["plugins"]), SafeCheckpointIO()]
        chosen = options["logger"]
        loggers = [logger for logger in _as_list(chosen) if isinstance(logger, Logger)]
        if chosen is not False and not any(isinstance(logger, CSVLogger) for logger in loggers):
            loggers = [*loggers, CSVLogger(root, name="logs")]
        return super().instantiate_trainer(**{"logger": loggers} | kwargs)

    def after_instantiate_classes(self) -> None:
        """Let Ctrl-C end the run as it ends other commands."""
        self.held.enter_context(raise_on_interrupt(self.trainer))

    def before_fit(self) -> None:
        """Lock the run folder; raise ValueError if another process has, or a training would be overwritten."""
        root = Path(self.trainer.default_root_dir)
        if self.trainer.fast_dev_run or self.trainer.global_rank != 0:  # type: ignore[attr-defined]
            return
        self.held.enter_context(lock_folder(root))
        folder, path = Path(_checkpoint_folder(str(root))), self.config[self.command]["ckpt_path"]
        if not _is_in(path, folder) and any(folder.glob("*.ckpt")):
            raise ValueError(
                f"{root} holds a training. Continue it with --ckpt_path last, or set --trainer.default_root_dir to "
                "another folder."
            )

    def after_fit(self) -> None:
        """Print the paths of the checkpoints."""
        for path in sorted(Path(_checkpoint_folder(self.trainer.default_root_dir)).glob("*.ckpt")):
            if self.trainer.is_global_zero and not self.trainer.fast_dev_run:  # type: ignore[attr-defined]
                say(f"wrote {path}")

    def before_validate(self) -> None:
        """Warn if the weights are untrained."""
        config = self.config[self.command]
        options = "model" if config.get("model.class_path") is None else "model.init_args"
        trained = re.search("checkpoint|pretrained", str(config.get(f"{options}.solver")))
        weights = config["ckpt_path"] or config.get(f"{options}.weights") or trained
        if not weights and list(self.model.parameters()):
            sys.stderr.write("bpnp: no --ckpt_path: the weights of the solver are untrained\n")
            for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, ResultsWriter):
                    callback.note = UNTRAINED

    before_test = before_predict = before_validate

    def after_test(self) -> None:
        """Raise ValueError if there was nothing to test, since Lightning does not report it."""
        if not sum(self.trainer.num_test_batches):
            raise ValueError(f"{type(self.datamodule).__name__} has no problems to test on.")


def _model_options(path: str, content: Mapping[str, Any], task: Mapping[str, Any], model: Namespace) -> dict[str, Any]:
    """Return the solver and the task that a checkpoint describes as options: classes by their paths and arguments.

    Classes are those of this package and those that the options of the model name; the checkpoint imports nothing.
    """
    named = [_find_class(name) for name in _class_paths(model.as_dict())]
    classes = {class_name(cls): cls for cls in (*networks(), *PARTS, *PACKAGED_LOSSES, *named)}

    def options_of(value: Any) -> Any:
        if not is_description(value):
            return value
        if value["class"] not in classes:
            raise ValueError(
                f"{path} has a {value['class']}, which is not a class of bpnp. Name it in the configuration, such as "
                "with --config and the config.yaml of its training."
            )
        cls, settings = classes[value["class"]], value["settings"] or {}
        arguments = {key: options_of(each) for key, each in settings.items()}
        return {"class_path": f"{cls.__module__}.{cls.__qualname__}", "init_args": arguments}

    descriptions = {"solver": content["solver"]} if is_description(content.get("solver")) else {}
    return {name: options_of(value) for name, value in {**descriptions, **task}.items()}


def _as_yaml(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=math.inf).removesuffix("...\n").strip()


def _has_switch(callbacks: Any) -> bool:
    """Return True if a `PoseLossWarmup` is among configured callbacks."""
    return any(issubclass(_find_class(each.class_path), PoseLossWarmup) for each in _as_list(callbacks))


def _with_options(saved: Any, given: Any) -> Any:
    """Return the options of a part of a checkpoint, changed by those that are given; of another class, only these."""
    if not isinstance(saved, Mapping) or "class_path" not in saved:
        return given
    if given is None:
        return saved
    if _find_class(given["class_path"]) is not _find_class(saved["class_path"]):
        return given
    arguments = given.get("init_args", {})
    changed = {key: _with_options(saved["init_args"].get(key), value) for key, value in arguments.items()}
    return {**saved, "init_args": saved["init_args"] | changed}


def _class_paths(options: Any) -> Iterator[str]:
    """Yield all class paths in options of any depth."""
    if isinstance(options, Mapping):
        if isinstance(options.get("class_path"), str):
            yield options["class_path"]
        for value in options.values():
            yield from _class_paths(value)


def _find_class(class_path: str) -> type[Any]:
    """Return the class of a path that the parser has accepted."""
    located = locate(class_path)
    return located if isinstance(located, type) else object


def _log_in(logger: Any, root: str) -> None:
    """Set the folder of a configured logger to that of the run where it is still the working directory."""
    if isinstance(logger, Namespace) and "save_dir" in logger.get("init_args", {}):
        option = signature(_find_class(logger.class_path)).parameters.get("save_dir")
        if logger.init_args.save_dir in (None, "." if option is None else option.default):
            logger.init_args.save_dir = root


def join_training(logger: Any, checkpoint: str, command: str) -> None:
    """Let a WandbLogger log into the W&B run of the training of a checkpoint, and print that.

    The configuration of the logger is changed in place; one that names another id, project or entity has a run of its
    own. The command is `fit`, to continue the training, or `test`.
    """
    if not isinstance(logger, Namespace) or _find_class(logger.class_path) is not WandbLogger:
        return
    folder, options = training_of_checkpoint(checkpoint), logger.init_args
    run = None if folder is None else wandb_run(folder)
    if run is None or options.version or any(options.get(key) not in (None, name) for key, name in run.items()):
        return
    options.update(Namespace(**run, resume="allow", name=None))  # otherwise the parser passes resume=None
    if command == "test":
        logger.class_path = f"{TrainingRunLogger.__module__}.{TrainingRunLogger.__qualname__}"
        options.step = read_checkpoint(checkpoint)["global_step"]
    what = "results" if command == "test" else "next steps"
    rank_zero_info(
        f"W&B: the {what} go into run {run['id']} of the training in {folder}; set --trainer.logger.id to a new name "
        "for a run of their own"
    )


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _checkpoint_folder(root: str) -> str:
    return str(Path(root) / "checkpoints")


def _is_in(path: str | None, folder: Path) -> bool:
    return path is not None and Path(path).resolve().parent == folder.resolve()


def run_training(arguments: Sequence[str]) -> None:
    """Parse the arguments of fit, validate, test or predict, the command first, and run it.

    Raise ValueError if the options are wrong, or the training diverged.
    """
    set_loader("yaml", _load_bounded, (YAMLError,))
    for name in dir(bpnp.datamodules):  # import them all, so that --help lists them and short names are accepted
        getattr(bpnp.datamodules, name)
    # The parser reads null; in Python, and in the documentation of the options, it is None.
    arguments = [re.sub("(^|=)None$", r"\1null", word) for word in arguments]
    own_task = _names_a_task(arguments)
    with ExitStack() as held:
        BpnpCLI(
            arguments[0],
            held,
            LightningModule if own_task else BlindPnPTask,
            LightningDataModule,
            subclass_mode_model=own_task,
            subclass_mode_data=True,
            seed_everything_default=0,
            save_config_callback=RunConfig,
            trainer_class=LimitedTrainer,
            trainer_defaults={"max_epochs": 200, "num_sanity_val_steps": 0},
            parser_kwargs={"prog": "bpnp", "allow_abbrev": False},
            args=list(arguments),
        )


def _load_bounded(text: str) -> Any:
    """Return jsonargparse's value of a YAML text, of a file or an option, whose aliases stand for few values."""
    check_yaml(text)
    return YAML_VALUE(text)


def _names_a_task(arguments: Sequence[str]) -> bool:
    """Return True if the options or a configuration file name a LightningModule in place of BlindPnPTask."""
    words = [word for text in arguments for word in text.split("=", 1)]
    files = [Path(value) for name, value in pairwise(words) if name in ("-c", "--config")]
    models = [config_content(file).get("model") for file in files if file.is_file()]
    named = any(isinstance(model, str) or (isinstance(model, dict) and "class_path" in model) for model in models)
    return named or not {"--model", "--model.class_path"}.isdisjoint(words)
