"""Figures of the tutorial *Reproduce the paper*: run its commands and fill the page with what they give.

    python -m benchmarks tutorial    # 6 CPU minutes: tables and pictures

The commands are those that the page shows before "Change something", with one thread each. They run in a folder of
their own. A command that ended there is not run again, unless it or one before it is another now. Delete the folder to
measure all again.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from pages import is_default, markdown, publish
from paper_tables import PICTURES, effect, effect_cells, effect_head, figures, head, row_cells
from record import ROOT, measured_today, write_json

from bpnp.report.results import ProblemRow, read_results
from bpnp.report.tables import named_runs

PAGE = ROOT / "docs" / "tutorials" / "train.md"
FILE = ROOT / "benchmarks" / "tutorial.json"
END = "## Change something"
BEFORE, AFTER, COMPARED = "runs/quickstart/Lc", "runs/quickstart/LcLp", "runs/table"
DRAWN = ("curves.png", "recall.png")
RECALL = (15.0, 0.5)  # degrees, scene units
WIDTH = "88"  # of the terminal: at 80 the width of the seconds decides whether a label of the table is broken


def commands(page: str) -> list[str]:
    """Return the command lines of the page up to its last section."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", page.partition(END)[0], re.DOTALL | re.MULTILINE)
    return [line for name, block in blocks if not name for line in block.splitlines() if line.startswith("bpnp ")]


def run_commands(lines: list[str], folder: Path) -> dict[str, str]:
    """Run commands in a folder and return what each printed; one that ended there before is not run again."""
    folder.mkdir(parents=True, exist_ok=True)
    state = folder / "commands.json"
    before: dict[str, Any] = json.loads(state.read_text()) if state.is_file() else {}
    printed: dict[str, str] = before.get("printed", {})
    known = list(printed)
    same = next((i for i, line in enumerate(lines) if i >= len(known) or known[i] != line), len(lines))
    printed = {line: printed[line] for line in lines[:same]}
    measured = before["measured"] if printed else measured_today()
    environment = os.environ | {"COLUMNS": WIDTH, "OMP_NUM_THREADS": "1", "PYTHONUTF8": "1"}
    for line in lines[same:]:
        print(line, flush=True)
        words = [sys.executable, "-m", *shlex.split(line)]
        done = subprocess.run(words, cwd=folder, env=environment, stdout=subprocess.PIPE, check=True)
        printed[line] = done.stdout.decode()
        write_json(state, {"measured": measured, "printed": printed})
    return printed


def first_table(text: str) -> list[str]:
    """Return the lines of the first table that `bpnp report` prints, without the columns that did not fit."""
    lines = [line.rstrip() for line in text.splitlines()]
    start = next(i for i, line in enumerate(lines) if "Pose errors" in line)
    blank = [i for i in range(start + 2, len(lines)) if not lines[i].strip()]  # one ends the part
    part = lines[start : blank[0]] if blank else lines[start:]
    return [line for line in part if set(line.strip()) != {"─"}]


def estimates(folder: Path) -> dict[str, list[ProblemRow]]:
    """Return the rows of a results folder by estimate, `pnp` and `ransac` first."""
    rows = read_results(folder).rows
    names = sorted({row.estimate for row in rows}, key=lambda name: (name not in ("pnp", "ransac"), name))
    return {name: [row for row in rows if row.estimate == name] for name in names}


def measure(folder: Path) -> dict[str, Any]:
    """Run the commands of the page, and return the record."""
    printed = run_commands(commands(PAGE.read_text(encoding="utf-8")), folder)
    (report,) = (text for line, text in printed.items() if line.startswith("bpnp report "))
    before, after = estimates(folder / BEFORE), estimates(folder / AFTER)
    compared = {}
    for name, results in named_runs([folder / COMPARED]).items():
        found = estimates(results)
        for estimate, rows in found.items():
            compared[name if len(found) == 1 else f"{name}, `{estimate}`"] = figures(rows, RECALL)
    return {
        "measured": json.loads((folder / "commands.json").read_text())["measured"],
        "test": first_table(report),
        "effects": {name: effect(before[name], after[name], RECALL) for name in before},
        "compared": compared,
    }


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of the page by name."""
    return {
        "test": "```text\n" + "".join(f"{line}\n" for line in record["test"]) + "```\n",
        "effect": markdown(effect_head(RECALL), [effect_cells(f"`{k}`", v) for k, v in record["effects"].items()]),
        "compare": markdown(
            [name for name in head(RECALL) if name != "steps"],
            [[label, *row_cells(label, found)[2:]] for label, found in record["compared"].items()],
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "tutorial", help="(default: %(default)s)")
    parser.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    parser.add_argument("--pictures", type=Path, default=PICTURES, help="folder of the pictures (default: %(default)s)")
    chosen = parser.parse_args()
    write_json(chosen.output, measure(chosen.run))
    for name in DRAWN if is_default(parser, chosen) or not is_default(parser, chosen, "pictures") else ():
        shutil.copyfile(chosen.run / name, chosen.pictures / name)
    publish("tutorial", chosen.output)
