"""Table 2 of the paper: trains L_c and its fork L_c + L_p on drawn maps, and tests them on photos of COLMAP models.

    python -m benchmarks table2 --data DATA            # hours; a run that was stopped goes on
    python -m benchmarks table2 --data DATA --quick    # 20 minutes, another folder, no page

DATA is a folder with a folder `colmap` of COLMAP models, those of `SCENES` (docs/data.md). No photo is in the training.
It is configs/paper/megadepth.yaml but for the data, the steps, the learning rates and `FEATURES`: first
`--drawn_steps` of each of `DRAWN_STAGES`, then up to 512 points until the switch and after it. Photos have up to 1,000
of the points that they see, and maps have their second axis downwards (`ColmapDataModule(y_down=True)`).
"""

import argparse
import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import paper_tables
from pages import markdown
from paper_tables import ESTIMATES, QUICK, Method, Table, Training
from record import ROOT, write_json
from torch import nn

from bpnp.datamodules import ColmapDataModule
from bpnp.geometry import masked_median, transform
from bpnp.models.baselines import GOSMA, RandomRansac, SoftPOSIT
from bpnp.report.figure_files import save_figure
from bpnp.report.results import ProblemRow

SCENES = (
    "castle-P30", "fountain-P11", "sceaux_castle_txt", "south_building", "statue_of_liberty", "tabletop",
    "walk_2", "walk_4", "walk_6", "walkthrough",
)  # fmt: skip
PLACES = ("fountain-P11", "south_building", "tabletop")  # the other methods are tested on their photos
ALL = "photos"  # name of the rows of all scenes together
TABLE = Table("table2", "megadepth", (10.0, 1.0), (*SCENES, "places"))
SHOWN = Table("table2", "megadepth", TABLE.recall, (ALL, "places"))
NEAR = 0.05  # of the depth of the scene
FILE = ROOT / "benchmarks" / "table2.json"
POINTS = 1000
EPOCH = 20
DRAWN_EPOCH = 50  # steps between checkpoints
SHORT = {"drawn_steps": [50, 50], "steps": 40, "pose_steps": 20, "epoch": EPOCH, "problems": 2}  # of a quick run
BASELINES: dict[str, Callable[[], nn.Module]] = {
    "SoftPOSIT near the truth": partial(SoftPOSIT, start="near_truth"),
    "RANSAC": RandomRansac,
    "GOSMA": GOSMA,
}
SOLVER = "--model.solver"
FEATURES = (
    f"{SOLVER}.features2d=bpnp.models.nets.ImageFeatures", f"{SOLVER}.features2d.init_args.centre=true",
    f"{SOLVER}.features2d.init_args.scale=4.0", f"{SOLVER}.features3d.init_args.centre=true",
    f"{SOLVER}.features3d.normalise=true",
)  # fmt: skip
DRAWN_STAGES = {"drawn128": (128, 16), "drawn256": (256, 64)}  # largest number of points, fewest matches
DRAWN_RATE = 1e-3  # learning rate of these
DRAWN = ("outliers=0.0", "frame=y_down", "tilt_deg=8", "heading_deg=40", "val_problems=48", "batch_size=16")
# After these stages. The loss of translations is in scene units: 0.1 to 0.5 a metre, near those of the photos.
LATER = ("num_points=512", "min_points=64", "scale_range=[0.1,0.5]")


@functools.cache
def data_module(root: Path, seed: int, name: str) -> ColmapDataModule:
    """All photos of a scene, or of `PLACES`."""
    scenes = [str(root / "colmap" / scene) for scene in (PLACES if name == "places" else (name,))]
    return ColmapDataModule(scenes, test_fraction=1.0, eval_max_points=POINTS, y_down=name != "places", seed=seed)


