"""Docstrings: examples run when they are pasted, and sections are where a user reads them."""

import ast
import dataclasses
import doctest
import importlib
import inspect
import io
import pkgutil
import pydoc
import re
import tokenize
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins import CheckpointIO

import bpnp
from bpnp.commands import COMMANDS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
REFERENCE = {
    page.name: re.findall(r"^::: (\S+)", page.read_text(encoding="utf-8"), re.MULTILINE)
    for page in sorted((ROOT / "docs" / "api").glob("*.md"))
}
MODULES = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for file in (ROOT / "bpnp").rglob("*.py")
    if "    >>> " in file.read_text(encoding="utf-8")
)
PACKAGES = (
    "bpnp",
    *(f"bpnp.{name}" for name in ("datamodules", "layers", "models", "models.baselines", "report", "training")),
)
SECTION = re.compile(r"^ *(Args|Attributes|Returns|Raises|Yields):$", re.MULTILINE)
# What a configuration names.
CONFIGURABLE = (
    torch.nn.Module,
    lightning.LightningDataModule,
    lightning.Trainer,
    Callback,
    Logger,
    CheckpointIO,
)
# Names of other libraries and of data, which no code here uses.
FOREIGN = {
    "OnExceptionCheckpoint",
    "SequentialLR",
    "dataloader_idx_0",
    "ddp_notebook",
    "lu_factor",
    "normal_resampled",
    "setup_context",
}
INTERNAL = "bpnp.search."  # modules whose names are imported from `bpnp`, or are not public


def is_pasted(example: doctest.DocTest, public: set[str]) -> bool:
    """Return True for an example that a reader copies: of a name in docs/api, or outside of the internals."""
    name = example.name
    return not name.startswith(INTERNAL) or any(name == each or name.startswith(f"{each}.") for each in public)


def public_objects() -> list[Any]:
    objects = [pydoc.locate(name) for names in REFERENCE.values() for name in names]
    assert None not in objects
    return objects


def public_names() -> set[str]:
    """Return the names in docs/api as "module.name", where they are defined."""
    return {f"{each.__module__}.{each.__qualname__}" for each in public_objects()}


def public_callables() -> Iterator[tuple[str, Any, str]]:
    """Yield the name, the callable and the docstring of each public function, constructor and method.

    Constructors and methods that a base class of another package describes are left out, except `forward`.
    """
    for each in public_objects():
        foreign = [base for base in getattr(each, "__mro__", ()) if not base.__module__.startswith("bpnp.")]
        is_protocol = getattr(each, "_is_protocol", False)  # its constructor has no arguments
        if not is_protocol and all(getattr(each, "__init__", None) is not base.__init__ for base in foreign):
            yield each.__qualname__, each, inspect.getdoc(each) or ""
        if not inspect.isclass(each):
            continue
        for name, member in inspect.getmembers(each, lambda one: inspect.isfunction(one) or inspect.ismethod(one)):
            inherited = any(getattr(base, name, None) is not None for base in foreign)
            inherited = inherited and (name != "forward" or not member.__module__.startswith("bpnp."))
            if not name.startswith("_") and not inherited:
                yield f"{each.__qualname__}.{name}", member, inspect.getdoc(member) or ""


@pytest.mark.parametrize("name", MODULES)
def test_examples_are_right(name: str) -> None:
    """In an empty namespace, except those of the internals, whose namespace is the module."""
    runner, public = doctest.DocTestRunner(), public_names()
    for example in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name)):
        if is_pasted(example, public):
            example.globs = {"__name__": "__main__"}
        runner.run(example, clear_globs=False)
    assert runner.tries > 0
    assert runner.failures == 0


def test_the_reference_has_every_exported_name() -> None:
    """Under one of its names: BPnPNet is exported by two packages."""
    modules = [importlib.import_module(name) for name in PACKAGES]
    exported = [getattr(module, name) for module in modules for name in module.__all__]
    listed = public_objects()
    assert [each for each in exported if each not in listed] == []


def test_the_overview_of_the_reference_has_the_names_of_each_page() -> None:
    overview = (ROOT / "docs" / "api" / "index.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[[^\]]+\]\((\w+\.md)\) \| ([^|]+) \|$", overview, re.MULTILINE)
    listed = {page: [f"bpnp.{name}" for name in re.findall(r"`([\w.]+)`", names)] for page, names in rows}
    assert listed | {"index.md": []} == REFERENCE


def test_every_argument_of_a_public_name_is_described() -> None:
    """In a section `Args:`, among the attributes of a class, or by a reference to a method with the same arguments."""
    missing = []
    for name, function, text in public_callables():
        if "arguments as for `" in text.lower():
            continue
        parameters = [
            each for each in inspect.signature(function).parameters.values() if each.name not in ("self", "cls", "_")
        ]
        missing += [f"{name}: no docstring"] if not text else []
        missing += [f"{name}: {each.name}" for each in parameters if not re.search(rf"^ +\**{each.name}: ", text, re.M)]
    assert missing == []


