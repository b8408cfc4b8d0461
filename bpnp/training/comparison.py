"""`bpnp table`: methods as they are named on the command line, and a `Trainer.test` of each on the same problems."""

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
ORDER_SEED = 0  # of the order in which `--limit` takes problems: the same for every method, and longer tables only add


@dataclass(frozen=True)
class Method:
    """A row group of the table: a solver's class, its settings, and the checkpoint of its weights."""

    label: str
    class_path: str
    init_args: dict[str, Any]
    checkpoint: str | None = None
    time_limit: float | None = None

    @property
    def folder_name(self) -> str:
        """The label as the name of a folder."""
        return re.sub(r"[^\w.-]", "-", self.label)

    @property
    def identity(self) -> dict[str, Any]:
        """All that the results depend on, as JSON has it; a checkpoint counts by its size and time too."""
        described = asdict(self)
        if self.checkpoint is not None:
            state = Path(self.checkpoint).stat()
            described["checkpoint_state"] = [state.st_size, int(state.st_mtime)]
        return dict(plain(described))

    @property
    def settings(self) -> dict[str, Any]:
        """The class and all arguments of its constructor."""
        init_args = self.init_args | ({} if self.checkpoint is None else {"checkpoint": self.checkpoint})
        return {"class_path": self.class_path, "init_args": init_args}

    def build(self) -> nn.Module:
        """The solver in evaluation mode. Raises ValueError for settings that its class does not have."""
        if self.class_path in TRAINED and self.checkpoint is not None:
            return TrainedNet.from_checkpoint(self.checkpoint)
        solver: nn.Module = build(nn.Module, "solver", self.settings)
        if self.time_limit is not None and "time_limit" in vars(solver):
            vars(solver)["time_limit"] = self.time_limit
        return solver.eval()


def parse_methods(texts: Sequence[str], *, time_limit: float | None = None) -> list[Method]:
    """Methods from `[LABEL=]WHAT[@CHECKPOINT]`, WHAT a short name, a class path or a YAML file with a solver in it.

    Raises ValueError for what names no method, settings that it does not have, a missing checkpoint, a label that is no
    name of a folder, or two methods whose folders would be the same.
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
            raise ValueError(f"expected a label for each method, got {label!r} twice; try LABEL=METHOD")
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
            raise ValueError(f"expected model.solver.class_path in {what}, got none")
        return solver["class_path"], solver.get("init_args") or {}
    if "." in what:
        return what, {}
    raise ValueError(f"expected a method among {', '.join(SHORT_NAMES)}, a class path or a .yaml file, got {text!r}")


def read_data(recipe: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """`data` of a recipe's YAML with `--data.NAME=VALUE` overrides, as class_path and all init_args.

    Raises ValueError for a file without it, for a class that cannot be imported, or for what it does not accept.
    """
    data = _recipe(recipe, "`data`").get("data")
    if not data:
        raise ValueError(f"expected `data` in {recipe}, got none; try --data psb")
    settings = data if isinstance(data, dict) else {"class_path": data}
    return dict(_parse_settings(LightningDataModule, "data", settings, overrides)[1].as_dict()["data"])


def _recipe(path: Path, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(
            f"expected a recipe with {what}, got no file {path}; try the name of a packaged one, such as psb"
        )
    return config_content(path)


@dataclass(frozen=True)
class MethodTest:
    """A test of one method on one data set, into a folder; limit: problems, None for all."""

    method: Method
    data: dict[str, Any]
    folder: Path
    limit: int | None = None

    def results(self) -> Results | None:
        """The results that are there, of the wanted problems; None unless the test of all of these was finished.

        Raises ValueError if the folder holds results of another method or of other data.
        """
        if not (self.folder / SUMMARY).is_file():
            return None
        results = read_results(self.folder)
        wanted = plain({"method": self.method.identity, "data": self.data})
        other = [key for key, value in wanted.items() if results.settings.get(key) != value]
        if other:
            raise ValueError(
                f"expected {self.folder} without results of other settings, got other {', '.join(other)}; try another "
                "--output"
            )
        chosen = set(problem_order(results.settings.get("size", 0))[: self.limit])
        rows = tuple(row for row in results.rows if row.index in chosen)
        if not results.settings.get("complete") or len({row.index for row in rows}) < max(len(chosen), 1):
            return None
        return replace(results, rows=rows, estimates=summarise(rows))

    def run(self, *, progress_bar: bool = False) -> None:
        """`test` the problems, each alone in its batch, so that its time is known; results go into the folder.

        Raises ValueError for a method that gives no pose."""
        module = build(LightningDataModule, "data", self.data)
        module.setup("test")
        loader = module.test_dataloader()
        if not isinstance(loader.sampler, DistributedSampler):
            raise ValueError(
                f"expected a data module of bpnp, whose problems can be chosen, got {self.data['class_path']}; try "
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
        messages.setLevel(logging.WARNING)
        torch.set_num_threads(1)
        torch.manual_seed(0)  # of a network without a checkpoint
        callbacks: list[Callback] = [writer] if progress_bar else [writer, ProgressLines()]
        trainer = Trainer(
            accelerator="cpu", devices=1, callbacks=callbacks, logger=False, enable_checkpointing=False,
            enable_progress_bar=progress_bar, enable_model_summary=False,
        )  # fmt: skip
        try:
            with raise_on_interrupt(trainer):
                trainer.test(BlindPnPTask(self.method.build()), loader, verbose=False)
        finally:
            messages.setLevel(level)
            torch.set_num_threads(threads)
        if not writer.rows:
            raise ValueError(f"expected a pose from {self.method.label!r}, got predictions without one")


def problem_order(size: int) -> list[int]:
    """The fixed random order in which a limited table takes the problems of a data set of this size."""
    return np.random.default_rng(ORDER_SEED).permutation(size).tolist()


def build(base: type, name: str, settings: Mapping[str, Any]) -> Any:
    """A subclass of `base`. Raises ValueError for settings that its class does not accept, and as its constructor."""
    parser, chosen = _parse_settings(base, name, settings)
    instantiate = parser.instantiate if hasattr(parser, "instantiate") else parser.instantiate_classes  # by release
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
            f"expected {settings.get('class_path')} as a {base.__name__} and arguments of its own, got: {error}"
        ) from error
