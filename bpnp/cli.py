"""Command line. `bpnp fit|validate|test|predict` are Lightning's commands, the others are typed functions."""

import ctypes
import difflib
import importlib.util
import io
import logging
import os
import re
import select
import sys
import textwrap
import traceback
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import metadata, version
from typing import NoReturn

from bpnp.commands import COMMANDS
from bpnp.commands.parser import LIGHTNING, first_line, parse_arguments, plain, short_help, with_options
from bpnp.files import config_names, packaged_config

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # options of mallopt, from glibc's malloc.h
AFTER_CTRL_C = {
    "localize": "; run it again to continue",
    "table": "; run it again to continue",
    "prepare": "; nothing was written, run it again",
}
LIBRARIES = sys.stdlib_module_names | {
    "beartype", "bpnp", "cv2", "filelock", "fsspec", "h5py", "jaxtyping", "jsonargparse", "lightning", "numpy",
    "pandas", "PIL", "pycolmap", "rich", "scipy", "torch", "torchmetrics", "trimesh", "typeshed_client", "wandb",
    "yaml",
}  # fmt: skip
LIGHTNING_MISTAKES = {
    "MisconfigurationException",
    "TrainingDivergedError",
}  # names instead of classes, since importing Lightning takes seconds
OTHER_SCRIPT = "lightning-sdk is installed, which has a script named `lightning` too"
VERBOSE = "--verbose"  # option of every command: print the traceback of a mistake
WIDTH = 80  # columns of the help


def main(args: Sequence[str] | None = None) -> None:
    """Run a command.

    A user's mistake ends in one line on stderr and exit status 2, without a traceback unless `--verbose` is given. If
    the reader of standard output closes it, as `head` does, the command ends silently.
    """
    given = list(sys.argv[1:] if args is None else args)
    verbose, arguments = VERBOSE in given, [text for text in given if text != VERBOSE]
    _quieten()
    if args is None:
        warnings.formatwarning = one_line_warning
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="surrogateescape")  # prints file names that are not UTF-8 unchanged
    try:
        if args is None and arguments and arguments[0] in LIGHTNING:
            keep_freed_memory()
            let_threads_sleep()
        if not {"", folder := _working_folder()} & set(sys.path):
            sys.path.append(folder)  # for the user's own classes; last, so that they hide no module
        status = _run(arguments, verbose=verbose)
        _flush_output()
        if status:
            raise SystemExit(status)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _has_no_reader(sys.stdout):
            _discard_output()
            raise SystemExit(0) from None
        if _follows_interrupt(error):
            _end_interrupted(arguments)
        if os.environ.get("BPNP_TRACEBACK") or not _is_mistake(error):
            raise
        if verbose:
            traceback.print_exception(error)
        # File names that are not UTF-8 contain surrogates, which a terminal cannot show.
        text = plain(str(error)) or "there is too little memory for this command; give it less data"
        if callable(command := COMMANDS.get(arguments[0])):
            text = with_options(text, command)
        print(f"bpnp: error: {text}".encode("utf-8", "replace").decode(), file=sys.stderr)
        try:
            _flush_output()
        except OSError:  # as on a full disk
            _discard_output()
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        _end_interrupted(arguments)


def _flush_output() -> None:
    """Flush standard output, which is None where the shell closed it."""
    if sys.stdout is not None:
        sys.stdout.flush()


def _discard_output() -> None:
    """Send what is left of standard output nowhere: where it cannot be written, its flush at exit would fail too."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _working_folder() -> str:
    """Return the working folder; raise ValueError if it was deleted."""
    try:
        return os.getcwd()
    except FileNotFoundError as error:
        raise ValueError("the working folder was deleted; change to a folder that exists") from error


def _end_interrupted(arguments: Sequence[str]) -> NoReturn:
    """Print that the command was interrupted, and exit with status 130."""
    print(f"bpnp: interrupted{AFTER_CTRL_C.get(arguments[0], '')}", file=sys.stderr)
    raise SystemExit(130) from None


def _follows_interrupt(error: BaseException | None) -> bool:
    """Return True if Ctrl-C caused an error, as within the import of a compiled library."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def one_line_warning(message: Warning | str, *_: object, **__: object) -> str:
    """Return the text of a warning for the terminal, without the line of code that gave it."""
    return f"bpnp: warning: {plain(str(message))}\n"


def _has_no_reader(stream: object) -> bool:
    """Return True if a stream is a pipe or a socket whose reader has closed it."""
    try:
        watched = select.poll()
        watched.register(stream, 0)  # type: ignore[arg-type]  # hang-ups and errors are always reported
        return bool(watched.poll(0))
    except (AttributeError, TypeError, ValueError, OSError):  # not a file, or a system without `poll`
        return False


def _is_mistake(error: Exception) -> bool:
    """Return True for an error that is a message to the user, raised by this package or a library that it uses.

    Errors of a user's own class, such as a callback or a data module, keep their traceback.
    """
    if isinstance(error, BrokenPipeError):
        return False
    frames = traceback.walk_tb(error.__traceback__)
    modules = [frame.f_globals.get("__name__", "").partition(".")[0] for frame, _ in frames]
    of_lightning = isinstance(error, RuntimeError) and modules[-1:] == ["lightning"]  # such as an unknown `monitor`
    named = isinstance(error, (ValueError, OSError, MemoryError)) or type(error).__name__ in LIGHTNING_MISTAKES
    return (named or of_lightning) and set(modules) <= LIBRARIES


