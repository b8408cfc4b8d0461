"""Command lines for typed functions: positional parameters are arguments, keyword-only ones are options."""

import difflib
import inspect
import math
import re
import types
import typing
from argparse import HelpFormatter
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from docstring_parser import parse as parse_docstring
from jsonargparse import ArgumentParser

OVERRIDES = "overrides"  # parameter that receives the options `--data.NAME=VALUE`


class OneLineParser(ArgumentParser):
    """A parser whose errors are one line: what is wrong, and the option that was probably meant."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.kinds: dict[str, str] = {}  # by parameter, what its value has to be
        self.words: dict[str, tuple[Any, ...]] = {}  # and the types of its words, see `_words`
        super().__init__(*args, **kwargs)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        text = " ".join(message.split())
        wrong = re.search(r'Parser key "(\w+)".*(?:Given|Got) value: (.*)$', text)
        if wrong and wrong[1] in self.kinds:
            raise ValueError(f"expected {wrong[1]} as {self.kinds[wrong[1]]}, got {wrong[2]!r}") from ex
        raise ValueError(self.suggested(text)) from ex

    def suggested(self, message: str) -> str:
        """The message with the known option nearest to one that is not."""
        _, found, unknown = message.rpartition("nrecognized arguments: ")
        name = unknown.split("=")[0].split(" ")[0]
        known = [option for action in self._actions for option in action.option_strings]
        close = difflib.get_close_matches(name, known, n=1) if found else []
        return message + (f"; did you mean {close[0]}?" if close else f"; try: {self.prog} --help" if found else "")


def run_command(name: str, command: Callable[..., None], arguments: Sequence[str]) -> None:
    """Parse the arguments of a command and call it. Raises ValueError for arguments that it does not take."""
    parser = command_parser(name, command)
    given = [_underscored(text) for text in arguments]
    extra: dict[str, Any] = {}
    if OVERRIDES in inspect.signature(command).parameters:
        given, extra = _without_overrides(given)
    chosen = {key: value for key, value in vars(parser.parse_args(given)).items() if not key.startswith("__")}
    tuples = [key for key, words in parser.words.items() if words and words[-1] is not ... and chosen[key] is not None]
    command(**chosen | {key: tuple(chosen[key]) for key in tuples}, **extra)


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
    hints = typing.get_type_hints(command)
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name == OVERRIDES:
            continue
        option = parameter.kind is parameter.KEYWORD_ONLY
        required = parameter.default is parameter.empty
        kind = hints[parameter.name]
        words = parser.words[parameter.name] = _words(kind)
        settings: dict[str, Any] = {"help": help_of.get(parameter.name)}
        if kind is bool:
            settings |= {"action": "store_true"}
        elif words:
            several = "+" if option or required else "*"
            settings |= {"type": words[0], "nargs": several if words[-1] is ... else len(words)}
        else:
            settings |= {"type": kind}
            if not option and not required:
                settings |= {"nargs": "?"}
        if not required and kind is not bool:
            settings |= {"default": parameter.default}
            if parameter.default is not None:
                settings["help"] += f" Default: {parameter.default}."
        if option and required:
            settings |= {"required": True}
        parser.kinds[parameter.name] = _described(words[0] if words else kind)
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


def _without_overrides(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The other arguments, and the options `--data.NAME=VALUE` or `--data.NAME VALUE`."""
    kept: list[str] = []
    overrides: list[str] = []
    words = iter(arguments)
    for text in words:
        if text.startswith("--data."):
            overrides.append(text if "=" in text else f"{text}={next(words, '')}")
        else:
            kept.append(text)
    return kept, {OVERRIDES: overrides}


def _underscored(text: str) -> str:
    """Options are written with underscores; a hyphen is read as one."""
    if not text.startswith("--"):
        return text
    name, equals, value = text[2:].partition("=")
    return f"--{name.replace('-', '_')}{equals}{value}"


def _described(kind: Any) -> str:
    options = [option for option in typing.get_args(kind) or (kind,) if option is not type(None)]
    if typing.get_origin(options[0]) is typing.Literal:
        options = list(typing.get_args(options[0]))
    return " or ".join(
        option if isinstance(option, str) else getattr(option, "__name__", str(option)) for option in options
    )


def _words(kind: Any) -> tuple[Any, ...]:
    """What the words of a list or of a tuple are: (T, ...) or one type a word; empty for other kinds."""
    for option in typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,):
        if typing.get_origin(option) is list:
            return (typing.get_args(option)[0], ...)
        if typing.get_origin(option) is tuple:
            return typing.get_args(option)
    return ()
