"""List the benchmarks (`python -m benchmarks`) or run one; `python -m benchmarks NAME --help` shows its options."""

import ast
import importlib
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def programs() -> dict[str, tuple[str, str]]:
    """Return module and first sentence of each benchmark, a module that has a `main`, by name."""
    found = {}
    for file in sorted(FOLDER.glob("[a-z]*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            sentence = (ast.get_docstring(tree) or "").split("\n\n")[0].replace("\n", " ")
            found[file.stem.removeprefix("bench_")] = file.stem, sentence
    return found


def main() -> None:
    commands = programs()
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in commands:
        width = max(map(len, commands))
        print("python -m benchmarks NAME [OPTION...]\n")
        print("\n".join(f"  {key:{width}}  {sentence}" for key, (_, sentence) in commands.items()))
        if name and not name.startswith("-"):
            raise SystemExit(f"\n{name!r} is not in this list")
        return
    sys.path.insert(0, str(FOLDER))
    sys.argv = [f"python -m benchmarks {name}", *sys.argv[2:]]
    importlib.import_module("record").commit()
    importlib.import_module(commands[name][0]).main()


if __name__ == "__main__":
    main()
