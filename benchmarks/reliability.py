"""How often the best pose of a search is wrong, against the probability claimed that a better one was missed.

python benchmarks/reliability.py --data ../shared/data --problems 40 --seeds 1 2 --output rows.json
python benchmarks/reliability.py rows.json others.json --output docs/images/reliability.png

Rows: {family: [{"deg", "shift", "verdict", "alarms", "log10_missed", "cpu", "claims"}]}; shift of the middle of the
scene in distances, claims [log10_missed, deg, shift] of the best pose whenever it exceeds chance.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest
from view_pairs import scene_pairs

from bpnp import solve
from bpnp.datamodules.surfaces import normalise, procedural_shape, sample_surface
from bpnp.report.figures import save_figure
from bpnp.search import pool, verdict
from bpnp.search.verdict import missed

SCENES = ("fountain-P11", "south_building", "tabletop", "walk_4", "walkthrough")  # no constant was chosen on them
FAMILIES = (*product(["shapes"], (0.0, 0.25, 0.5)), *product(["photos"], (0.5, 0.75, 1.0)))
GROUPS = {"right, confident": "tab:green", "right": "tab:olive", "wrong": "0.8", "wrong, confident": "tab:red"}


def problems(kind: str, clutter: float, seed: int, options: argparse.Namespace) -> Iterator[tuple[np.ndarray, ...]]:
    """points2d, points3d, rotation, translation. clutter: of shapes random points a match on either side; of photos,
    each against one view, share of the points of a side without a partner."""
    for scene in options.scenes if kind == "photos" and options.data else ():
        for pair in scene_pairs(options.data, scene, limit=options.problems, views=1, outliers=clutter, seed=seed):
            yield pair.points2d, pair.points3d, pair.rotation, pair.translation
    for k in range(options.problems if kind == "shapes" else 0):
        rng = np.random.default_rng([seed, k])
        points = normalise(sample_surface(procedural_shape(rng), 400, rng), "unit_sphere")
        rotation, translation = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3) + [0, 0, 4.5]
        camera, others = points @ rotation.T + translation, round(400 * clutter)
        image = camera[:, :2] / camera[:, 2:] + 2 / 800 * rng.standard_normal((400, 2))
        sides = (np.concatenate([x, rng.uniform(x.min(0), x.max(0), (others, x.shape[1]))]) for x in (image, points))
        yield *(rng.permutation(side) for side in sides), rotation, translation


def solved(problem: tuple[np.ndarray, ...], seed: int) -> dict[str, Any]:
    points2d, points3d, rotation, translation = problem
    claims: list[tuple[float, float, float]] = []
    true = rotation @ (middle := np.median(points3d, 0)) + translation

    def errors(turned: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
        angle = np.arccos(np.clip((np.trace(turned @ rotation.T) - 1) / 2, -1, 1))
        return float(np.degrees(angle)), float(np.linalg.norm(seen - true) / np.linalg.norm(true))

    def watched(poses: Any, sets: Any, *rest: Any, independent: bool = True) -> float:
        claim = missed(poses, sets, *rest, independent=independent)
        if independent and len(poses) and poses.log10_false_alarms[0] < 0:
            claims.append((claim, *errors(poses.rotation[0], poses.rotation[0] @ sets.middle + poses.translation[0])))
        return claim

    cpu = time.process_time()
    with patch.object(pool, "missed", watched), patch.object(verdict, "missed", watched):
        solution = solve(points2d, points3d, seed=seed)
    deg, shift = errors(solution.rotation, solution.rotation @ middle + solution.translation)
    row = {"deg": deg, "shift": shift, "verdict": solution.verdict, "alarms": solution.log10_false_alarms}
    return row | {"log10_missed": claims[-1][0] if claims else 0.0, "cpu": time.process_time() - cpu, "claims": claims}


def draw(files: list[Path], path: Path) -> None:
    families = (item for file in files for item in json.loads(file.read_text()).items())
    rows = pd.DataFrame([row | {"family": family} for family, part in families for row in part])
    claims = [(k, max(claim, -6), *pose) for k, part in enumerate(rows.claims) for claim, *pose in part]
    met = pd.DataFrame(claims, columns=["problem", "claim", "deg", "shift"])
    met["decade"] = met.claim // 1  # in each a problem counts once; below 1e-6 is one
    for frame in (rows, met):
        frame["wrong"] = ~(frame.deg.le(3) & frame["shift"].le(0.1))  # so is NaN, no pose
    left, right = (figure := Figure(figsize=(11, 4), layout="constrained")).subplots(1, 2)
    for _, part in met.drop_duplicates(["problem", "decade"]).groupby("decade"):
        claimed, test = (10**part.claim).mean(), binomtest(int(part.wrong.sum()), len(part))
        low, high = test.proportion_ci(method="wilson")
        left.plot([claimed] * 3, np.maximum([low, test.statistic, high], 1e-9), "o-", color="tab:blue", markevery=[1])
        left.annotate(f"{test.k} of {test.n}", (claimed, high), ha="center", va="bottom", fontsize=7)
    left.plot([1e-6, 1], [1e-6, 1], "k--", lw=1)
    left.set(xscale="log", yscale="log", ylim=(1e-4, 2), xlabel="claimed: a better pose was missed", ylabel="wrong")
    table = pd.crosstab(rows.family, 2 * rows.wrong + (rows.verdict == "confident"), normalize="index")
    table = table.reindex(columns=[1, 0, 2, 3], fill_value=0).set_axis(list(GROUPS), axis=1)
    table.plot.barh(stacked=True, ax=right, color=GROUPS, xlim=(0, 1), ylabel="")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncol=4, fontsize=7)
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", type=Path, help="files to draw; without one, problems are solved")
    parser.add_argument("--data", type=Path, help="folder with colmap/SCENE; without it shapes alone")
    parser.add_argument("--scenes", nargs="*", default=SCENES)
    parser.add_argument("--problems", type=int, default=40, help="of a family of shapes, and photos of a scene")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1])
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    if options.rows:
        draw(options.rows, options.output)
        return
    rows = defaultdict[str, list[dict[str, Any]]](list)
    for seed, (kind, clutter) in product(options.seeds, FAMILIES):
        for problem in problems(kind, clutter, seed, options):
            rows[f"{kind} {clutter:.0%}"].append(solved(problem, seed))
            options.output.write_text(json.dumps(rows) + "\n")


if __name__ == "__main__":
    main()
