"""Outliers on photos: recall and AUC by the largest fraction of outliers, against one view (GoMatch's protocol).

    python -m benchmarks sweep --data DATA --checkpoints LC LCLP

DATA is a folder with a folder `colmap` of models (docs/data.md); the checkpoints are those of the branches of
`python -m benchmarks table2`. The problems are those of `view_problems`: at most `--limit` photos of each scene of
`REPORTED` against the points of one view with an overlap of 35 %. Maps are turned upright by their other photos.
A run that was stopped goes on.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pages import comma_separated, markdown, publish
from paper_tables import network
from record import DATA, ROOT, measured_today, write_json
from torch import nn
from view_problems import REPORTED, ViewProblem, images_of, model_of, view_problem

from bpnp import Batch, Matcher, solve
from bpnp.arrays import Array, PoseArrays
from bpnp.datamodules.colmap.module import turn_y_down
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction
from bpnp.poses import rotation_angle

FILE = ROOT / "benchmarks" / "sweep.json"
OUTLIERS = (0.0, 0.25, 0.5, 0.75, 1.0)
PIXELS = (1.0, 5.0, 10.0)
RECALL = (10.0, 1.0)  # degrees, scene units
SECONDS = 20.0  # of `solve`
# On MegaDepth (GoMatch, table of outliers): recall for each of `OUTLIERS`, and the AUC for the last one.
PUBLISHED = {
    "BPnPNet, retrained by GoMatch": (("93.8", "73.1", "30.6", "10.8", "8.5"), "0.3 / 0.8 / 1.2"),
    "GoMatch": (("97.5", "97.0", "93.3", "71.7", "50.2"), "10.3 / 29.1 / 34.8"),
}
Solver = Callable[[ViewProblem], PoseArrays | None]


def solvers(checkpoints: list[Path]) -> dict[str, Solver]:
    """The rows: networks of Table 2, a packaged Matcher, and the search."""
    lc, lclp = checkpoints
    return {
        "Lc R": partial(by_network, network(lc)),
        "Lc Lp R": partial(by_network, network(lclp)),
        "Lc Lp R, 6 headings": partial(by_network, network(lclp, inference="headings")),
        "Matcher": partial(by_network, Matcher.from_pretrained("matcher-sfm")),
        "solve": by_search,
    }


def by_network(net: nn.Module, problem: ViewProblem) -> PoseArrays | None:
    """Return the RANSAC pose of a network."""
    net.refinement.enabled = False  # type: ignore[union-attr]
    batch = Batch.from_arrays(problem.points2d.astype(np.float32), problem.points3d.astype(np.float32))
    with torch.no_grad():
        pose = net(batch).poses["ransac"]
    return (pose.rotation[0].numpy(), pose.translation[0].numpy()) if bool(pose.found) else None


def by_search(problem: ViewProblem) -> PoseArrays | None:
    pixels, camera = problem.pixels
    found = solve(pixels, problem.points3d, camera, time_limit=SECONDS)
    return None if found.rotation is None else (found.rotation, found.translation)


def errors(problem: ViewProblem, pose: PoseArrays | None) -> tuple[float, float, float]:
    """Return the errors of rotation, degrees, translation, and reprojection of the points that the photo sees, px."""
    if pose is None:
        return 180.0, math.inf, math.inf
    seen = problem.points3d[problem.matched]
    shift = np.linalg.norm(project(seen, pose) - project(seen, problem.pose), axis=-1)
    degrees = math.degrees(rotation_angle(pose[0], problem.pose[0]))
    return degrees, float(np.linalg.norm(pose[1] - problem.pose[1])), problem.focal * float(np.mean(shift))


def project(points3d: Array, pose: PoseArrays) -> Array:
    camera = points3d @ pose[0].T + pose[1]
    return np.asarray(camera[:, :2] / camera[:, 2:])


def area_under_curve(values: Array, limit: float) -> float:
    """Return the mean recall over thresholds from 0 to a limit: 1 if all errors are 0, 0 if all exceed it."""
    return float(np.mean(np.clip(1 - values / limit, 0, 1)))


def upright(scene: Reconstruction, query: ImagePoints, outliers: float) -> ViewProblem:
    """Return the problem of a photo, turned upright by the map's other photos."""
    problem, turn = view_problem(scene, query, against="view", outliers=outliers), turn_y_down(scene, query)
    pose = problem.pose[0] @ turn.T, problem.pose[1]
    return replace(problem, points3d=problem.points3d @ turn.T, pose=pose)