def trainings(options: argparse.Namespace) -> dict[str, Training]:
    """Stages on drawn maps with few points, then with more, and the two branches."""
    folder, never = options.run / f"seed{options.seed}", f"--pose_loss.start_epoch={paper_tables.NEVER}"
    shared = (
        "--config=paper/megadepth", *FEATURES, f"--seed_everything={options.seed}",
        "--data=bpnp.datamodules.SyntheticMapDataModule", *(f"--data.{option}" for option in DRAWN),
        f"--data.seed={options.seed}",
    )  # fmt: skip
    stages: dict[str, Training] = {}
    weights: tuple[str, ...] = ()
    for (name, (points, fewest)), steps in zip(DRAWN_STAGES.items(), options.drawn_steps, strict=True):
        few = (f"--data.num_points={points}", f"--data.min_points={fewest}", f"--model.learning_rate={DRAWN_RATE}")
        stages[name] = Training(folder / name, (*shared, never, *few, *weights), steps, DRAWN_EPOCH)
        weights = (f"{paper_tables.WEIGHTS_OPTION}{stages[name].checkpoint}",)
    later = (*shared, *(f"--data.{option}" for option in LATER), f"--model.learning_rate={options.learning_rate}")
    return stages | paper_tables.branches(folder, (*later, *weights), options, later)


def methods(options: argparse.Namespace, trained: dict[str, Training], name: str) -> Iterator[Method]:
    """Networks with the paper's inference, also for several headings; on `PLACES` the other methods."""
    if name == "places":
        yield from paper_tables.other_methods(BASELINES, options)
        return
    drawn = {"drawn_steps": list(options.drawn_steps)}
    branches = paper_tables.branch_weights(trained, options)
    weights = [replace(one, settings=one.settings | drawn) for one in branches]
    yield from paper_tables.network_methods(weights, options, ("paper", "headings"))


def measure(options: argparse.Namespace) -> dict[str, Any]:
    trained = trainings(options)
    data = partial(data_module, options.data, options.test_seed)
    found = partial(methods, options, trained)
    record = paper_tables.measure(TABLE, trained, found, data, options)
    pool_scenes(record, found, data, options)
    return record


def pool_scenes(
    record: dict[str, Any],
    methods: Callable[[str], Iterator[Method]],
    data: Callable[[str], ColmapDataModule],
    options: argparse.Namespace,
) -> None:
    """Add to the record the rows and effects of all scenes together, depths, and fractions within 5 % of the depth."""
    tests = f"tests-{options.test_seed}" if options.test_seed else "tests"
    pooled: dict[tuple[str, str, str], list[ProblemRow]] = {}
    for method in methods(SCENES[0]):
        found: dict[str, list[ProblemRow]] = {}
        close: dict[str, list[bool]] = {}
        name = f"|{method.seed}|{method.group}|{method.label}|"
        for k, scene in enumerate(SCENES):
            file = options.run / f"seed{method.seed}" / tests / scene / method.file
            solver = (method.build, data(scene), method.limit, method.identity)
            rows = paper_tables.solve_problems(file, *solver, solve=False)
            if not rows:
                found = {}
                break
            depths = scene_depths(data(scene), {row.index for row in rows})
            for row in rows:
                within = row.rotation_error_deg < TABLE.recall[0] and row.translation_error < NEAR * depths[row.index]
                close.setdefault(scene + name + row.estimate, []).append(within)
                found.setdefault(row.estimate, []).append(replace(row, index=1000 * k + row.index))
            for key in {scene + name + row.estimate for row in rows} & record["rows"].keys():
                depth = float(np.median(list(depths.values())))
                record["rows"][key] |= {"near": round(float(np.mean(close[key])), 4), "depth": round(depth, 2)}
        for estimate, rows in found.items():
            first = record["rows"][SCENES[0] + name + estimate]
            shared = {part: first[part] for part in ("steps", "settings", "measured")}
            near = np.mean([within for scene in SCENES for within in close[scene + name + estimate]])
            figures = paper_tables.figures(rows, TABLE.recall) | {"near": round(float(near), 4)}
            record["rows"][ALL + name + estimate] = figures | shared
            pooled[method.group, method.label, estimate] = rows
    for estimate in ("pnp", "ransac"):
        keys = [("paper", label, estimate) for label in paper_tables.BRANCHES]
        if all(key in pooled for key in keys):
            steps = [record["rows"]["|".join((ALL, str(options.seed), *key))]["steps"] for key in keys]
            first_rows, second_rows = (pooled[key] for key in keys)
            compared = paper_tables.effect(first_rows, second_rows, TABLE.recall) | {"steps": steps}
            record["effects"]["|".join((ALL, str(options.seed), "paper", *paper_tables.BRANCHES, estimate))] = compared
    if not pooled:
        return
    write_json(options.output, record)
    if options.published and options.seed == 0:
        curves = {
            label + ESTIMATES[estimate]: rows for (group, label, estimate), rows in pooled.items() if group == "paper"
        }
        save_figure(paper_tables.recall_picture(curves, TABLE), paper_tables.PICTURES / f"{TABLE.name}.png")


