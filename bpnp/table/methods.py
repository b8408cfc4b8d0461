"""How a method is named on the command line, and how its solver is built."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml
from torch import nn

from bpnp.files import packaged_config
from bpnp.models import TrainedNet
from bpnp.models.weights import checkpoint_path
from bpnp.table.pairs import build

SHORT_NAMES = {
    "softposit": "bpnp.models.baselines.SoftPOSIT",
    "ransac": "bpnp.models.baselines.RandomRansac",
    "gosma": "bpnp.models.baselines.GOSMA",
    "gopac": "bpnp.models.baselines.GOPAC",
    "constellation": "bpnp.models.baselines.Constellation",
    "hungarian": "bpnp.models.baselines.Hungarian",
    "bpnpnet": "bpnp.models.BPnPNet",
    "matcher": "bpnp.models.Matcher",
    "search": "bpnp.models.Search",
}

TRAINED = (SHORT_NAMES["bpnpnet"], SHORT_NAMES["matcher"])


@dataclass(frozen=True)
class Method:
    """A row group of the table: a solver's class, its settings, and the checkpoint of its weights."""

    label: str
    class_path: str
    init_args: dict[str, Any]
    checkpoint: str | None = None
    time_limit: float | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """All that the results depend on, as JSON has it; a checkpoint counts by its size and time too."""
        described = asdict(self)
        if self.checkpoint is not None:
            state = Path(self.checkpoint).stat()
            described["checkpoint_state"] = [state.st_size, int(state.st_mtime)]
        return dict(json.loads(json.dumps(described, default=str)))

    def build(self) -> nn.Module:
        """The solver in evaluation mode. Raises ValueError for settings that its class does not have."""
        if self.class_path in TRAINED and self.checkpoint is not None:
            return TrainedNet.from_checkpoint(self.checkpoint)
        given = self.init_args | ({} if self.checkpoint is None else {"checkpoint": self.checkpoint})
        solver: nn.Module = build(nn.Module, "solver", {"class_path": self.class_path, "init_args": given})
        if self.time_limit is not None and "time_limit" in vars(solver):
            vars(solver)["time_limit"] = self.time_limit
        return solver.eval()


def parse_methods(texts: Sequence[str], *, time_limit: float | None = None) -> list[Method]:
    """Methods from `[LABEL=]WHAT[@CHECKPOINT]`, WHAT a short name, a class path or a YAML file with a solver in it.

    Raises ValueError for what names no method, a missing checkpoint, or two methods of one label.
    """
    methods = [_parse(text, time_limit) for text in texts]
    labels = [method.label for method in methods]
    doubled = next((label for label in labels if labels.count(label) > 1), None)
    if doubled is not None:
        raise ValueError(f"expected a label for each method, got {doubled!r} twice; try LABEL=METHOD")
    return methods


def _parse(text: str, time_limit: float | None) -> Method:
    label, equals, what = text.partition("=")
    what = what if equals else text
    what, at, checkpoint = what.partition("@")
    class_path, init_args = _solver(what, text)
    return Method(
        label=label if equals else Path(what).stem if what.endswith(".yaml") else what.rpartition(".")[2],
        class_path=class_path,
        init_args=init_args,
        checkpoint=str(checkpoint_path(checkpoint)) if at else None,
        time_limit=time_limit,
    )


def _solver(what: str, text: str) -> tuple[str, dict[str, Any]]:
    if what in SHORT_NAMES:
        return SHORT_NAMES[what], {}
    what = packaged_config(what)
    if what.endswith((".yaml", ".yml")):
        if not Path(what).is_file():
            raise FileNotFoundError(f"expected a recipe with a solver, got no file {what}")
        content = yaml.safe_load(Path(what).read_text(encoding="utf-8"))
        solver = ((content or {}).get("model") or {}).get("solver")
        if isinstance(solver, str):
            return solver, {}
        if not isinstance(solver, dict) or "class_path" not in solver:
            raise ValueError(f"expected model.solver.class_path in {what}, got none")
        return solver["class_path"], solver.get("init_args") or {}
    if "." in what:
        return what, {}
    raise ValueError(
        f"expected a method among {', '.join(SHORT_NAMES)}, a class path or a .yaml file, got {text!r}"
    )  # fmt: skip
