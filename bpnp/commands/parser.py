"""Command lines of typed functions, and the short help of Lightning's commands, without importing Lightning.

Positional parameters become arguments, keyword-only ones options.
"""

import difflib
import inspect
import itertools
import math
import re
import typing
from argparse import HelpFormatter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from docstring_parser import parse as parse_docstring
from jsonargparse import ArgumentParser

NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.IGNORECASE)
WRONG_TYPE = re.compile(
    r"Parser key \"(\w+)\"(?: element (\d+))?: Expected a (<class '(int|float)'>|typing\.Literal\[(.*?)\])\.? "
    r"(?:Got|Given) value: (.*)"
)
# `name`, `name=value` or name=value in a message; not a part of another option, such as --data.seed=1.
ARGUMENT = re.compile(r"`([\w.]+)(?:=([^`]+))?`|(?<![\w.`'-])(\w+)=(\([^)]*\)|[\w.]+)")
NO_VALUES = (None, "True", "K", "(width, height)")  # values in messages that no command line has
KINDS = {"int": "a whole number", "float": "a number"}
# What the commands call an argument of `bpnp.solve` and `bpnp.verify` that is no option of the same name.
OTHER_NAMES = {
    "labels2d": "the column label of points2d",
    "labels3d": "the column label of points3d",
    "scores2d": "the column score of points2d",
    "scores3d": "the column score of points3d",
    "normals3d": "the normal of points3d",
    "pose.rotation": "the rotation of the pose",
    "pose.translation": "the translation of the pose",
    "prior.rotation": "the rotation of --prior",
    "prior.translation": "the translation of --prior",
    "prior.rotation_sigma_deg": "--prior_degrees",
    "prior.translation_sigma": "--prior_distance",
    "prior.sigma_deg": "--up_degrees",
}
OVERRIDES = "overrides"  # name of the parameter that receives the options `--data.NAME=VALUE`


class OneLineParser(ArgumentParser):
    """Parser whose errors are one line: what is wrong, and the option that was probably meant."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raise ValueError with the message in one line, and a hint."""
        text = _of_option(plain(message)) if " " in self.prog else plain(message)
        _, found, unknown = text.rpartition("nrecognized arguments: ")
        option_strings = [name for action in self._actions for name in action.option_strings if name.startswith("-")]
        if required := text.partition("arguments are required: ")[2]:
            command, options = self.prog, []
            for path in required.split(", "):
                parent, _, name = path.rpartition(".")  # `fit.data` is an option of `bpnp fit`
                command = f"{self.prog} {parent}".rstrip()
                options.append(f"--{name}" if parent or f"--{name}" in option_strings else name)
            start = f"{command} --config quickstart, or " if parent in LIGHTNING else ""
            # A class that an option names has a parser of its own, without a command.
            advice = f"; try: {start}{command} --help" if " " in command else ""
            raise ValueError(f"missing {', '.join(options)}{advice}") from ex
        close = closest_option(unknown.split("=")[0].split(" ")[0], option_strings) if found else None
        program = self.prog.replace(" [options]", "")
        hint = f"; did you mean {close}?" if close else f"; try: {program} --help" if found else ""
        text, of_no_class, _ = text.partition(" Expected an instantiatable class, but bpnp.models.weights.AnyModule")
        if of_no_class:
            hint = ", since there is no class; name one first, such as --model.solver bpnp.models.BPnPNet"
        raise ValueError(text + hint) from ex


def _of_option(message: str) -> str:
    """Return jsonargparse's message on a value of another type as a sentence about the option; others unchanged."""
    if (found := WRONG_TYPE.match(message)) is None:
        return message
    name, element, _, kind, names, value = found.groups()
    needed = KINDS[kind] if kind else f"one of {names}"
    where = f"word {element} of --{name}" if element else f"--{name}"
    return f"{where} is {value!r}; {needed} is needed"


