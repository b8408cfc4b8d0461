"""Python examples of the guides: each runs in an empty namespace, or a comment says where its inputs come from."""

import builtins
import re
import symtable
from pathlib import Path

import pytest
from report_data import rows

from bpnp.report import write_results

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
# Of the other pages, data.md has a test of its own, and maps.md needs photos.
RUN = ("index", "layers", "model-card", "report", "solve", "train", "verdict")
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def examples(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def undefined_names(code: str) -> set[str]:
    """Return the names that the code uses and neither defines nor imports."""
    top = symtable.symtable(code, "guide", "exec")
    defined = {each.get_name() for each in top.get_symbols() if each.is_assigned() or each.is_imported()}
    used: set[str] = set()
    tables = [top]
    while tables:
        table = tables.pop()
        tables += table.get_children()
        is_free = table is top
        used |= {
            each.get_name() for each in table.get_symbols() if each.is_referenced() and (is_free or each.is_global())
        }
    return {name for name in used - defined if not hasattr(builtins, name)}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_a_comment_names_the_inputs_of_an_example(page: Path) -> None:
    for code in examples(page):
        comments = " ".join(line for line in code.splitlines() if line.startswith("# "))
        unnamed = {name for name in undefined_names(code) if not re.search(rf"\b{name}\b", comments)}
        assert unnamed == set(), f"{page.name}: {unnamed} in\n{code}"


@pytest.mark.nightly
@pytest.mark.parametrize("name", RUN)
def test_the_examples_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line that prints shows the output in its comment, or has none."""
    monkeypatch.chdir(tmp_path)
    if name == "report":  # results that the quickstart writes
        write_results(tmp_path / "runs" / "quickstart" / "LcLp", rows(8, seed=0))
    codes = [code for code in examples(ROOT / "docs" / f"{name}.md") if not undefined_names(code)]
    assert codes
    for code in codes:
        capsys.readouterr()
        exec(compile(code, f"{name}.md", "exec"), {"__name__": "__main__"})
        if shown := re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE):
            assert capsys.readouterr().out.splitlines() == shown


def test_undefined_names_are_found() -> None:
    """In functions too, and not those of modules, loops, and functions that the code defines."""
    assert undefined_names("import os\nfor i in range(3):\n    print(os, i, a)") == {"a"}
    assert undefined_names("def f(x):\n    return x + y\n\n\nclass C:\n    z = f\n\n\nprint(C)") == {"y"}
