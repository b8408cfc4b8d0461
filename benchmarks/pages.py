"""Tables of the README and the guides, from the records of the benchmarks.

    python -m benchmarks pages            # write the tables of all records into the pages
    python -m benchmarks pages --check    # exit with status 1 if a page has another table

A table stands between `<!-- BENCHMARK: TABLE -->` and `<!-- end of BENCHMARK -->`. The benchmark has `FILE`, its record
in JSON, and `tables`, which makes the tables of a record. A link to <BENCHMARK>.csv or <BENCHMARK-PART>.csv is a file
beside the page, which its `sheets` makes. Each benchmark ends with `publish`.
"""

import argparse
import csv
import importlib
import io
import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from record import ROOT

from bpnp.files import write_text

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
TABLE = re.compile(r"<!-- (\w+): ([a-z0-9-]+) -->\n(.*?)<!-- end of \1 -->", re.DOTALL)

SHEET = re.compile(r"\]\((\w+?)((?:-\w+)?)\.csv\)")


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (head, ["---"] * len(head), *rows))


def comma_separated(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows in CSV, a column for each name."""
    out = io.StringIO()
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def benchmark(name: str) -> Any:
    """Return the module of a benchmark with a record."""
    here = Path(__file__).parent
    return importlib.import_module(name if (here / f"{name}.py").is_file() else f"bench_{name}")


def fill(text: str, tables: Mapping[str, Mapping[str, str]]) -> str:
    """Return a page with the tables by benchmark and name; one that no record has is kept."""

    def replace(found: re.Match[str]) -> str:
        name, title, old = found.groups()
        return f"<!-- {name}: {title} -->\n{tables[name].get(title, old)}<!-- end of {name} -->"

    return TABLE.sub(replace, text)


def write_pages(*, check: bool = False) -> None:
    """Write the tables of all records into the pages; with `check`, exit if that would change one."""
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    shown = {page: [found.groups()[:2] for found in TABLE.finditer(text)] for page, text in texts.items()}
    linked = {(page.parent, found[1], found[2]) for page, text in texts.items() for found in SHEET.finditer(text)}
    names = {name for found in shown.values() for name, _ in found} | {name for _, name, _ in linked}
    modules = {name: benchmark(name) for name in sorted(names)}
    records = {name: json.loads(module.FILE.read_text()) for name, module in modules.items()}
    tables = {name: module.tables(records[name]) for name, module in modules.items()}
    wrong = []
    for page, text in texts.items():
        unknown = [f"{name}: {title}" for name, title in shown[page] if title not in tables[name]]
        wrong += [f"{page.name} has tables that are not in their record: {', '.join(unknown)}"] if unknown else []
        if (new := fill(text, tables)) != text:
            wrong.append(f"{page.name} has other tables than the records; try `python -m benchmarks pages`")
            if not check:
                write_text(page, new)
    for folder, name, part in sorted(linked):
        file, new = folder / f"{name}{part}.csv", modules[name].sheets(records[name])[part]
        if not file.is_file() or file.read_text(encoding="utf-8") != new:
            wrong.append(f"{file.name} has other figures than the record; try `python -m benchmarks pages`")
            if not check:
                write_text(file, new)
    if check and wrong:
        sys.exit("\n".join(wrong))


def publish(name: str, output: Path) -> None:
    """Write the pages if a benchmark measured the record that they show; print the tables of another record."""
    module = benchmark(name)
    if output.resolve() == module.FILE.resolve():
        write_pages()
    else:
        print("\n\n".join(f"{title}\n{text}" for title, text in module.tables(json.loads(output.read_text())).items()))


def is_default(parser: argparse.ArgumentParser, chosen: argparse.Namespace, option: str = "output") -> bool:
    """Return whether the path of an option is its default: that of the record or the pictures of the pages."""
    return bool(getattr(chosen, option).resolve() == parser.get_default(option).resolve())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    write_pages(check=parser.parse_args().check)
