"""Objects from a class path and settings, checked against the constructor as `bpnp fit` and `bpnp test` do."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from jsonargparse import ArgumentParser


def checked(base: type, name: str, settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> dict[str, Any]:
    """`class_path` and all `init_args` of a subclass of `base`, after `--NAME.SETTING=VALUE` overrides.

    Raises ValueError, naming the class, for one that cannot be imported and for settings that it does not accept.
    """
    try:
        chosen = _parser(base, name).parse_args([f"--{name}={json.dumps(settings)}", *overrides])
    except Exception as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ValueError(f"expected settings of {settings.get('class_path')}, got {reason}") from error
    return dict(chosen.as_dict()[name])


def build(base: type, name: str, settings: Mapping[str, Any]) -> Any:
    """The object; raises as `checked` does, and as its constructor."""
    known = checked(base, name, settings)
    parser = _parser(base, name)
    instantiate = parser.instantiate if hasattr(parser, "instantiate") else parser.instantiate_classes  # by release
    return instantiate(parser.parse_object({name: known}))[name]


def _parser(base: type, name: str) -> ArgumentParser:
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(base, name)
    return parser