def _run(arguments: list[str], *, verbose: bool) -> int | None:
    """Run a command and return its exit status, None for 0."""
    if len(arguments) > 1 and arguments[0] == "help":
        rest = arguments[2:]
        arguments = [arguments[1], "--help", "all"] if rest == ["all"] else [arguments[1], *rest, "--help"]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(help_text())
    elif arguments[0] in ("-V", "--version"):
        print(f"bpnp {version('bpnp')}")
    elif arguments[0] in LIGHTNING:
        if importlib.util.find_spec("lightning_sdk") is not None:
            print(f"bpnp: {OTHER_SCRIPT}; `bpnp {arguments[0]}` is this program", file=sys.stderr)
        if arguments[1:] == ["--help", "all"]:
            arguments = arguments[:2]
        elif {"-h", "--help"} & set(arguments):
            print(short_help(arguments[0]))
            return None
        from bpnp.commands.training import run_training  # imports torch and Lightning: seconds

        run_training(_with_packaged_configs(arguments))
    else:
        name, *rest = arguments
        command = COMMANDS[_check_name(name, [*LIGHTNING, *COMMANDS], "a command")]
        if isinstance(command, Mapping):
            if not rest or rest[0] in ("-h", "--help"):
                lines = (_row(f"  {word:<14}", first_line(function)) for word, function in command.items())
                print("\n".join([f"usage: bpnp {name} WHAT [options]", "", *lines]))
                return None
            word, *rest = rest
            name, command = f"{name} {word}", command[_check_name(word, list(command), f"one of bpnp {name}")]
        chosen = parse_arguments(name, command, rest)
        return command(**chosen | ({"verbose": True} if verbose and "verbose" in chosen else {}))
    return None


def keep_freed_memory() -> None:
    """Keep freed memory in this process, and let torch, imported afterwards, request large pages.

    A training step makes and frees hundreds of results of 8 to 64 MB, and the page faults of new memory cost more than
    their arithmetic: a step of 16 problems of 1,000 points takes 1.35 instead of 1.7 s. A value of THP_MEM_ALLOC_ENABLE
    that is already set stays. Nothing changes with a C library other than glibc, which has no `mallopt`.
    """
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, 1 << 30)
        mallopt(M_TRIM_THRESHOLD, -1)


def let_threads_sleep() -> None:
    """Let threads of torch, imported afterwards, sleep while they wait for work, unless OMP_WAIT_POLICY is set.

    By default they spin. With two other processes on two cores, a step of the quickstart takes 3.7 s with threads that
    spin and 0.6 s with threads that sleep.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _check_name(name: str, names: Sequence[str], what: str) -> str:
    """Return `name` if it is among `names`; raise ValueError otherwise."""
    if name in names:
        return name
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}?" if close else f"try {', '.join(names)}"
    raise ValueError(f"{name!r} is not {what}; {hint}")


def help_text() -> str:
    """Return the text of `bpnp --help`, one line for each command."""
    commands = {
        name: "Pack a data set: " + ", ".join(command) if isinstance(command, Mapping) else first_line(command)
        for name, command in COMMANDS.items()
    }
    lines = [_row(f"  {name:<17}", text) for name, text in (commands | LIGHTNING).items()]
    return "\n".join(
        [
            "usage: bpnp COMMAND [options]",
            "",
            "Camera pose from 2D and 3D points without correspondences.",
            "",
            *lines,
            "",
            "bpnp COMMAND --help shows the options of a command, bpnp --version the version.",
            "bpnp COMMAND --verbose also prints the traceback of an error.",
            textwrap.fill(f"Packaged configurations, for --config: {', '.join(config_names())}.", WIDTH),
            *(url.replace(", ", ": ", 1) for url in metadata("bpnp").get_all("Project-URL", [])),
        ]
    )


def _row(head: str, text: str) -> str:
    return textwrap.fill(text, WIDTH, initial_indent=head, subsequent_indent=" " * len(head))


def _with_packaged_configs(arguments: Sequence[str]) -> list[str]:
    """Replace names of packaged configurations by their files; raise ValueError if there is no such one."""
    words = [part for text in arguments for part in (text.split("=", 1) if text.startswith("--config=") else [text])]
    for i, before in enumerate(words[:-1], 1):
        if before in ("-c", "--config"):
            file = packaged_config(words[i])
            if not os.path.isfile(file):
                _check_name(file, config_names(), "a configuration file or the name of a packaged one")
            if file != words[i] not in config_names():
                print(f"bpnp: {words[i]} is not in this folder; using the packaged {file}", file=sys.stderr)
            words[i] = file
    return words


def _quieten() -> None:
    """Silence third-party advice that does not apply here."""
    advice = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    advice.addFilter(lambda record: not re.search("Tip:|weights_only", record.getMessage()))
    for part in (
        "does not have many workers",
        "Couldn't infer the batch indices",
        "Using `DistributedSampler` with the dataloaders",
        "LeafSpec",
        "logs directory .* exists and is not empty",
        "smaller than the logging interval",
        "`BlindPnPTask.configure_optimizers` will be overridden",
    ):
        warnings.filterwarnings("ignore", message=f".*{part}.*")