def with_options(message: str, command: Callable[..., int | None]) -> str:
    """Return a message that names arguments of Python functions with the options of a command in their place.

    >>> from bpnp.commands.parser import with_options
    >>> def solve(*, camera: str, focal_error: float) -> None: ...
    >>> with_options("`focal_error` needs a `camera`, such as focal_error=0.1", solve)
    '--focal_error needs a --camera, such as --focal_error 0.1'
    """
    parameters = inspect.signature(command).parameters.values()
    names = {one.name: f"--{one.name}" if one.kind is one.KEYWORD_ONLY else one.name for one in parameters}
    if "points2d" in names:
        names |= OTHER_NAMES

    def renamed(found: re.Match[str]) -> str:
        name, value = found[1] or found[3], found[2] or found[4]
        if name not in names:
            return found[0]
        return names[name] if value in NO_VALUES else f"{names[name]} {value}"

    return ARGUMENT.sub(renamed, message)


def closest_option(unknown: str, options: Sequence[str]) -> str | None:
    """Return the option that was probably meant, or None.

    Names are compared without their group, such as `--model`. Options of the same group come first, and initials count.

    >>> from bpnp.commands.parser import closest_option
    >>> closest_option("--model.lr", ["--model.solver", "--model.learning_rate"])
    '--model.learning_rate'
    """
    group, _, name = unknown.lstrip("-").rpartition(".")
    names: dict[str, list[str]] = {}
    siblings: dict[str, list[str]] = {}
    for option in options:
        own_group, _, own = option.lstrip("-").rpartition(".")
        names.setdefault(own, []).append(option)
        if own_group == group:
            siblings.setdefault(own, []).append(option)
    for among in (siblings, names):
        initials = [own for own in among if "_" in own and name == "".join(word[:1] for word in own.split("_"))]
        close = initials or sorted(among, key=lambda own: -difflib.SequenceMatcher(None, name, own).ratio())
        if close and (initials or difflib.get_close_matches(name, close[:1])):
            return among[close[0]][0]
    return None


# Beginnings of lines of jsonargparse's messages that list other types of an option, and its value.
NOISE = (
    "Does not validate against",
    "Subtypes:",
    "Errors:",
    "Given value type:",
    "Given value: Namespace(",
    "Given value: NestedArg(",
    "Given value: [Namespace(",
    "- Not a valid subclass of",
    "Subclass types expect one of",
    "- a class path (str)",
    "- a dict with",
    "- Does not validate against",
    "- Expected a <class 'NoneType'>",
    "- Expected a path but",
)


def plain(message: str) -> str:
    """Join the lines of a message, without those in `NOISE`."""
    lines = (line.strip() for line in message.splitlines())
    return " ".join(dict.fromkeys(line.removeprefix("- ") for line in lines if line and not line.startswith(NOISE)))


def parse_arguments(name: str, command: Callable[..., int | None], arguments: Sequence[str]) -> dict[str, Any]:
    """Parse the arguments of a command into values by parameter; raise ValueError if it does not take them.

    A hyphen in the name of an option is read as an underscore, and the value `inf` as YAML's `.inf`.
    """
    words = [re.sub(r"^--[\w-]+", lambda name: f"--{name[0][2:].replace('-', '_')}", text) for text in arguments]
    hints = typing.get_type_hints(command)
    numbers = [f"--{name}" for name, kind in hints.items() if float in (kind, *typing.get_args(kind))]
    words = [_infinity(before, text, numbers) for before, text in itertools.pairwise(["", *words])]
    extra = {}
    if OVERRIDES in inspect.signature(command).parameters:
        rest, words, extra = iter(words), [], {OVERRIDES: list[str]()}
        for text in rest:
            if text.startswith("--data."):
                extra[OVERRIDES].append(text if "=" in text else f"{text}={next(rest, '')}")
            else:
                words.append(text)
    chosen = {
        key: tuple(value) if value and isinstance(_word(hints[key])[1], int) else value
        for key, value in vars(command_parser(name, command).parse_args(words)).items()
        if key in hints
    }
    return chosen | extra


def _infinity(before: str, text: str, numbers: Sequence[str]) -> str:
    """Return the YAML form of the value `inf` of one of the options `numbers`, and any other word unchanged."""
    option, _, value = text.rpartition("=")
    if value != "inf" or (option or before) not in numbers:
        return text
    return text.removesuffix("inf") + ".inf"


