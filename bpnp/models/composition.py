"""Modules as plain data and back: what a checkpoint keeps of a network beside its weights.

A module is described by the name of its class and its constructor's arguments, each kept by the module as an attribute
of the same name; an argument that is a module is described likewise. A description holds dicts, lists, tuples, strings
and numbers only. Building one imports nothing: the classes are looked up by name among those that the caller knows.
"""

import inspect
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

from torch import nn

PLAIN = (bool, int, float, str, type(None))


@runtime_checkable
class AnyModule(Protocol):
    """The type of an option that takes any `nn.Module`: the help of `nn.Module` itself would list all of torch's."""

    def __call__(self, *arguments: Any, **options: Any) -> Any: ...


def chosen(given: AnyModule | None, default: type[nn.Module]) -> nn.Module:
    """The module that was given, or the default class with its default options."""
    if given is None:
        return default()
    if not isinstance(given, nn.Module):
        raise ValueError(f"expected a module, got {given!r:.80}; try a subclass of torch.nn.Module")
    return given


def described(module: nn.Module) -> dict[str, Any]:
    """``{"class": name, "settings": {argument: value}}`` of a module.

    The settings are None where the module does not keep its arguments: such a module has weights, and cannot be built.
    """
    settings: dict[str, Any] = {}
    for name, parameter in inspect.signature(type(module)).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        value = getattr(module, name, parameter.empty)
        if isinstance(value, nn.Module):
            value = described(value)
        elif not _is_plain(value):
            return {"class": class_name(type(module)), "settings": None}
        settings[name] = value
    return {"class": class_name(type(module)), "settings": settings}


def built(description: Any, classes: Iterable[type[nn.Module]]) -> nn.Module:
    """The module of a description. Raises ValueError for a class that is not among `classes`, or unusable settings."""
    if not is_description(description):
        raise ValueError(f"expected the class and the settings of a module, got {description!r:.80}")
    known = {class_name(cls): cls for cls in classes}
    name, settings = description["class"], description["settings"]
    if name not in known:
        raise ValueError(f"expected a class among {', '.join(sorted(known))}, got {name!r}; try it in `parts`")
    if settings is None:
        raise ValueError(
            f"expected the settings of {name}, got none; try a class that keeps each constructor argument as an "
            "attribute of its name"
        )
    arguments = {key: built(value, classes) if is_description(value) else value for key, value in settings.items()}
    try:
        return known[name](**arguments)
    except TypeError as error:
        raise ValueError(f"expected settings of {name}, got {error}") from error


def differences(first: Any, second: Any, name: str = "") -> Iterator[str]:
    """Settings of the first of two descriptions that the second has not, as `features2d.channels=32`."""
    if not (is_description(first) and is_description(second)) or first["class"] != second["class"]:
        if first != second:
            yield f"{name}={first['class'] if is_description(first) else first}"
        return
    theirs = second["settings"] or {}
    for key, value in (first["settings"] or {}).items():
        yield from differences(value, theirs.get(key), f"{name}.{key}" if name else key)


def class_name(cls: type) -> str:
    """Its own name for a class of this package, whose files may move; with its module for any other."""
    return cls.__name__ if cls.__module__.startswith("bpnp.") else f"{cls.__module__}.{cls.__qualname__}"


def is_description(value: Any) -> bool:
    return isinstance(value, Mapping) and set(value) == {"class", "settings"}


def _is_plain(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(each) for key, each in value.items())
    return type(value) in PLAIN
