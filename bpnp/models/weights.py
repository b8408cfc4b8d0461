"""Checkpoint files, read as data and never as code; packaged weights; and the networks of both.

A module is described by the name of its class and the arguments of its constructor. The module keeps each argument as
an attribute of the same name; an argument that is a module is described likewise. A description holds only dicts,
lists, tuples, strings and numbers. Building a module imports nothing: classes are looked up by name among those that
the caller passes. A checkpoint describes its network under "solver", which alone decides which network it belongs to.
"""

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from bpnp.files import write_atomically
from bpnp.layers.assignment import Sinkhorn
from bpnp.layers.pnp import WeightedPnP
from bpnp.layers.ransac.layer import RansacPnP
from bpnp.models.knn_features import KnnFeatures
from bpnp.models.least_squares import LeastSquares
from bpnp.models.nets import ImageFeatures, PointFeatures, SceneFeatures
from bpnp.models.refinement import Refinement

PARTS = (
    ImageFeatures, SceneFeatures, PointFeatures, KnnFeatures, Sinkhorn, RansacPnP, WeightedPnP, Refinement,
    LeastSquares,
)  # fmt: skip
WEIGHTS = resources.files("bpnp") / "weights"
LEARNED = "procedural-so3"  # weights of `solve(prior="learned")`
PLAIN = (bool, int, float, str, type(None))
PACKED = ("solver", "epoch", "global_step", "pytorch-lightning_version")  # the last three for `bpnp test --ckpt_path`
PREFIX = "solver."  # prefix of the weights of BlindPnPTask's solver
# Settings of the inference, so that a run may override those of its checkpoint.
ADJUSTABLE = {"ransac", "pnp", "refinement", "rounds", "headings", "vertical", "tolerance", "max_iterations"}

Net = TypeVar("Net", bound="TrainedNet")


class TrainedNet(nn.Module):
    """Base of networks that can be restored from a checkpoint, in evaluation mode.

    >>> from bpnp import BPnPNet
    >>> BPnPNet.from_pretrained("procedural-so3").training
    False
    """

    refinement: Refinement

    @classmethod
    def from_checkpoint(cls: type[Net], path: str | Path, *, parts: Iterable[type[nn.Module]] = ()) -> Net:
        """Load the network of a checkpoint that `bpnp fit` wrote.

        `TrainedNet.from_checkpoint` loads a network of any class.

        Args:
            path: File, or the name of packaged weights.
            parts: Classes outside this package that the network is made of. A checkpoint names its classes, and only
                those passed here are used. Default: none.

        Returns:
            The network in evaluation mode, on the CPU.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file holds another network, or none.
        """
        content = read_checkpoint(path)
        saved = content.get("solver")
        name = saved.get("class") if isinstance(saved, Mapping) else None
        classes = {class_name(net): net for net in networks()}
        if not issubclass(classes.get(str(name), object), cls):
            wanted = " or ".join(classes) if cls is TrainedNet else class_name(cls)
            raise ValueError(f"{path} is a checkpoint of {name or 'another program'}, not of {wanted}")
        try:
            net = build_solver(content, parts)
            net.load_state_dict(fitting_state(content, net)[0])
        except ValueError as error:
            raise ValueError(f"cannot load {name} from {path}: {error}") from error
        assert isinstance(net, cls)
        return net.eval()

    @classmethod
    def from_pretrained(cls: type[Net], name: str) -> Net:
        """Load a network with weights of this package; nothing is downloaded.

        Args:
            name: Name of the weights; `docs/model-card.md` lists them.

        Returns:
            The network in evaluation mode, on the CPU.

        Raises:
            ValueError: There are no such weights, or they are of another class.
        """
        if name not in (names := pretrained_names()):
            raise ValueError(f"there are no packaged weights {name!r}; the names are {', '.join(names)}")
        return cls.from_checkpoint(name)

    @property
    def estimates(self) -> tuple[str, ...]:
        """Names of the poses in evaluation."""
        return ("ransac", "pnp", "refined") if self.refinement.enabled else ("ransac", "pnp")