def measure(options: argparse.Namespace) -> None:
    record = json.loads(options.output.read_text()) if options.output.is_file() else {"rows": {}}
    methods = {
        label: solver
        for label, solver in solvers(options.checkpoints).items()
        if any(part in label for part in options.only)
    }
    scenes = [(scene, images_of(scene, options.limit)) for scene in (model_of(options.data, name) for name in REPORTED)]
    for outliers in OUTLIERS:
        for scene, query in ((scene, query) for scene, queries in scenes for query in queries):
            problem = upright(scene, query, outliers)
            for label, solver in methods.items():
                key = f"{outliers:g}|{label}|{problem.name}"
                if key not in record["rows"]:
                    start = time.process_time()
                    pose = solver(problem)
                    seconds = _short(time.process_time() - start)
                    values = dict(
                        zip(("rotation", "translation", "pixels"), map(_short, errors(problem, pose)), strict=True)
                    )
                    record["rows"][key] = values | {"seconds": seconds}
                    record["measured"] = measured_today()
                    write_json(options.output, record)
        print(f"{outliers:g}: {len(record['rows'])} rows", flush=True)


def _short(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def tables(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the recall and the AUC of each method and fraction of outliers."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for key, row in record["rows"].items():
        outliers, label, _ = key.split("|")
        found.setdefault(label, {}).setdefault(outliers, []).append(row)
    levels = [f"{outliers:g}" for outliers in OUTLIERS]
    recall = [[label, *(_recall(found[label].get(level, [])) for level in levels)] for label in found]
    recall += [[f"*{label}, MegaDepth*", *cells] for label, (cells, _) in PUBLISHED.items()]
    auc = [[label, *(_auc(found[label].get(level, [])) for level in levels)] for label in found]
    auc += [[f"*{label}, MegaDepth*", *[""] * 4, cell] for label, (_, cell) in PUBLISHED.items()]
    count = max((len(rows) for one in found.values() for rows in one.values()), default=0)
    head = [f"{outliers:g}" for outliers in OUTLIERS]
    return {
        "recall": markdown((f"{count} photos", *head), recall),
        "auc": markdown((f"{count} photos", *head), auc),
    }


def _recall(rows: list[dict[str, Any]]) -> str:
    right = [row["rotation"] < RECALL[0] and (row["translation"] or 0) < RECALL[1] and row["translation"] is not None
             for row in rows]  # fmt: skip
    return f"{100 * np.mean(right):.0f}" if rows else ""


def _auc(rows: list[dict[str, Any]]) -> str:
    values = np.array([math.inf if row["pixels"] is None else row["pixels"] for row in rows])
    return " / ".join(f"{100 * area_under_curve(values, limit):.0f}" for limit in PIXELS) if rows else ""


def sheets(record: Mapping[str, Any]) -> dict[str, str]:
    """Return all rows in CSV."""
    names = ("outliers", "row", "photo")
    rows = [dict(zip(names, key.split("|"), strict=True)) | row for key, row in record["rows"].items()]
    return {"": comma_separated((*names, "rotation", "translation", "pixels", "seconds"), rows)}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--data", type=Path, default=DATA, help="folder of the data sets")
    options.add_argument("--checkpoints", type=Path, nargs=2, required=True, help="of Lc and of Lc Lp")
    options.add_argument("--limit", type=int, default=4, help="photos of a scene, at most (default: %(default)s)")
    options.add_argument("--only", nargs="*", default=[""], help="parts of names: only methods with one of them")
    options.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    measure(chosen)
    publish("sweep", chosen.output)
