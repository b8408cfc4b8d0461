"""Figures of the README and the guides: measure them, keep them in results.json, and fill them into the tables.

    python -m benchmarks results                  # measure all (hours), write results.json and the tables
    python -m benchmarks results --only leds:     # the rows of one table
    python -m benchmarks results --quick --check  # compare few problems per row (minutes) with results.json

`ROWS` lists the rows. The default seed is that of the row, and 9 with --quick. --check draws the problems of the file
again, with the seed of each row; it writes nothing, and the exit status is 1 if a figure is outside the tolerance.
Searches that their time limit ends, 10 seconds or 60, find less on a busy machine. Times
are shown and not compared. Rows whose data are missing are named and skipped.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bench_rigs
import leds
import numpy as np
import record
import reliability
import shapes
import symmetric
import torch
from hard_scenes import SCENES
from pages import comma_separated, is_default, markdown, write_pages
from paper_tables import network
from record import ROOT, TIME_LIMIT, Outcome, Problem, measure_rows, measured_today, parser, select, write
from torch import nn
from view_problems import REPORTED, photos

from bpnp.datamodules import MeshDataModule, Outliers
from bpnp.metrics import rotation_error, translation_error
from bpnp.models import Search, TrainedNet
from bpnp.models.baselines import GOPAC, GOSMA, Hungarian, RandomRansac, SoftPOSIT
from bpnp.models.weights import checkpoint_path

FILE = ROOT / "benchmarks" / "results.json"
SEED, NETWORKS_SEED, RELIABILITY_SEED, QUICK_SEED = 1711, 506, 1811, 9
COLUMNS = ("data", "problems", "rotation, deg (quartiles)", "success", "confident", "confident but wrong", "CPU s")
# What may differ between two runs of a row, on another machine and with other libraries: problems that are right or
# confident, and the ratio of the median errors where one exceeds FLOOR_DEG.
PROBLEMS, MEDIAN, FLOOR_DEG = 1, 1.5, 0.05


@dataclass(frozen=True)
class Row:
    """Row of a table."""

    table: str
    name: str
    measure: Callable[[int, int, Path], Iterable[Problem | Outcome]]  # of a number of problems, a seed and the data
    problems: tuple[int, int]  # in full, and quickly; with 0 only in full
    right_deg: float
    right_shift: float = float("inf")
    data: str = ""  # folder in that of the data that it needs
    seed: int = SEED  # of all problems
    right_moved: float = float("inf")


def lights(name: str, limit: int, seed: int, _: Path) -> Iterator[Problem]:
    return leds.problems(name, limit, seed)


def estimates(
    build: Callable[[], nn.Module], estimate: str, options: dict[str, Any], limit: int, seed: int, data: Path
) -> Iterator[Outcome]:
    """Test an estimate of a solver on meshes or, without `root`, on procedural shapes."""
    settings = {"num_points": 1000, "test_problems": limit, "test_shapes": limit, "batch_size": 1, "seed": seed}
    module = MeshDataModule(**settings | options | {"root": str(data / options["root"]) if "root" in options else None})
    module.setup("test")
    solver = build().eval()
    with torch.no_grad():
        solver(next(iter(module.test_dataloader())))  # the first call also loads and compiles
    for batch in module.test_dataloader():
        start = time.process_time()
        with torch.no_grad():
            pose = solver(batch).poses[estimate]
        seconds = time.process_time() - start
        angle = float(rotation_error(pose.rotation, batch.rotation).nan_to_num(nan=180.0))
        shift = float(translation_error(pose.translation, batch.translation).nan_to_num(nan=torch.inf))
        yield Outcome(batch.ids[0], angle, shift, "", seconds)


def of_benchmark(
    rows: Callable[[argparse.Namespace], Iterable[record.Row]], name: str, limit: int, seed: int, data: Path
) -> Iterable[Problem | Outcome]:
    """Return the problems of a row of another benchmark."""
    options = argparse.Namespace(
        limit=limit, seed=seed, data=data, scenes=REPORTED, peers=False,
        factors=reliability.FACTORS, time_limit=TIME_LIMIT,
    )  # fmt: skip
    return next(row for row in rows(options) if row.name == name).draw()


def pretrained(weights: str, options: dict[str, Any]) -> Callable[[int, int, Path], Iterator[Outcome]]:
    return partial(estimates, partial(TrainedNet.from_pretrained, weights), "refined", options)


def sinkhorn() -> nn.Module:
    """Return `paper-lclp` with the inference of the paper."""
    return network(checkpoint_path("paper-lclp"))


def hungarian() -> nn.Module:
    """Return the same with the Hungarian algorithm in place of Sinkhorn."""
    return Hungarian(net=network(checkpoint_path("paper-lclp")), ransac_backend="opencv")


@dataclass(frozen=True)
class Line:
    """Line of the table of reliability: some rows of that benchmark together."""

    name: str
    rows: Sequence[str]
    problems: tuple[int, int]  # of each row; photos: of each scene
    data: str = ""
    solvable: bool = True  # False if some of its problems have no single correct pose


def of_symmetric(*unique: int) -> list[str]:
    """Return the rows of objects with these numbers of unique points."""
    return [f"symmetric, {kind.label}" for kind in symmetric.KINDS if kind.unique in unique]


WRONG_FOCAL = [f"hard, {draw.__name__}" for draw in SCENES if "focal" in draw.__name__]
RELIABILITY = (
    Line("LEDs of rings, headsets, drones and markers, 18 settings", [f"leds, {name}" for name in leds.SETTINGS],
         (170, 3)),
    Line("shapes, any rotation, 0 to 0.5 outliers a match",
         [f"shapes, {ratio} outliers a match" for ratio in ("0", "0.25", "0.5")], (24, 0)),
    Line("photos against one view, 0 to 100 % outliers a side",
         [f"photos, {outliers}% outliers" for outliers in (0, 25, 50, 75, 100)], (6, 0), "colmap"),
    Line("photos left out of their map, no view given", ["maps"], (6, 0), "colmap"),
    Line("hard scenes: repetitions, lines, clumps, stairs, boards, hinged and stretched objects",
         [name for draw in SCENES if (name := f"hard, {draw.__name__}") not in WRONG_FOCAL], (5, 0), solvable=False),
    Line("clouds and planes, focal length 0.5 to 2 times the true one", WRONG_FOCAL, (5, 0), solvable=False),
    Line("exactly symmetric objects", of_symmetric(0), (14, 0), solvable=False),
    Line("objects of 2 to 6 equal parts and 3 or 4 unique points", of_symmetric(3, 4), (14, 0)),
    Line("objects of 2 to 6 equal parts and 8 or 12 unique points, up to 20 % outliers", of_symmetric(8, 12), (14, 0)),
    *(Line(f"LEDs that a half turn nearly maps onto each other, {normals} normals", [f"devices, {normals} normals"],
           (600, 20)) for normals in ("with", "without")),
)  # fmt: skip
# Rows whose mean the table of errors in standard deviations shows, over all correct poses.
SIGMAS = {
    "LEDs": ("leds: ",),
    "photos against one view": ("maps: points of one view",),
    "shapes among outliers": ("search: shapes, any rotation, 0.25", "search: shapes, any rotation, 0.5"),
}
PAPER = (15.0, 0.5)  # degrees and scene units
FEW = (8, 16)  # points of each side
BOXES, TRIPLES = 1_000_000, 20_000  # limits of GOPAC and of RANSAC; GOSMA searches a fiftieth of these boxes
METHODS: tuple[tuple[str, str, Callable[[], nn.Module]], ...] = (
    ("gopac", "gopac", partial(GOPAC, max_boxes=BOXES, time_limit=None)),
    ("gosma", "gosma", partial(GOSMA, max_boxes=BOXES // 50, time_limit=None)),
    ("ransac", "random_ransac", partial(RandomRansac, max_hypotheses=TRIPLES, time_limit=None)),
    ("softposit", "softposit", partial(SoftPOSIT, start="random", time_limit=None)),
    ("search", "search", partial(Search, time_limit=None)),
)
ROWS = (
    *(
        Row("search", f"shapes, any rotation, {ratio:g} outliers a match",
            partial(shapes.problems, "shapes", ratio), (48, 4), 2.0)
        for ratio in (0, 0.25, 0.5)
    ),
    Row("search", "PSB meshes, the paper's protocol", partial(shapes.problems, "psb", 0), (100, 3), *PAPER, "psb"),
    Row("search", "PSB meshes, any rotation", partial(shapes.problems, "psb-so3", 0), (100, 3), *PAPER, "psb"),
    Row("search", "PSB meshes, 0.5 outliers a match", partial(shapes.problems, "psb", 0.5), (100, 3), *PAPER, "psb"),
    *(
        Row("search", f"photos, {name}", partial(shapes.problems, "photos", ratio), (100, 5), 1.0, data="colmap")
        for name, ratio in (("the points that they see", 0), ("0.5 outliers a match", 0.5))
    ),
    Row("maps", "left out of its map, view given", partial(photos, "best view", 1.0, time_limit=TIME_LIMIT), (48, 5),
        1.0, data="colmap"),
    Row("maps", "left out of its map, no view given", partial(photos, "map", 1.0, time_limit=TIME_LIMIT), (58, 5), 1.0,
        data="colmap"),
    *(
        Row("maps", f"points of one view, no prior, {outliers:.0%} outliers a side",
            partial(photos, "view", outliers, in_map=False), (48, 5), 1.0, data="colmap")
        for outliers in (0.5, 0.75, 1.0)
    ),
    Row("maps", "of another place", partial(photos, "view", 1.0, apart=True, time_limit=TIME_LIMIT), (18, 4),
        0.0, data="colmap"),
    *(
        Row("leds", name, partial(lights, name), (300, 20), 3.0)
        for name in ("ring, 3 lights", "ring, 8 lights, 20 % missing", "headset, 3 lights",
                     "headset, 8 lights, 20 % missing", "ring, no normals, 3 lights", "drone, 3 lights")
    ),
    *(
        Row("rigs", name, partial(of_benchmark, bench_rigs.rows, name), (60, 3), bench_rigs.RIGHT_DEG)
        for name in ("LEDs, one camera", "LEDs, 2 cameras", "LEDs, 4 cameras", "LEDs, 2 cameras, scale unknown",
                     "LEDs, 4 cameras, scale unknown")
    ),
    Row("networks", "`procedural-euler`, PSB meshes, the paper's protocol",
        pretrained("procedural-euler", {"root": "psb", "rotation": "euler"}), (100, 3), *PAPER, "psb",
        seed=NETWORKS_SEED),
    Row("networks", "`procedural-so3`, PSB meshes, any rotation",
        pretrained("procedural-so3", {"root": "psb", "rotation": "so3"}), (100, 3), *PAPER, "psb",
        seed=NETWORKS_SEED),
    Row("networks", "`procedural-so3`, procedural shapes, any rotation",
        pretrained("procedural-so3", {"rotation": "so3"}), (100, 3), *PAPER, seed=NETWORKS_SEED),
    Row("networks", "`matcher-clutter`, PSB meshes, 0.5 outliers a match",
        pretrained("matcher-clutter", {"root": "psb", "rotation": "euler",
        "test_outliers": Outliers(ratio=0.5)}), (40, 2), *PAPER, "psb", seed=NETWORKS_SEED),
    *(
        Row("labels", name, partial(of_benchmark, reliability.rows, f"labels, {kind}"), (100, 4), reliability.RIGHT_DEG,
            right_moved=reliability.RIGHT_MOVED)
        for name, kind in (("class probabilities", "probabilities"), ("likeliest class", "likeliest"),
                           ("no labels", "none"))
    ),
    *(
        Row("reliability", name, partial(of_benchmark, reliability.rows, name), line.problems, reliability.RIGHT_DEG,
            data=line.data, seed=RELIABILITY_SEED, right_moved=reliability.RIGHT_MOVED)
        for line in RELIABILITY for name in line.rows
    ),
    *(
        Row("assignments", f"{name}, `{estimate}`", partial(estimates, build, estimate, {"root": "psb"}), (100, 2),
            *PAPER, "psb")
        for name, build in (("Sinkhorn", sinkhorn), ("Hungarian", hungarian)) for estimate in ("ransac", "pnp")
    ),
    *(
        Row("methods", f"`{name}`, {few} points", partial(estimates, build, estimate, {"num_points": few}), (5, 1),
            *PAPER)
        for few in FEW for name, estimate, build in METHODS
    ),
)  # fmt: skip


def key(row: Row) -> str:
    return f"{row.table}: {row.name}"


def seed_of(row: Row, options: argparse.Namespace, results: dict[str, Any]) -> int:
    """Return the given seed, else in a check that of the record, else that of the row or of a quick run."""
    if options.seed is not None:
        return int(options.seed)
    if options.check and key(row) in results:
        return int(results[key(row)]["seed"])
    return QUICK_SEED if options.quick else row.seed


def rows(options: argparse.Namespace, seeds: dict[str, int]) -> Iterator[record.Row]:
    """Return the chosen rows; `seeds` has the seed of each."""
    for row in select(ROWS, options.only, key):
        if not row.problems[options.quick]:
            continue
        if row.data and not (options.data / row.data).is_dir():
            print(f"{key(row)}: left out, needs {options.data / row.data}", flush=True)
            continue
        drawn = partial(row.measure, row.problems[options.quick], seeds[key(row)], options.data)
        yield record.Row(key(row), drawn, row.right_deg, row.right_shift, row.right_moved)


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
    """Return the Markdown of a table with its command and seeds; None unless all its rows are measured."""
    rows = [row for row in ROWS if in_table(row, name)]
    if not rows or any(key(row) not in results for row in rows):
        return None
    lines = {"reliability": reliability_table, "sigmas": sigmas_table}.get(name, partial(rows_table, name))(results)
    text = markdown(lines[0], lines[1:])
    parts = " ".join(dict.fromkeys(f"{row.table}:" for row in rows))
    seeds = ", ".join(sorted({str(results[key(row)]["seed"]) for row in rows}))
    return f"{text}\n`python -m benchmarks results --only {parts}`, seed {seeds}.\n"


def in_table(row: Row, name: str) -> bool:
    if name == "sigmas":
        return any(key(row).startswith(starts) for starts in SIGMAS.values())
    return row.table == name


def rows_table(name: str, results: dict[str, Any]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = [COLUMNS]
    for row in (row for row in ROWS if in_table(row, name)):
        result = results[key(row)]
        quartiles = " / ".join(f"{q:.2g}" if q < 10 else f"{q:.0f}" for q in result["rotation_q_deg"])
        where = f"{row.right_deg:g} deg" + (f", {row.right_shift:g}" if row.right_shift < 1e9 else "")
        right = f"{result['right']:.1%} ({where})" if row.right_deg else "n/a"
        sure = "" if result["confident"] is None else f"{result['confident']:.1%}"
        wrong = "" if result["confident"] is None else str(result["confident_and_wrong"])
        lines.append((row.name, str(result["problems"]), quartiles if row.right_deg else "", right, sure, wrong,
                      f"{result['cpu_seconds']:.2g}"))  # fmt: skip
    return lines


def reliability_table(results: dict[str, Any]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = [("problems", "number", "success", "confident", "confident but wrong")]
    for line in RELIABILITY:
        found = [results[f"reliability: {name}"] for name in line.rows]
        count, right, sure = (
            sum(result["problems"] * result.get(name, 1) for result in found) for name in ("", "right", "confident")
        )
        wrong = sum(result["confident_and_wrong"] for result in found)
        lines.append((line.name, f"{count:,}", f"{right / count:.1%}" if line.solvable else "", f"{sure:,.0f}",
                      str(wrong)))  # fmt: skip
    return lines


def sigmas_table(results: dict[str, Any]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = [("poses", "within 1", "within 2", "within 3")]
    for name, starts in SIGMAS.items():
        found = [results[key(row)] for row in ROWS if key(row).startswith(starts)]
        counts = [round(result["problems"] * result["right"]) for result in found]
        sums = np.dot(counts, [result["sigmas"] for result in found])
        lines.append((f"{sum(counts):,} of {name}", *(f"{mean:.1%}" for mean in sums / sum(counts))))
    return [*lines, ("normal errors", "68.3%", "95.4%", "99.7%")]


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables whose rows are all measured."""
    names = dict.fromkeys([*(row.table for row in ROWS), "sigmas"])
    return {name: text for name in names if (text := table(name, record["full"])) is not None}


