"""The house rules that a reader of one file cannot see: who imports whom, and what nobody may do."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "bpnp"
FILES = sorted(PACKAGE.rglob("*.py"))

# A part imports from parts of its own row and of rows above it.
ROWS = [
    ["bpnp.geometry", "bpnp.types", "bpnp.cameras", "bpnp.files"],
    ["bpnp.layers", "bpnp.losses", "bpnp.supervision", "bpnp.metrics", "bpnp.accuracy", "bpnp.verdict"],
    ["bpnp.models"],
    ["bpnp.report"],
    ["bpnp.task", "bpnp.callbacks", "bpnp.monitors", "bpnp.api", "bpnp.solving"],
    ["bpnp.cli", "bpnp.commands", "bpnp.table", "bpnp.localization", "bpnp.__main__"],
]
ROW = {part: i for i, row in enumerate(ROWS) for part in row}
MAY_IMPORT_LIGHTNING = (
    "bpnp.task", "bpnp.callbacks", "bpnp.monitors", "bpnp.datamodules", "bpnp.cli", "bpnp.commands", "bpnp.table",
)  # fmt: skip
ONE_FILE_EACH = ("cv2", "poselib", "pycolmap", "trimesh")


def module(file: Path) -> str:
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part(name: str) -> str:
    """bpnp.layers.pnp is of the part bpnp.layers."""
    return ".".join(name.split(".")[:2])


@functools.cache
def imports(file: Path) -> set[str]:
    """Modules that a file imports, anywhere in it; `from bpnp.layers import pnp` may name a module or a function."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} imports relatively"
            assert node.module is not None
            found.add(node.module)
            if node.module == "bpnp":
                found |= {f"bpnp.{alias.name}" for alias in node.names if (PACKAGE / f"{alias.name}.py").exists()}
    return found


def named(file: Path) -> str:
    return str(file.relative_to(PACKAGE.parent))


each_file = pytest.mark.parametrize("file", FILES, ids=named)


def test_every_part_has_a_place() -> None:
    parts = {part(module(file)) for file in FILES} - {"bpnp"}
    assert parts <= {*ROW, "bpnp.datamodules"}


@each_file
def test_imports_go_one_way(file: Path) -> None:
    name = module(file)
    ours = {part(used) for used in imports(file) if used.split(".")[0] == "bpnp"}
    if name == "bpnp":
        allowed = {p for p in ROW if ROW[p] <= ROW["bpnp.api"]}
    elif part(name) == "bpnp.datamodules":
        allowed = {"bpnp.datamodules", "bpnp.geometry", "bpnp.types", "bpnp.cameras"}
    else:
        allowed = {p for p in ROW if ROW[p] <= ROW[part(name)]}
        if ROW[part(name)] == ROW["bpnp.cli"]:
            allowed.add("bpnp.datamodules")
    assert ours <= allowed


@each_file
def test_lightning_stays_at_the_top(file: Path) -> None:
    used = {name.split(".")[0] for name in imports(file)}
    assert not used & {"lightning", "pytorch_lightning"} or part(module(file)) in MAY_IMPORT_LIGHTNING


@pytest.mark.parametrize("library", ONE_FILE_EACH)
def test_one_file_knows_each_library(library: str) -> None:
    users = [named(file) for file in FILES if library in {name.split(".")[0] for name in imports(file)}]
    assert len(users) == 1


def test_modules_of_a_part_do_not_import_in_circles() -> None:
    graph = {module(file): {used for used in imports(file) if used.startswith("bpnp")} for file in FILES}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join((*path, name))
        if name not in done:
            for used in graph.get(name, set()):
                visit(used, (*path, name))
            done.add(name)

    for name in graph:
        visit(name, ())


@each_file
def test_files_are_short_and_have_names(file: Path) -> None:
    assert len(file.read_text().splitlines()) <= 250
    assert not {"utils", "util", "helpers", "helper", "misc", "common", "base"} & set(file.stem.split("_"))


@each_file
def test_only_the_command_line_prints(file: Path) -> None:
    calls = [node.func for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)]
    prints = [f for f in calls if isinstance(f, ast.Name) and f.id == "print"]
    assert not prints or module(file) == "bpnp.cli"


@each_file
def test_no_assertion_that_python_drops_decides_anything(file: Path) -> None:
    """`assert` may tell a type checker that something is not None; nothing else."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Assert):
            assert ast.unparse(node.test).endswith("is not None") or "isinstance" in ast.unparse(node.test)


def test_importing_the_package_leaves_plotting_and_logging_alone() -> None:
    heavy = ("wandb", "plotly", "matplotlib", "lightning", "trimesh", "pycolmap", "jsonargparse")
    script = f"import sys, bpnp; sys.stdout.write(' '.join(m for m in {heavy} if m in sys.modules))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout == ""
