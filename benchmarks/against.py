"""This tree against an older commit: the same rows, one after the other in turns, so that both meet the same machine.

    python benchmarks --against f588af6 [--sets psb castle-P30-0.50] [--limit 10] [--rounds 1] [--data ../shared/data]

Each tree runs its own `bench_search.py` and `bench_layers.py`, so the commit may have another interface inside; the
older one is checked out under a temporary folder, which is removed. A row is marked where this tree takes 10 % more
processor time, or where its share is 0.05 worse.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
SETS = ("psb", "psb-0.50", "castle-P30", "south_building", "castle-P30-0.50", "south_building-0.50", "walkthrough-0.50")
SLOWER, WORSE = 1.1, 0.05


class Row(NamedTuple):
    """One figure of both trees. is_time: in seconds or milliseconds, else a share, of which more is better."""

    name: str
    old: float
    new: float
    is_time: bool

    @property
    def is_worse(self) -> bool:
        return self.new > SLOWER * self.old if self.is_time else self.new < self.old - WORSE


@contextmanager
def checked_out(revision: str, root: Path = ROOT) -> Iterator[Path]:
    """A folder with the files of a commit of the repository `root`."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "-C", root, "worktree", "add", "--quiet", "--detach", tree, revision], check=True)
        try:
            yield tree
        finally:
            subprocess.run(["git", "-C", root, "worktree", "remove", "--force", tree], check=True)


def figures(tree: Path, script: str, *arguments: str, into: str) -> dict[tuple[str, bool], float]:
    """What a benchmark of a tree writes: each figure by its name, and whether it is a time."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "figures.json"
        command = [sys.executable, f"benchmarks/{script}", *arguments, into, str(file)]
        subprocess.run(command, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree)}, check=True, stdout=sys.stderr)
        content = json.loads(file.read_text())
    if "rows" in content:  # of the layers
        return {
            (f"{row['what']}, {row['inputs']}, B={row['batch']}: CPU ms", True): row["race"]["ours"]["cpu"]["median"]
            for row in content["rows"]
        }
    found = {}
    for name, row in content.items():
        found[f"{name}: CPU s", True] = row["cpu_seconds_mean"]
        for share in ("under_2_deg", "recall_15_deg_0.5", "confident"):
            found[f"{name}: {share}", False] = row[share]
        found[f"{name}: not wrong by 5 deg", False] = 1 - row["confident_over_5_deg"] / row["pairs"]
    return found


def in_turns(old: Path, new: Path, rounds: int, script: str, *arguments: str, into: str) -> list[Row]:
    """The figures of both trees, medians over the rounds; those that only one of them has are left out."""
    runs = [[figures(tree, script, *arguments, into=into) for tree in (old, new)] for _ in range(rounds)]
    names = [name for name in runs[0][1] if name in runs[0][0]]
    middle = [[median(run[side][name] for run in runs) for side in (0, 1)] for name in names]
    return [Row(name, was, now, is_time) for (name, is_time), (was, now) in zip(names, middle, strict=True)]


def show(rows: Sequence[Row], title: str) -> None:
    table = Table("", "old", "new", "new / old", "", title=title)
    for row in rows:
        ratio = f"{row.new / row.old:.2f}" if row.is_time and row.old else ""
        table.add_row(row.name, f"{row.old:.3g}", f"{row.new:.3g}", ratio, "worse" if row.is_worse else "")
    Console(width=None if Console().is_terminal else 120).print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", required=True, metavar="REV", help="an older commit")
    parser.add_argument("--sets", nargs="*", default=SETS, help="of bench_search.py; none to leave the search out")
    parser.add_argument("--limit", type=int, default=10, help="pairs a set")
    parser.add_argument("--rounds", type=int, default=1, help="turns of each tree; medians are shown")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--layers", action="store_true", help="the layers too")
    options = parser.parse_args(arguments)
    search = ("--data", str(options.data.resolve()), "--limit", str(options.limit))
    rows: list[Row] = []
    with checked_out(options.against) as old:
        for name in options.sets:
            rows += in_turns(old, ROOT, options.rounds, "bench_search.py", name, *search, into="--output")
        if options.layers:
            rows += in_turns(old, ROOT, options.rounds, "bench_layers.py", "--rounds", "3", into="--out")
    show(rows, f"{options.against} and this tree, {options.limit} pairs a set")