def scene_depths(data: ColmapDataModule, indices: set[int]) -> dict[int, float]:
    """Return the median depth of the points of each photo, scene units."""
    data.setup("test")
    depths = {}
    for i in indices:
        batch = data.datasets["test"].problem(i)
        assert batch.rotation is not None
        assert batch.translation is not None
        points3d = batch.points3d.to(batch.rotation)
        depth = transform(batch.rotation, batch.translation, points3d)[..., 2]
        depths[i] = float(masked_median(depth, batch.mask3d))
    return depths


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of all scenes together, with one heading and with several, and that of the scenes."""
    shown = {key: row for key, row in record["rows"].items() if key.split("|")[0] in SHOWN.sets}
    effects = {key: row for key, row in record["effects"].items() if key.split("|")[0] in SHOWN.sets}
    one = {key: row for key, row in shown.items() if "|paper, headings|" not in key}
    several = {key.replace("|paper, headings|", "|paper|"): row for key, row in shown.items() if key not in one}
    found = paper_tables.tables(SHOWN, {"rows": one, "effects": effects})
    headings = paper_tables.tables(SHOWN, {"rows": several, "effects": {}})
    names = {f"{ALL}-headings": f"{ALL}-paper", f"{ALL}-headings-spread": f"{ALL}-spread"}
    found |= {new: headings[name] for new, name in names.items() if name in headings}
    return found | {"scenes": scene_table(record["rows"])}


def sheets(record: dict[str, Any]) -> dict[str, str]:
    return paper_tables.sheets(record)


def scene_table(rows: Mapping[str, Any]) -> str:
    """Return the recall by scene, the mean of all seeds, within the limits of the table and within 5 % of the depth."""
    kinds = [
        (group, label, estimate)
        for group in ("paper", "paper, headings")
        for estimate in ("pnp", "ransac")
        for label in paper_tables.BRANCHES
    ]
    head = ["scene", "photos", "depth"]
    head += [f"{label}{ESTIMATES[estimate]}{group.removeprefix('paper')}" for group, label, estimate in kinds]
    lines = []
    for scene in (*SCENES, ALL):
        own = {tuple(key.split("|")): row for key, row in rows.items() if key.startswith(f"{scene}|")}
        networks = {key: row for key, row in own.items() if "near" in row}
        if not networks:
            continue
        some = next(iter(networks.values()))
        cells = [scene.replace(ALL, "all"), str(some["problems"]), f"{some['depth']:g}" if "depth" in some else ""]
        for kind in kinds:
            same = [row for (_, _, *other), row in networks.items() if tuple(other) == kind]
            values = [
                100 * np.mean(part) for part in ([r["recall"][0] for r in same], [r["near"] for r in same]) if part
            ]
            cells.append(" / ".join(f"{value:.0f}" for value in values))
        lines.append(cells)
    return markdown(head, lines)


def main() -> None:
    run = ROOT / "runs" / "table2"
    parser = paper_tables.options(__doc__, file=FILE, run=run, sets=TABLE.sets, steps=40, pose_steps=40, epoch=EPOCH)
    parser.add_argument(
        "--drawn_steps",
        type=int,
        nargs=len(DRAWN_STAGES),
        default=(250, 350),
        help="of each stage on drawn maps (default: %(default)s)",
    )
    parser.set_defaults(learning_rate=3e-4, problems=20)
    paper_tables.run(TABLE, parser, measure, QUICK | SHORT)
