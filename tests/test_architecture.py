"""Rules of the whole package that no single file shows: import directions, and what only some files may do."""

import ast
import functools
import re
from collections.abc import Mapping, Set
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "bpnp"
FILES = sorted(PACKAGE.rglob("*.py"))
GROUND = {
    "argument_types",
    "arrays",
    "matching",
    "types",
    "geometry",
    "poses",
    "cameras",
    "files",
    "bounded_files",
    "metrics",
    "runtime",
    "precision",
    "checks",
}
# Parts that each part may import, in addition to itself and the ground floor.
MAY_IMPORT = {
    **dict.fromkeys(GROUND, set()),
    "search": set(),
    "layers": {"search"},
    "models": {"layers", "search"},
    "datamodules": set(),
    "maps": {"search", "models", "layers", "datamodules", "report"},
    "report": set(),
    "training": {"layers", "models", "report"},
    "commands": {"maps", "models", "search", "training", "datamodules", "report"},
    "cli": {"commands"},
    "examples": {"datamodules"},
    "__main__": {"cli"},
    "": {"maps", "models", "search"},
}
# Files of the search that reach a trained network, a picture or a COLMAP model, each imported at its first use.
BRIDGES = {
    "bpnp/search/arguments.py": {"models"},
    "bpnp/search/solvers.py": {"models"},
    "bpnp/search/propose/networks.py": {"models", "layers"},
    "bpnp/search/solution.py": {"report", "datamodules"},
}
LIGHTNING = {"training", "datamodules", "cli", "commands"}


def module(file: Path) -> str:
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part(name: str) -> str:
    """bpnp.layers.pnp belongs to the part layers, bpnp itself to the part ""."""
    return ".".join(name.split(".")[1:2])


@functools.cache
def imports(file: Path) -> frozenset[str]:
    """Modules that a file imports, anywhere in it, for its types alone too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} imports relatively"
            assert node.module is not None
            found.add(node.module)
            folder = PACKAGE.parent / Path(*node.module.split("."))
            found |= {f"{node.module}.{alias.name}" for alias in node.names if is_module(folder / alias.name)}
    return frozenset(found)


def is_module(path: Path) -> bool:
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def named(file: Path) -> str:
    return str(file.relative_to(PACKAGE.parent))


def test_imports_go_one_way() -> None:
    for file in FILES:
        own = part(module(file))
        used = {part(name) for name in imports(file) if name.startswith("bpnp.")}
        wrong = used - GROUND - MAY_IMPORT[own] - {own} - BRIDGES.get(named(file), set())
        assert not wrong, f"{named(file)} imports {wrong}"
        assert own not in GROUND or own == "metrics" or used <= GROUND


def test_lightning_is_imported_only_by_its_folders() -> None:
    for file in FILES:
        used = {name.split(".")[0] for name in imports(file)}
        assert not used & {"lightning", "pytorch_lightning"} or part(module(file)) in LIGHTNING, named(file)


def test_modules_do_not_import_in_circles() -> None:
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


def test_assertions_only_narrow_types() -> None:
    """`assert` may tell a type checker that something is not None; Python can drop it."""
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Assert):
                condition = ast.unparse(node.test)
                assert condition.endswith("is not None") or "isinstance" in condition, named(file)


def test_one_function_imports_pycolmap() -> None:
    """`import_pycolmap` imports zlib first, without which Python aborts, and restores the handler of SIGTERM."""
    for file in FILES:
        assert "pycolmap" not in imports(file) or named(file) == "bpnp/cameras.py", named(file)


def test_each_test_is_run_by_make_test_or_by_make_nightly_and_never_by_both(marks: Mapping[str, Set[str]]) -> None:
    """`.ci/run` runs both; `make check` runs a part of `make test`."""
    makefile = (PACKAGE.parent / "Makefile").read_text()
    selections = {}
    for target, calls in (("check", ["PROOFS"]), ("test", ["PROOFS", "AS_USER"]), ("nightly", ["PROOFS", "AS_USER"])):
        recipe = re.search(rf"^{target}:.*\n((\t.*\n)+)", makefile, re.MULTILINE)
        assert recipe is not None
        found = re.findall(r'\$\((PROOFS|AS_USER)\).* -m "(.*)"$', recipe[1], re.MULTILINE)
        assert [call for call, _ in found] == calls
        assert len({expression for _, expression in found}) == 1
        selections[target] = found[0][1]
        assert f"make {target}\n" in (PACKAGE.parent / ".ci" / "run").read_text() or target == "check"
    assert len(re.findall("--ignore", makefile)) == 1
    assert re.search(r"^PROOFS := .* --ignore=tests/user$", makefile, re.MULTILINE)
    assert re.search(r"^AS_USER := .* tests/user$", makefile, re.MULTILINE)
    for test, names in marks.items():
        known = {name: name in names for name in ("slow", "nightly")}
        chosen = {target for target, expression in selections.items() if eval(expression, {}, known)}
        assert chosen in ({"check", "test"}, {"test"}, {"nightly"}), f"{test} is run by {chosen}"


def test_tests_are_in_files_that_pytest_collects() -> None:
    for file in (PACKAGE.parent / "tests").rglob("*.py"):
        has_tests = re.search(r"^def test_", file.read_text(), re.MULTILINE)
        assert not has_tests or file.name.startswith("test_"), file
