"""Figures of the README and the guides: measure them, keep them in results.json, and fill them into the tables.

    python -m benchmarks results                  # measure all (hours), write results.json and the tables
    python -m benchmarks results --only leds      # the rows of one table
    python -m benchmarks results --quick --check  # compare few problems per row (minutes) with results.json

`ROWS` lists the rows. --check draws the problems of results.json again, with the seed of each row; it writes nothing,
and the exit status is 1 if a figure is outside the tolerance or a table differs from results.json. Times are shown and
not compared. Rows whose data are missing are named and skipped.
"""

import argparse
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bench_rigs
import bench_stars
import leds
import record
import shapes
import torch
from record import ROOT, Outcome, Problem, measure_rows, parser, write
from view_problems import REPORTED, photos

from bpnp.datamodules import MeshDataModule, Outliers
from bpnp.metrics import rotation_error, translation_error
from bpnp.models import TrainedNet

FILE = ROOT / "benchmarks" / "results.json"
SEEDS = {"quick": 9, "full": 506}  # defaults
DOCUMENTS = (ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in ("results", "solve", "stars")))
COLUMNS = ("data", "problems", "rotation, deg (quartiles)", "success", "confident", "confident but wrong", "CPU s")
# What may differ between two runs of a row, on another machine and with other libraries: problems that are right or
# confident, and the ratio of the median errors where one exceeds FLOOR_DEG.
PROBLEMS, MEDIAN, FLOOR_DEG = 1, 1.5, 0.05
NAMED = {"maps": "photo ", "leds": "LEDs: "}  # what the README's rows of a table begin with
TABLE = r"<!-- results: {} -->\n(.*?)<!-- end of results -->"


@dataclass(frozen=True)
class Row:
    """Row of a table."""

    table: str
    name: str
    measure: Callable[[int, int, Path], Iterable[Problem | Outcome]]  # of a number of problems, a seed and the data
    problems: tuple[int, int]  # in full, and quickly
    right_deg: float
    right_shift: float = float("inf")
    data: str = ""  # folder in that of the data that it needs
    in_readme: bool = False


def lights(name: str, limit: int, seed: int, _: Path) -> Iterator[Problem]:
    return leds.problems(name, limit, seed)


def network(weights: str, options: dict[str, Any], limit: int, seed: int, data: Path) -> Iterator[Outcome]:
    """Test packaged weights on meshes or, without `root`, on procedural shapes."""
    settings = {"num_points": 1000, "test_problems": limit, "test_shapes": limit, "batch_size": 1, "seed": seed}
    module = MeshDataModule(**settings | options | {"root": str(data / options["root"]) if "root" in options else None})
    module.setup("test")
    net = TrainedNet.from_pretrained(weights).eval()
    for batch in module.test_dataloader():
        start = time.process_time()
        with torch.no_grad():
            pose = net(batch).poses["refined"]
        seconds = time.process_time() - start
        angle = float(rotation_error(pose.rotation, batch.rotation).nan_to_num(nan=180.0))
        shift = float(translation_error(pose.translation, batch.translation).nan_to_num(nan=torch.inf))
        yield Outcome(batch.ids[0], angle, shift, "", seconds)


def of_benchmark(
    rows: Callable[[argparse.Namespace], Iterable[record.Row]], name: str, limit: int, seed: int, data: Path
) -> Iterable[Problem | Outcome]:
    """Return the problems of a row of another benchmark."""
    options = argparse.Namespace(limit=limit, seed=seed, data=data, scenes=REPORTED, peers=False)
    return next(row for row in rows(options) if row.name == name).draw()