def sheets(record: dict[str, Any]) -> dict[str, str]:
    """Return all rows in CSV."""
    rows = []
    for name, found in record["full"].items():
        table, _, row = name.partition(": ")
        rows.append({"table": table, "row": row} | {
            key: " / ".join(map(str, value)) if isinstance(value, list) else value for key, value in found.items()
        })  # fmt: skip
    return {"": comma_separated(list(dict.fromkeys(key for row in rows for key in row)), rows)}


def main() -> None:
    options = parser(__doc__, without=["limit", "time-limit", "output"])
    options.set_defaults(seed=None)
    options.add_argument("--quick", action="store_true", help="few problems a row")
    options.add_argument("--check", action="store_true", help="compare, write nothing")
    options.add_argument("--file", type=Path, default=FILE, help="another fills no page (default: %(default)s)")
    chosen = options.parse_args()
    kept = json.loads(chosen.file.read_text()) if chosen.file.is_file() else {}
    part = "quick" if chosen.quick else "full"
    results: dict[str, Any] = kept.get(part, {})
    seeds = {key(row): seed_of(row, chosen, results) for row in ROWS}
    failures = []
    for row, found, _ in measure_rows(rows(chosen, seeds)):
        result = found | {"seed": seeds[row.name]} | measured_today()
        if chosen.check:
            old = results.get(row.name)
            bad = ["never measured"] if old is None else differences(result, old)
            failures += [f"{row.name}: {reason}" for reason in bad]
            continue
        results[row.name] = result
        write(chosen.file, {name: kept.get(name, {}) for name in ("quick", "full")} | {part: results})
    if not chosen.check and is_default(options, chosen, "file"):
        write_pages()
    if failures:
        sys.exit("\n".join(failures))
