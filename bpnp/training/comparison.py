"""Methods of `bpnp table`, as named on the command line, and a `Trainer.test` of each on the same problems."""

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jsonargparse import ArgumentParser, Namespace
from lightning import Callback, LightningDataModule, Trainer
from torch import nn
from torch.utils.data import DataLoader, DistributedSampler

from bpnp.files import config_content, packaged_config
from bpnp.models import TrainedNet
from bpnp.models.weights import checkpoint_path
from bpnp.report.results import SUMMARY, Results, plain, read_results, summarise
from bpnp.training.callbacks import ProgressLines, ResultsWriter
from bpnp.training.checkpoints import raise_on_interrupt
from bpnp.training.task import BlindPnPTask

SHORT_NAMES = {
    "softposit": "bpnp.models.baselines.SoftPOSIT",
    "ransac": "bpnp.models.baselines.RandomRansac",
    "gosma": "bpnp.models.baselines.GOSMA",
    "gopac": "bpnp.models.baselines.GOPAC",
    "hungarian": "bpnp.models.baselines.Hungarian",
    "bpnpnet": "bpnp.models.BPnPNet",
    "matcher": "bpnp.models.Matcher",
    "search": "bpnp.models.Search",
}
TRAINED = (SHORT_NAMES["bpnpnet"], SHORT_NAMES["matcher"])
ORDER_SEED = 0  # seed of the order in which `--limit` takes problems, equal for all methods and limits


@dataclass(frozen=True)
class Method:
    """Method of the table: a solver's class, its settings, and the checkpoint of its weights."""

    label: str
    class_path: str
    init_args: dict[str, Any]
    checkpoint: str | None = None
    time_limit: float | None = None  # seconds for each problem, for solvers with a limit

    @property
    def folder_name(self) -> str:
        """Label as the name of a folder."""
        return re.sub(r"[^\w.-]", "-", self.label)

    @property
    def identity(self) -> dict[str, Any]:
        """Everything that the results depend on, as JSON; a checkpoint counts with its size and time."""
        identity = asdict(self)
        if self.checkpoint is not None:
            state = Path(self.checkpoint).stat()
            identity["checkpoint_state"] = [state.st_size, int(state.st_mtime)]
        return dict(plain(identity))

    @property
    def settings(self) -> dict[str, Any]:
        """Class and all arguments of its constructor."""
        init_args = self.init_args | ({} if self.checkpoint is None else {"checkpoint": self.checkpoint})
        return {"class_path": self.class_path, "init_args": init_args}

    def build(self) -> nn.Module:
        """Build the solver in evaluation mode; raise ValueError if its class does not have a setting."""
        if self.class_path in TRAINED and self.checkpoint is not None:
            return TrainedNet.from_checkpoint(self.checkpoint)
        solver: nn.Module = build(nn.Module, "solver", self.settings)
        if self.time_limit is not None and "time_limit" in vars(solver):
            vars(solver)["time_limit"] = self.time_limit
        return solver.eval()


def parse_methods(texts: Sequence[str], *, time_limit: float | None = None) -> list[Method]:
    """Parse methods from `[LABEL=]WHAT[@CHECKPOINT]`, WHAT a short name, a class path, or a YAML file with a solver.

    The time limit is in seconds for each problem. Raise ValueError if a text names no method, a setting does not exist,
    a label cannot name a folder, or two methods have the same folder, and FileNotFoundError if a checkpoint or a
    configuration is missing.
    """
    methods: dict[str, Method] = {}
    for text in texts:
        label, equals, what = text.partition("=")
        what, at, checkpoint = (what if equals else text).partition("@")
        class_path, init_args = _solver(what, text)
        if not equals:
            label = Path(what).stem if what.endswith(".yaml") else what.rpartition(".")[2]
        weights = str(checkpoint_path(checkpoint)) if at else None
        method = Method(label, class_path, init_args, weights, time_limit)
        if not method.folder_name.strip("."):
            raise ValueError(f"the label {label!r} of {text!r} cannot name a folder of results. Use LABEL=METHOD.")
        if method.folder_name in methods:
            raise ValueError(f"two methods have the label {label!r}; use LABEL=METHOD")
        methods[method.folder_name] = method
        if class_path not in TRAINED or weights is None:
            _parse_settings(nn.Module, "solver", method.settings)  # before any test runs
    return list(methods.values())


def _solver(what: str, text: str) -> tuple[str, dict[str, Any]]:
    if what in SHORT_NAMES:
        return SHORT_NAMES[what], {}
    what = packaged_config(what)
    if what.endswith((".yaml", ".yml")):
        solver = (_recipe(Path(what), "a solver").get("model") or {}).get("solver")
        solver = {"class_path": solver} if isinstance(solver, str) else solver
        if not isinstance(solver, dict) or "class_path" not in solver:
            raise ValueError(f"{what} has no model.solver.class_path")
        return solver["class_path"], solver.get("init_args") or {}
    if "." in what:
        return what, {}
    raise ValueError(f"{text!r} is no method; give one of {', '.join(SHORT_NAMES)}, a class path or a .yaml file")