PAPER = (15.0, 0.5)  # degrees and scene units
IN_README = ("ring, 3 lights", "headset, 3 lights", "drone, 3 lights")
ROWS = (
    *(
        Row("search", f"shapes, any rotation, {ratio:g} outliers a match",
            partial(shapes.problems, "shapes", ratio), (48, 4), 2.0, in_readme=ratio == 0.25)
        for ratio in (0, 0.25, 0.5)
    ),
    Row("search", "PSB meshes, the paper's protocol", partial(shapes.problems, "psb", 0), (100, 3), *PAPER, "psb",
        in_readme=True),
    Row("search", "PSB meshes, any rotation", partial(shapes.problems, "psb-so3", 0), (100, 3), *PAPER, "psb"),
    Row("search", "PSB meshes, 0.5 outliers a match", partial(shapes.problems, "psb", 0.5), (100, 3), *PAPER, "psb"),
    *(
        Row("search", f"photos, {name}", partial(shapes.problems, "photos", ratio), (100, 5), 1.0, data="colmap")
        for name, ratio in (("the points that they see", 0), ("0.5 outliers a match", 0.5))
    ),
    Row("maps", "left out of its map, view given", partial(photos, "best view", 1.0), (48, 5), 1.0,
        data="colmap"),
    Row("maps", "left out of its map, no view given", partial(photos, "map", 1.0), (58, 5), 1.0, data="colmap",
        in_readme=True),
    *(
        Row("maps", f"points of one view, no prior, {outliers:.0%} outliers a side",
            partial(photos, "view", outliers, in_map=False), (48, 5), 1.0, data="colmap")
        for outliers in (0.5, 0.75, 1.0)
    ),
    Row("maps", "of another place", partial(photos, "view", 1.0, apart=True), (18, 4), 0.0, data="colmap",
        in_readme=True),
    *(
        Row("leds", name, partial(lights, name), (300, 20), 3.0, in_readme=name in IN_README)
        for name in ("ring, 3 lights", "ring, 8 lights, 20 % missing", "headset, 3 lights",
                     "headset, 8 lights, 20 % missing", "ring, no normals, 3 lights", "drone, 3 lights")
    ),
    *(
        Row("rigs", name, partial(of_benchmark, bench_rigs.rows, name), (60, 3), bench_rigs.RIGHT_DEG)
        for name in ("LEDs, one camera", "LEDs, 2 cameras", "LEDs, 4 cameras", "LEDs, 2 cameras, scale unknown",
                     "LEDs, 4 cameras, scale unknown")
    ),
    *(
        Row("stars", f"{count:,} stars, {field:.0f} deg",
            partial(of_benchmark, bench_stars.rows, f"{count}, {field:.0f} deg"), (170, 4), bench_stars.RIGHT_DEG)
        for count in bench_stars.CATALOGUES for field in bench_stars.FIELDS
    ),
    Row("networks", "`procedural-euler`, PSB meshes, the paper's protocol",
        partial(network, "procedural-euler", {"root": "psb", "rotation": "euler"}), (100, 3), *PAPER, "psb", True),
    Row("networks", "`procedural-so3`, PSB meshes, any rotation",
        partial(network, "procedural-so3", {"root": "psb", "rotation": "so3"}), (100, 3), *PAPER, "psb"),
    Row("networks", "`procedural-so3`, procedural shapes, any rotation",
        partial(network, "procedural-so3", {"rotation": "so3"}), (100, 3), *PAPER),
    Row("networks", "`matcher-clutter`, PSB meshes, 0.5 outliers a match",
        partial(network, "matcher-clutter", {"root": "psb", "rotation": "euler",
        "test_outliers": Outliers(ratio=0.5)}), (40, 2), *PAPER, "psb"),
)  # fmt: skip


def key(row: Row) -> str:
    return f"{row.table}: {row.name}"


def rows(options: argparse.Namespace, seeds: Mapping[str, int]) -> Iterator[record.Row]:
    """Return the chosen rows; `seeds` has those that differ from the default seed."""
    for row in ROWS:
        if not any(part in key(row) for part in options.only):
            continue
        if row.data and not (options.data / row.data).is_dir():
            print(f"{key(row)}: left out, needs {options.data / row.data}", flush=True)
            continue
        seed = seeds.get(key(row), options.seed)
        drawn = partial(row.measure, row.problems[options.quick], seed, options.data)
        yield record.Row(key(row), drawn, row.right_deg, row.right_shift)