def pretrained_names() -> list[str]:
    """Return the names that `from_pretrained` accepts."""
    return sorted(file.name.removesuffix(".ckpt") for file in WEIGHTS.iterdir() if file.name.endswith(".ckpt"))


def checkpoint_path(name: str | Path) -> Path:
    """Return the file of a checkpoint, given by its path or the name of packaged weights.

    A string that is such a name is always the packaged weights; a file of that name in the working directory is
    ``./<name>``.
    """
    packaged = str(name) in pretrained_names()
    if Path(name).is_file() and not (packaged and isinstance(name, str)):
        return Path(name)
    if packaged:
        return Path(str(WEIGHTS / f"{name}.ckpt"))
    raise FileNotFoundError(
        f"there is no checkpoint {name}; give a file such as runs/<name>/checkpoints/last.ckpt, or packaged weights: "
        f"{', '.join(pretrained_names())}"
    )


def read_checkpoint(path: str | Path, *, map_location: Any = "cpu") -> dict[str, Any]:
    """Read a checkpoint of `bpnp fit`, or packaged weights, restricted to tensors, numbers and plain containers.

    Raise ValueError if the file is truncated, of another program, or holds code.
    """
    content = read_data(path, map_location=map_location)
    if "state_dict" not in content:
        raise ValueError(f"{path} is no checkpoint of `bpnp fit`: it has no `state_dict`")
    if unknown := next(_unknown_settings(content.get("solver")), None):
        raise ValueError(f"{path} is of another version of bpnp: {unknown}. Train the network again")
    return content


def _unknown_settings(description: Any) -> Iterator[str]:
    """Yield the settings that the classes of this package no longer have."""
    if is_description(description) and isinstance(settings := description["settings"], Mapping):
        cls = {class_name(cls): cls for cls in (*networks(), *PARTS)}.get(description["class"])
        known = settings if cls is None else inspect.signature(cls).parameters
        yield from (f"{description['class']} has no setting `{name}`" for name in settings if name not in known)
        for setting in settings.values():
            yield from _unknown_settings(setting)


def read_data(path: str | Path, *, map_location: Any = "cpu") -> dict[str, Any]:
    """Read a dict of tensors, numbers and plain containers that torch saved, as in `read_checkpoint`."""
    file = checkpoint_path(path)
    try:
        content = torch.load(file, map_location=map_location, weights_only=True)
    except Exception as error:  # a damaged file makes torch raise almost anything, such as struct.error
        reason = (str(error) or type(error).__name__).splitlines()[0].split(". ")[0]
        raise ValueError(f"{file} is no checkpoint of `bpnp fit`: it cannot be read ({reason})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file} is no checkpoint of `bpnp fit`: it has no `state_dict`")
    return content


def pack_weights(checkpoint: str | Path, out: str | Path, *, steps: int | None = None) -> None:
    """Write the network of a checkpoint of `bpnp fit` and its settings in half precision, as those of packaged weights.

    `TrainedNet.from_checkpoint` and ``bpnp test --ckpt_path`` read the file like any checkpoint. The optimiser steps
    are those of all trainings that led to it, by default those of the checkpoint. Raise ValueError if a weight is
    beyond the range of float16.
    """
    content = read_checkpoint(checkpoint)
    state = {key: value for key, value in content["state_dict"].items() if key.startswith(PREFIX)}
    for key, value in state.items():
        state[key] = value.half() if value.is_floating_point() else value
        if not state[key].isfinite().all():
            raise ValueError(f"{key} of {checkpoint} has weights beyond the range of float16")
    kept = {key: content[key] for key in PACKED if key in content} | ({} if steps is None else {"global_step": steps})
    with write_atomically(Path(out)) as temporary, temporary.open("wb") as file:  # a path would be part of the file
        torch.save(kept | {"state_dict": state}, file)