def read_data(recipe: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Read `data` of a configuration with `--data.NAME=VALUE` overrides, as class_path and all init_args.

    Raise ValueError if the file has no `data`, its class cannot be imported, or it does not accept an option.
    """
    data = _recipe(recipe, "`data`").get("data")
    if not data:
        raise ValueError(f"{recipe} has no `data`; try --data psb")
    settings = data if isinstance(data, dict) else {"class_path": data}
    return dict(_parse_settings(LightningDataModule, "data", settings, overrides)[1].as_dict()["data"])


def _recipe(path: Path, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no file {path}; give a configuration with {what}, or the name of a packaged one, such as psb"
        )
    return config_content(path)


@dataclass(frozen=True)
class MethodTest:
    """Test of one method on one data set."""

    method: Method
    data: dict[str, Any]  # class path and arguments of the data
    folder: Path
    limit: int | None = None  # number of problems, None for all

    def results(self) -> Results | None:
        """Return the existing results of the requested problems, or None unless the test of all of them was finished.

        Raise ValueError if the folder holds results of another method or of other data.
        """
        if not (self.folder / SUMMARY).is_file():
            return None
        results = read_results(self.folder)
        expected = plain({"method": self.method.identity, "data": self.data})
        other = [key for key, value in expected.items() if results.settings.get(key) != value]
        if other:
            raise ValueError(f"{self.folder} has results of another {' and '.join(other)}; use another --output")
        chosen = set(problem_order(results.settings.get("size", 0))[: self.limit])
        rows = tuple(row for row in results.rows if row.index in chosen)
        if not results.settings.get("complete") or len({row.index for row in rows}) < max(len(chosen), 1):
            return None
        return replace(results, rows=rows, estimates=summarise(rows))

    def run(self, *, progress_bar: bool = False) -> None:
        """Test the problems, each alone in its batch, so that its time is measured; write the results to the folder.

        Without a progress bar, lines are printed. Raise ValueError if the data module is not of bpnp, or the method
        returns no pose.
        """
        module = build(LightningDataModule, "data", self.data)
        module.setup("test")
        loader = module.test_dataloader()
        if not isinstance(loader.sampler, DistributedSampler):
            raise ValueError(
                f"the problems of {self.data['class_path']} cannot be chosen, as those of bpnp's data modules can; use "
                "`bpnp test` for each method, and `bpnp report` with their folders"
            )
        size = len(loader.dataset)
        chosen = [[(0, i)] for i in problem_order(size)[: self.limit]]
        loader = DataLoader(loader.dataset, sampler=chosen, batch_size=None)
        writer = ResultsWriter(str(self.folder))
        writer.settings = {
            "solver": {"class_path": self.method.class_path, "init_args": self.method.init_args},
            "data": self.data, "checkpoint": self.method.checkpoint, "method": self.method.identity, "size": size,
        }  # fmt: skip
        messages = logging.getLogger("lightning.pytorch")
        level, threads = messages.level, torch.get_num_threads()
        callbacks: list[Callback] = [writer] if progress_bar else [writer, ProgressLines()]
        try:
            messages.setLevel(logging.WARNING)
            torch.set_num_threads(1)
            torch.manual_seed(0)  # for the weights of a network without a checkpoint
            trainer = Trainer(
                accelerator="cpu", devices=1, callbacks=callbacks, logger=False, enable_checkpointing=False,
                enable_progress_bar=progress_bar, enable_model_summary=False,
            )  # fmt: skip
            with raise_on_interrupt(trainer):
                trainer.test(BlindPnPTask(self.method.build()), loader, verbose=False)
        finally:
            messages.setLevel(level)
            torch.set_num_threads(threads)
        if not writer.tested[0].rows:
            raise ValueError(f"the predictions of {self.method.label!r} have no pose")


def problem_order(size: int) -> list[int]:
    """Return the fixed random order in which a limited table takes the problems of a data set of this size."""
    return np.random.default_rng(ORDER_SEED).permutation(size).tolist()


def build(base: type, name: str, settings: Mapping[str, Any]) -> Any:
    """Build an instance of a subclass of `base`; raise ValueError, with the option's name, for wrong settings."""
    parser, chosen = _parse_settings(base, name, settings)
    # The name of the method depends on the release of jsonargparse.
    instantiate = parser.instantiate if hasattr(parser, "instantiate") else parser.instantiate_classes
    return instantiate(chosen)[name]


def _parse_settings(
    base: type, name: str, settings: Mapping[str, Any], overrides: Sequence[str] = ()
) -> tuple[ArgumentParser, Namespace]:
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(base, name)
    try:
        return parser, parser.parse_args([f"--{name}={json.dumps(settings)}", *overrides])
    except Exception as error:
        raise ValueError(
            f"{settings.get('class_path')} is no {base.__name__}, or does not accept its arguments: {error}"
        ) from error