def differences(new: dict[str, Any], old: dict[str, Any]) -> list[str]:
    """List the figures of a row that are outside the tolerance."""
    if new["problems"] != old["problems"] or new["seed"] != old["seed"]:
        return [f"{new['problems']} problems of seed {new['seed']}, not {old['problems']} of {old['seed']}"]
    found, share = [], PROBLEMS / new["problems"] + 1e-3
    for name in ("right", "confident"):
        if new[name] is not None and abs(new[name] - old[name]) > share:
            found.append(f"{name} {new[name]:.2f}, not {old[name]:.2f} within {share:.2f}")
    low, high = sorted(result["rotation_q_deg"][1] for result in (new, old))
    if old["right"] > 0.5 and high > max(MEDIAN * low, FLOOR_DEG):
        found.append(f"median {new['rotation_q_deg'][1]:.3g} deg, not {old['rotation_q_deg'][1]:.3g}")
    if new["confident_and_wrong"] > old["confident_and_wrong"]:
        found.append(f"{new['confident_and_wrong']} confident and wrong, not {old['confident_and_wrong']}")
    return found


def table(name: str, results: dict[str, Any]) -> str | None:
    """Return the Markdown of a table, or of the README's rows; None unless all its rows are measured."""
    rows = [row for row in ROWS if (row.in_readme if name == "readme" else row.table == name)]
    if not rows or any(key(row) not in results for row in rows):
        return None
    lines = [COLUMNS, ("---",) * len(COLUMNS)]
    for row in rows:
        result = results[key(row)]
        quartiles = " / ".join(f"{q:.2g}" if q < 10 else f"{q:.0f}" for q in result["rotation_q_deg"])
        where = f"{row.right_deg:g} deg" + (f", {row.right_shift:g}" if row.right_shift < 1e9 else "")
        right = f"{result['right']:.1%} ({where})" if row.right_deg else "n/a"
        sure = "" if result["confident"] is None else f"{result['confident']:.1%}"
        wrong = "" if result["confident"] is None else str(result["confident_and_wrong"])
        of = NAMED.get(row.table, "") if name == "readme" else ""
        lines.append((of + row.name, str(result["problems"]), quartiles if row.right_deg else "", right, sure, wrong,
                      f"{result['cpu_seconds']:.2g}"))  # fmt: skip
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def fill_tables(text: str, results: dict[str, Any]) -> str:
    """Return a document with the tables between its markers; a table with a row that is not measured is kept."""

    def replace_table(match: re.Match[str]) -> str:
        new = table(match[1], results)
        return match[0] if new is None else f"<!-- results: {match[1]} -->\n{new}<!-- end of results -->"

    return re.sub(TABLE.format("([a-z]+)"), replace_table, text, flags=re.DOTALL)


def main() -> None:
    options = parser(__doc__)
    options.set_defaults(seed=None)
    options.add_argument("--quick", action="store_true", help="few problems a row")
    options.add_argument("--check", action="store_true", help="compare, write nothing")
    options.add_argument("--file", type=Path, default=FILE, help="(default: benchmarks/results.json)")
    chosen = options.parse_args()
    kept = json.loads(chosen.file.read_text()) if chosen.file.is_file() else {}
    part = "quick" if chosen.quick else "full"
    results: dict[str, Any] = kept.get(part, {})
    seeds = {name: old["seed"] for name, old in results.items()} if chosen.check and chosen.seed is None else {}
    chosen.seed = SEEDS[part] if chosen.seed is None else chosen.seed
    failures = []
    for row, found, _ in measure_rows(rows(chosen, seeds)):
        result = found | {"seed": seeds.get(row.name, chosen.seed)}
        if chosen.check:
            old = results.get(row.name)
            bad = ["never measured"] if old is None else differences(result, old)
            failures += [f"{row.name}: {reason}" for reason in bad]
            continue
        results[row.name] = result
        write(chosen.file, {name: kept.get(name, {}) for name in ("quick", "full")} | {part: results})
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        if (new := fill_tables(text, results if part == "full" else kept.get("full", {}))) == text:
            continue
        if chosen.check:
            failures.append(f"{document.name}: a table is not that of {chosen.file.name}; try without --check")
        else:
            document.write_text(new, encoding="utf-8")
    if failures:
        sys.exit("\n".join(failures))
