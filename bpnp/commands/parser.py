"""Command lines for typed functions: positional parameters are arguments, keyword-only ones are options."""

import difflib
import inspect
import math
import re
import typing
from argparse import HelpFormatter
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from docstring_parser import parse as parse_docstring
from jsonargparse import ArgumentParser

OVERRIDES = "overrides"  # parameter that receives the options `--data.NAME=VALUE`


class OneLineParser(ArgumentParser):
    """A parser whose errors are one line: what is wrong, and the option that was probably meant."""

    of_words = False  # of a typed function: the values are words, of a kind that can be named

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        text = " ".join(message.split())
        if self.of_words and (wrong := re.search(r'Parser key "(\w+)".*(?:Given|Got) value: (.*)$', text)):
            (action,) = (action for action in self._actions if action.dest == wrong[1])
            text = f"expected {wrong[1]} as {_described(getattr(action, '_typehint', action.type))}, got {wrong[2]!r}"
        _, found, unknown = text.rpartition("nrecognized arguments: ")
        known = [option for action in self._actions for option in action.option_strings]
        close = difflib.get_close_matches(re.split("[= ]", unknown)[0], known, n=1) if found else []
        hint = f"; did you mean {close[0]}?" if close else f"; try: {self.prog} --help" if found else ""
        raise ValueError(text + hint) from ex


def run_command(name: str, command: Callable[..., None], arguments: Sequence[str]) -> None:
    """Parse the arguments of a command and call it. Raises ValueError for arguments that it does not take.

    A hyphen in the name of an option is read as an underscore.
    """
    given = [re.sub(r"^--[\w-]+", lambda own: f"--{own[0][2:].replace('-', '_')}", text) for text in arguments]
    extra = {}
    if OVERRIDES in inspect.signature(command).parameters:
        words, given, extra = iter(given), [], {OVERRIDES: list[str]()}
        for text in words:
            if text.startswith("--data."):
                extra[OVERRIDES].append(text if "=" in text else f"{text}={next(words, '')}")
            else:
                given.append(text)
    hints = typing.get_type_hints(command)
    chosen = {
        key: tuple(value) if value and isinstance(_word(hints[key])[1], int) else value
        for key, value in vars(command_parser(name, command).parse_args(given)).items()
        if key in hints
    }
    command(**chosen, **extra)


def command_parser(name: str, command: Callable[..., None]) -> OneLineParser:
    """The parser of a function, its help from the docstring.

    A list takes several words, a tuple as many as it has; a bool is a flag without a value; anything else is read as
    its annotation says.
    """
    told = parse_docstring(inspect.getdoc(command) or "")
    help_of = {parameter.arg_name: parameter.description for parameter in told.params}
    description = "\n".join(filter(None, (told.short_description, told.long_description)))
    parser = OneLineParser(
        prog=f"bpnp {name}", description=description, allow_abbrev=False, formatter_class=HelpFormatter
    )
    parser.of_words = True
    hints = typing.get_type_hints(command)
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name == OVERRIDES:
            continue
        option, default = parameter.kind is parameter.KEYWORD_ONLY, parameter.default
        required, kind = default is parameter.empty, hints[parameter.name]
        settings: dict[str, Any] = {"help": help_of.get(parameter.name)}
        if kind is bool:
            settings |= {"action": "store_true"}
        else:
            settings["type"], count = _word(kind)
            if words := count if option or required else "*" if count else "?":
                settings["nargs"] = words
            settings |= {"required": True} if option and required else {} if required else {"default": default}
            settings["help"] += "" if required or default is None else f" Default: {default}."
        parser.add_argument(f"--{parameter.name}" if option else parameter.name, **settings)
    return parser


def at_least(least: int, **given: float | int | None) -> None:
    """Raise ValueError for an option below `least` or not finite; None is none."""
    for name, value in given.items():
        if value is not None and not least <= value < math.inf:
            raise ValueError(f"expected --{name} of {least:g} or more, got {value}")


def first_line(command: Callable[..., None]) -> str:
    """What a command does, in a line."""
    return (inspect.getdoc(command) or "").splitlines()[0]


def _described(kind: Any) -> str:
    """The types or the words that an annotation allows."""
    kinds = [option for option in typing.get_args(kind) or (kind,) if option is not type(None)]
    words = typing.get_args(kinds[0]) if typing.get_origin(kinds[0]) is typing.Literal else kinds
    return " or ".join(word if isinstance(word, str) else word.__name__ for word in words)


def _word(kind: Any) -> tuple[Any, str | int | None]:
    """The type of a word, and how many there are: "+" for a list, a number for a tuple, None for other kinds."""
    for option in (kind, *typing.get_args(kind)):
        if typing.get_origin(option) in (list, tuple):
            words = typing.get_args(option)
            return words[0], "+" if typing.get_origin(option) is list else len(words)
    return kind, None