def command_parser(name: str, command: Callable[..., int | None]) -> OneLineParser:
    """Build the parser of a function; its help comes from the docstring.

    A list takes several words and a tuple as many as it has. A bool is a flag without a value. Anything else is parsed
    as its annotation says.
    """
    docstring = parse_docstring(inspect.getdoc(command) or "")
    help_of = {parameter.arg_name: parameter.description for parameter in docstring.params}
    description = "\n".join(filter(None, (docstring.short_description, docstring.long_description)))
    parser = OneLineParser(
        prog=f"bpnp {name}", description=description, allow_abbrev=False, formatter_class=HelpFormatter
    )
    # argparse of Python 3.11 takes -2e-05 for an option; it has no public setting for this.
    parser._negative_number_matcher = NEGATIVE_NUMBER
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


def at_least(least: int, **options: float | int | None) -> None:
    """Raise ValueError for an option below `least` or not finite; None is ignored."""
    for name, value in options.items():
        if value is not None and not least <= value < math.inf:
            raise ValueError(f"--{name} is {value}; it must be {least:g} or more")


def first_line(command: Callable[..., int | None]) -> str:
    """Return the first line of a command's docstring."""
    return (inspect.getdoc(command) or "").splitlines()[0]


def _word(kind: Any) -> tuple[Any, str | int | None]:
    """Return the type of a word and the number of words: "+" for a list, a number for a tuple, else None."""
    for option in (kind, *typing.get_args(kind)):
        if typing.get_origin(option) in (list, tuple):
            words = typing.get_args(option)
            return _parsed(words[0]), "+" if typing.get_origin(option) is list else len(words)
    return _parsed(kind), None


def _parsed(kind: Any) -> Any:
    """Return the type of a word; for a path or a text, which jsonargparse reads as YAML, a function."""
    kinds = (kind, *typing.get_args(kind))
    return _path if Path in kinds else _text if str in kinds else kind


def _path(text: str | Path) -> Path:
    """Return a path, whose bytes may be of any encoding; jsonargparse passes the result to this function again."""
    return Path(text)


def _text(text: str) -> str:
    """Return a text unchanged."""
    return text


LIGHTNING = {
    "fit": "Train a solver.",
    "validate": "Evaluate a solver on the validation problems.",
    "test": "Evaluate a solver on the test problems and write their results.",
    "predict": "Write the poses of a solver on the test problems, as CSV or JSON.",
}
OPTIONS = {
    "--config NAME": "packaged configuration or a YAML file; later ones override earlier ones",
    "--ckpt_path FILE": "checkpoint, `last` or `best` of the run, or the name of packaged weights",
    "--print_config": "print all options with their values, to use as --config",
    "--seed_everything N": "seed",
    "--data CLASS": "class path of the data, such as bpnp.datamodules.MeshDataModule",
    "--data.root FOLDER": "folder of the data; procedural shapes without it",
    "--data.num_points N": "points of a problem",
    "--data.batch_size N": "problems of a step",
    "--model CLASS": "class path of a LightningModule in place of BlindPnPTask",
    "--model.solver CLASS": "class path of an nn.Module that maps a Batch to a Prediction",
    "--model.weights NAME": "start from packaged weights, or from a checkpoint",
    "--model.loss CLASS": "class path of a loss in place of --model.matching_loss",
    "--model.matching_loss KIND": "correspondence (the paper's) or likelihood",
    "--model.learning_rate X": "learning rate of Adam",
    "--optimizer CLASS": "torch.optim.AdamW, SGD, ..., with --optimizer.lr; also --lr_scheduler",
    "--pose_loss.start_epoch N": "first epoch with the pose loss; --pose_loss.weight X",
    "--trainer.default_root_dir FOLDER": "folder of the run: checkpoints, logs, results",
    "--trainer.max_epochs N": "number of epochs",
    "--trainer.max_time DD:HH:MM:SS": "time limit",
    "--trainer.accelerator NAME": "cpu, gpu or auto",
    "--trainer.fast_dev_run true": "run one batch of each stage and write nothing",
}
COLUMN = 36


def short_help(command: str) -> str:
    """Return the text of `bpnp COMMAND --help` for a command of `LIGHTNING`."""
    options = [f"  {option:<{COLUMN}}{text}" for option, text in OPTIONS.items()]
    return "\n".join(
        [
            f"usage: bpnp {command} --config NAME [options]",
            "",
            LIGHTNING[command],
            "",
            *options,
            "",
            f"bpnp {command} --help all lists every option,",
            f"bpnp {command} --data.help=CLASS, --model.solver.help=CLASS and so on list those of a class.",
        ]
    )