def solver_state(content: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights of the solver in a checkpoint of a `BlindPnPTask`, by their names in the solver."""
    state = content["state_dict"]
    return {key.removeprefix(PREFIX): value for key, value in state.items() if key.startswith(PREFIX)}


def build_solver(content: Mapping[str, Any], parts: Iterable[type[nn.Module]] = ()) -> nn.Module:
    """Build the network that a checkpoint describes, without its weights, of classes of this package or in `parts`.

    Raise ValueError if the checkpoint describes no network, or another class.
    """
    return build_module(content.get("solver"), (*networks(), *PARTS, *parts))


def networks(base: type[nn.Module] = TrainedNet) -> Iterator[type[nn.Module]]:
    """Yield every class derived from `base`, directly or not."""
    for cls in base.__subclasses__():
        yield cls
        yield from networks(cls)


def fitting_state(
    content: Mapping[str, Any], solver: nn.Module, *, allow_added: bool = False
) -> tuple[dict[str, Tensor], list[str]]:
    """Return the weights of a checkpoint that fit a solver, and what differs on purpose, as `rounds=0 (saved: 8)`.

    With `allow_added` the solver may have weights that the checkpoint lacks and that are zero, of parts that add
    nothing before training, and differ in the settings that create these parts. Raise ValueError if the class, another
    setting, or the shape of a weight differs, or a weight is NaN or infinite.
    """
    saved, wanted = content.get("solver", {}), describe_module(solver)
    state, weights = solver_state(content), solver.state_dict()
    if saved.get("class") != wanted["class"]:
        raise ValueError(f"this is a checkpoint of {saved.get('class', 'another program')}, not of {wanted['class']}")
    added = {key: value for key, value in weights.items() if allow_added and key not in state and not value.any()}
    misfits = [
        key for key in state.keys() | weights.keys() if _shape((state | added).get(key)) != _shape(weights.get(key))
    ]
    adjusted: list[str] = []
    wrong: list[str] = []
    grows = bool(added) and not misfits
    for place, ours, theirs in differences(wanted, _with_defaults(saved, solver)):
        allowed = ADJUSTABLE & set(place.split(".")) or (grows and _creates(added, place, theirs, solver))
        (adjusted if allowed else wrong).append(f"{place}={_setting_text(ours)} (saved: {_setting_text(theirs)})")
    if wrong:
        raise ValueError(
            f"the checkpoint is of another {wanted['class']}: {', '.join(wrong)}. Leave these settings out, or give "
            "the saved ones"
        )
    if misfits:
        raise ValueError(f"the checkpoint has no {sorted(misfits)[0]} of the shape that this {wanted['class']} needs")
    trained = sorted(state.keys() & dict(solver.named_parameters()).keys())
    if broken := next((key for key in trained if not state[key].isfinite().all()), None):
        raise ValueError(f"{broken} of the checkpoint holds NaN or infinity; use an earlier checkpoint")
    return state | added, adjusted


def _with_defaults(description: Mapping[str, Any], solver: nn.Module) -> Mapping[str, Any]:
    """Add the settings that a description lacks, with their defaults: a user's class may have got new ones."""
    built = _build_without_weights(description, solver)
    return description if built is None else describe_module(built)


def _creates(part: Iterable[str], place: str, other: Any, solver: nn.Module) -> bool:
    """Return True if a solver with another value of one setting lacks one of these weights."""
    built = _build_without_weights(_with_setting(describe_module(solver), place.split("."), other), solver)
    return built is not None and not set(part) <= built.state_dict().keys()


def _with_setting(description: Mapping[str, Any], place: Sequence[str], value: Any) -> dict[str, Any]:
    name, *rest = place
    settings = description["settings"]
    changed = _with_setting(settings[name], rest, value) if rest else value
    return {"class": description["class"], "settings": {**settings, name: changed}}


def _build_without_weights(description: Mapping[str, Any], solver: nn.Module) -> nn.Module | None:
    """Build a description of a solver's classes without memory for weights; None if it cannot be built."""
    try:
        with torch.device("meta"):
            return build_module(description, (*networks(), *PARTS, *{type(part) for part in solver.modules()}))
    except (ValueError, RuntimeError, NotImplementedError):
        return None


def _shape(weight: Tensor | None) -> tuple[int, ...] | None:
    return None if weight is None else tuple(weight.shape)


def _setting_text(setting: Any) -> Any:
    return setting["class"] if is_description(setting) else setting


@runtime_checkable
class AnyModule(Protocol):
    """Type of an option that takes any `nn.Module`; the help of `nn.Module` itself would list all classes of torch."""

    def __call__(self, *arguments: Any, **options: Any) -> Any: ...


def module_or_default(module: AnyModule | None, default: type[nn.Module]) -> nn.Module:
    """Return the module, or one of the default class with its default options if it is None."""
    if module is None:
        return default()
    if not isinstance(module, nn.Module):
        raise ValueError(f"{module!r:.80} is no torch.nn.Module")
    return module


def describe_module(module: nn.Module) -> dict[str, Any]:
    """Describe a module as ``{"class": name, "settings": {argument: value}}``.

    The settings are None where the module does not keep its arguments; such a module can have weights but cannot be
    built.
    """
    settings: dict[str, Any] = {}
    for name, parameter in inspect.signature(type(module)).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        value = getattr(module, name, parameter.empty)
        if isinstance(value, nn.Module):
            value = describe_module(value)
        elif not is_plain(value):
            return {"class": class_name(type(module)), "settings": None}
        settings[name] = value
    return {"class": class_name(type(module)), "settings": settings}


def build_module(description: Any, classes: Iterable[type[nn.Module]]) -> nn.Module:
    """Build the module of `describe_module`, which may name these classes.

    Raise ValueError for another class, or settings that are unusable.
    """
    if not is_description(description):
        raise ValueError(f"the description of a module has its class and its settings; this one is {description!r:.80}")
    by_name = {class_name(cls): cls for cls in classes}
    name, settings = description["class"], description["settings"]
    if name not in by_name:
        raise ValueError(f"the class {name!r} is not among {', '.join(sorted(by_name))}; pass it in `parts`")
    if settings is None:
        raise ValueError(
            f"The checkpoint has no settings of {name}. Write a class that keeps each constructor argument as an "
            "attribute of that name."
        )
    arguments = {
        key: build_module(value, classes) if is_description(value) else value for key, value in settings.items()
    }
    try:
        return by_name[name](**arguments)
    except TypeError as error:
        raise ValueError(f"the settings do not fit {name}: {error}") from error


def differences(first: Any, second: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the settings in which two descriptions differ: the path, such as `features2d.channels`, and both values.

    A setting that the second description lacks is no difference.
    """
    if not (is_description(first) and is_description(second)) or first["class"] != second["class"]:
        if first != second:
            yield name, first, second
        return
    other = second["settings"] or {}
    for key, value in (first["settings"] or {}).items():
        if key in other:
            yield from differences(value, other[key], f"{name}.{key}" if name else key)


def class_name(cls: type) -> str:
    """Return the name of a class, with its module unless it is of this package, whose files may move."""
    return cls.__name__ if cls.__module__.startswith("bpnp.") else f"{cls.__module__}.{cls.__qualname__}"


def is_description(value: Any) -> bool:
    """Return True for a value in the form of a module's description."""
    return isinstance(value, Mapping) and set(value) == {"class", "settings"}


def is_plain(value: Any) -> bool:
    """Return True for a value made of strings, numbers, lists, tuples and dicts only."""
    if isinstance(value, (list, tuple)):
        return all(map(is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(each) for key, each in value.items())
    return type(value) in PLAIN