def command_functions(commands: Mapping[str, Any]) -> Iterator[Any]:
    for command in commands.values():
        if isinstance(command, Mapping):
            yield from command_functions(command)
        else:
            yield command


def own_classes() -> Iterator[type]:
    """Yield each class of the package."""
    for info in pkgutil.walk_packages(bpnp.__path__, "bpnp."):
        if not info.name.endswith("__main__"):
            module = importlib.import_module(info.name)
            classes = (each for each in vars(module).values() if inspect.isclass(each))
            yield from (each for each in classes if each.__module__ == info.name)


def place(each: Any) -> str:
    """Return the name of a function or class, such as "bpnp.types.Batch.to"."""
    each = inspect.unwrap(each)
    return f"{each.__module__}.{each.__qualname__}"


def places(each: type, *, is_public: bool) -> Iterator[str]:
    """Yield the places of a class, of its constructor and `forward`, and of the methods of a public one."""
    yield place(each)
    for name, member in vars(each).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if inspect.isfunction(function) and (name in ("__init__", "forward") or (is_public and name[0] != "_")):
            yield place(function)


def option_records(each: type) -> Iterator[type]:
    """Yield the data classes of the package that the constructor of a class takes, at any depth."""
    for hint in typing.get_type_hints(each.__init__).values():
        for part in (hint, *typing.get_args(hint)):
            if dataclasses.is_dataclass(part) and part.__module__.startswith("bpnp."):
                yield part
                yield from option_records(part)


def described_places() -> set[str]:
    """Return the places of what may have sections: public names, commands, protocols, and what a YAML file can name.

    The help of the command line shows the arguments of the last.
    """
    found = {place(command) for command in command_functions(COMMANDS)}
    for public in public_objects():
        if inspect.isclass(public):
            own = (base for base in public.__mro__ if base.__module__.startswith("bpnp."))
            found |= {each for base in own for each in places(base, is_public=True)}
        else:
            found.add(place(public))
    for each in own_classes():
        is_protocol = getattr(each, "_is_protocol", False) or inspect.isabstract(each)
        found |= set(places(each, is_public=True)) if is_protocol else set()
        if issubclass(each, CONFIGURABLE):
            found |= {name for part in [each, *option_records(each)] for name in places(part, is_public=False)}
    return found


def documented_nodes(file: Path) -> Iterator[tuple[str, str]]:
    """Yield place and docstring of each function and class of a file, and of the file itself."""

    def visit(node: ast.AST, name: str) -> Iterator[tuple[str, str]]:
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            name = name if isinstance(node, ast.Module) else f"{name}.{node.name}"
            yield name, ast.get_docstring(node) or ""
        for child in ast.iter_child_nodes(node):
            yield from visit(child, name)

    module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    yield from visit(ast.parse(file.read_text(encoding="utf-8")), module)


def sources() -> Iterator[Path]:
    """Yield the Python files of the package, the benchmarks and the tests."""
    for folder in ("bpnp", "benchmarks", "tests"):
        yield from sorted((ROOT / folder).rglob("*.py"))


def test_only_what_a_user_reads_has_sections() -> None:
    """The docstring of anything else is a sentence: an argument is described where the name and type do not."""
    described = described_places()
    documented = [node for file in sources() for node in documented_nodes(file)]
    wrong = [where for where, text in documented if SECTION.search(text) and where not in described]
    assert [where for where in wrong if not where.startswith("tests.commands.test_parser.")] == []  # commands


def identifiers(file: Path) -> Iterator[str]:
    """Yield the names that the code of a file has, and those in its text constants, such as keys."""
    yield from file.relative_to(ROOT).with_suffix("").parts
    documentation = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and ast.get_docstring(
            node
        ):
            documentation.add(node.body[0].value)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in documentation:
            yield from re.findall(r"[A-Za-z_]\w*", node.value)
        for field in ("id", "attr", "arg", "name", "asname", "module"):
            if isinstance(name := getattr(node, field, None), str):
                yield from name.split(".")


def test_docstrings_and_comments_name_only_what_exists() -> None:
    """A name in backticks, such as `layers.sinkhorn` or `Pose.stats`, is a name in the code of the package."""
    known = {name for file in sources() for name in identifiers(file)} | FOREIGN
    wrong = []
    for file in sources():
        text = file.read_text(encoding="utf-8")
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        prose = [each.string for each in tokens if each.type == tokenize.COMMENT]
        prose += [docstring for _, docstring in documented_nodes(file)]
        for name in re.findall(r"`([A-Za-z_][\w.]*)`", "\n".join(prose)):
            exists = set(name.split(".")) <= known and (not name.startswith("bpnp.") or pydoc.locate(name) is not None)
            wrong += [] if exists else [f"{file.relative_to(ROOT)}: {name}"]
    assert wrong == []
