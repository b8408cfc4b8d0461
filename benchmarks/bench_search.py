"""The training-free search on real meshes and photos: errors, failures, verdicts and seconds a pair.

python benchmarks/bench_search.py --data ../shared/data psb psb-so3 psb-0.5 castle-P30 castle-P30-0.25
python benchmarks/bench_search.py --data ../shared/data --output benchmarks/results/search-cpu-2core.json \
    --document docs/search.md
The second one runs every set and writes its table into the guide.

A set is psb, psb-so3, psb-RHO (uniform outliers on both sides), SCENE, SCENE-CLUTTER (natural, ratio to the true
pairs) or SCENE-all (all keypoints, all scene points).
"""

import argparse
import json
import re
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from bpnp.datamodules import ColmapDataModule, MeshDataModule, Outliers
from bpnp.datamodules.loader import ProblemDataset
from bpnp.geometry import bearings
from bpnp.loops.parallel import Deadline
from bpnp.metrics import rotation_error, translation_error
from bpnp.search.point_sets import PointSets
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT, SearchSettings

EVERYTHING = 1e6
SCENES = ("castle-P30", "fountain-P11", "sceaux_castle_txt", "south_building", "statue_of_liberty", "walkthrough")
SETS = (
    "psb", "psb-so3", "psb-0.25", "psb-0.50", "psb-1.0",
    *(scene + clutter for clutter in ("", "-0.10", "-0.25", "-0.50", "-all") for scene in SCENES),
)  # fmt: skip
ALL_LIMIT, ALL_SECONDS = 10, 30.0  # images of a SCENE-all, and seconds a pair, where nothing else is asked for
START, END = "<!-- table of bench_search.py -->", "<!-- end of the table -->"


def source(name: str, data: Path, limit: int) -> ProblemDataset:
    """The pairs of a set."""
    if name.startswith("psb"):
        rho = 0.0 if name in ("psb", "psb-so3") else float(name.removeprefix("psb-"))
        module: MeshDataModule | ColmapDataModule = MeshDataModule(
            str(data / "psb"),
            test_pairs=limit,
            seed=1,
            rotation="so3" if name == "psb-so3" else "euler",
            test_outliers=Outliers(ratio=rho),
        )
    else:
        match = re.fullmatch(r"(.+?)(?:-(all|\d+\.\d+))?", name)
        assert match is not None
        scene, clutter = match.groups()
        ratio = EVERYTHING if clutter == "all" else float(clutter or 0)
        module = ColmapDataModule(str(data / "colmap" / scene), test_fraction=1.0, rotate=True, clutter=ratio, seed=1)
    module.setup("test")
    return module.datasets["test"]


def run(
    name: str, data: Path, limit: int, seed: int, settings: SearchSettings, time_limit: float | None = None
) -> list[dict]:
    pairs = source(name, data, limit)
    count = len(pairs)
    rows = []
    for i in sorted({int(k * count / limit) for k in range(limit)}) if count > limit else range(count):
        batch = pairs.problem(i)
        start, cpu = time.perf_counter(), time.process_time()
        found = search_poses(
            PointSets(bearings(batch.points2d)[0].double().numpy(), batch.points3d[0].double().numpy()),
            seed=seed,
            deadline=Deadline.after(time_limit),
            settings=settings,
        )
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        assert batch.rotation is not None
        assert batch.translation is not None
        turn, shift = (torch.as_tensor(values)[None] for values in found.best)
        rows.append(
            {
                "pair": batch.ids[0],
                "rotation_deg": float(rotation_error(turn, batch.rotation.double())),
                "translation": float(translation_error(shift, batch.translation.double())),
                "verdict": found.verdict,
                "log10_false_alarms": found.log10_false_alarms,
                "scale_deg": float(np.rad2deg(found.residual)),
                "matched": float(found.candidates.matched[0]) if len(found.candidates) else 0.0,
                "batches": found.batches,
                "seconds": seconds,
                "cpu_seconds": cpu,
                "points": [int(batch.count2d), int(batch.count3d)],
            }
        )
    return rows


def summary(name: str, rows: list[dict]) -> dict:
    """Quartiles, recalls, verdicts and seconds of a set."""
    error, shift = (np.array([row[key] for row in rows]) for key in ("rotation_deg", "translation"))
    sure = np.array([row["verdict"] == "confident" for row in rows])
    seconds = [row["seconds"] for row in rows]
    return {
        "set": name,
        "pairs": len(rows),
        "rotation_q_deg": [float(q) for q in np.percentile(error, (25, 50, 75))],
        "translation_q": [float(q) for q in np.percentile(shift, (25, 50, 75))],
        "under_1_deg": float((error < 1).mean()),
        "under_2_deg": float((error < 2).mean()),
        "recall_15_deg_0.5": float(((error < 15) & (shift < 0.5)).mean()),
        "confident": float(sure.mean()),
        "confident_over_2_deg": int((sure & (error > 2)).sum()),
        "confident_over_5_deg": int((sure & (error > 5)).sum()),
        "failed": int(sum(row["verdict"] == "failed" for row in rows)),
        "seconds_mean": float(np.mean(seconds)),
        "seconds_max": float(np.max(seconds)),
        "cpu_seconds_mean": float(np.mean([row["cpu_seconds"] for row in rows])),
        "batches_mean": float(np.mean([row["batches"] for row in rows])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", default=SETS)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--limit", type=int, help=f"pairs a set (100; {ALL_LIMIT} of a SCENE-all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--time-limit", type=float, help=f"seconds a pair (none; {ALL_SECONDS:.0f} of a SCENE-all)")
    parser.add_argument("--turns", type=int, default=96)
    parser.add_argument("--output", type=Path, help="JSON to add the results to")
    parser.add_argument("--document", type=Path, help="Markdown file whose table is replaced by these results")
    parser.add_argument("--pairs", type=Path, help="folder for a CSV of each set's pairs")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    settings = DEFAULT.limited(options.turns)
    run("psb", options.data, 1, 0, DEFAULT.limited(1))  # compiles
    results = json.loads(options.output.read_text()) if options.output and options.output.exists() else {}
    for name in options.sets:
        every = name.endswith("-all")
        limit = options.limit or (ALL_LIMIT if every else 100)
        time_limit = options.time_limit or (ALL_SECONDS if every else None)
        rows = run(name, options.data, limit, options.seed, settings, time_limit)
        row = summary(name, rows)
        q = " / ".join(f"{value:.2f}" for value in row["rotation_q_deg"])
        print(
            f"{name:24s} {row['pairs']:4d} pairs  rotation {q} deg  <1: {row['under_1_deg']:.3f}  <2: "
            f"{row['under_2_deg']:.3f}  (15, 0.5): {row['recall_15_deg_0.5']:.3f}  confident {row['confident']:.2f}, "
            f"over 2 / 5 deg {row['confident_over_2_deg']} / {row['confident_over_5_deg']}  failed {row['failed']}  "
            f"{row['seconds_mean']:.2f} s (max {row['seconds_max']:.1f}), {row['cpu_seconds_mean']:.2f} CPU s, "
            f"{row['batches_mean']:.1f} batches",
            flush=True,
        )
        results[name] = row | {
            "seed": options.seed,
            "time_limit": time_limit,
            "turns": options.turns,
            "threads": torch.get_num_threads(),
        }
        if options.output:
            write_json(options.output, results)
        if options.pairs:
            options.pairs.mkdir(parents=True, exist_ok=True)
            pd.DataFrame(rows).to_csv(options.pairs / f"{name}.csv", index=False)
    if options.document:
        text = options.document.read_text()
        before, after = text[: text.index(START) + len(START)], text[text.index(END) :]
        options.document.write_text(f"{before}\n{table(results)}\n{after}")


def table(results: dict[str, dict]) -> str:
    """The results of sets as Markdown."""
    names = ("set", "pairs", "rotation Q1 / Q2 / Q3", "under 1 / 2 deg", "(15 deg, 0.5)", "confident",
             "over 2 / 5 deg", "failed", "CPU s", "batches")  # fmt: skip
    lines = [names, ("---",) * len(names)]
    for name, row in results.items():
        digits = 3 if row["rotation_q_deg"][1] < 0.1 else 2
        lines.append((
            name,
            str(row["pairs"]),
            " / ".join(f"{value:.{digits}f}" if value < 10 else f"{value:.0f}" for value in row["rotation_q_deg"]),
            f"{row['under_1_deg']:.0%} / {row['under_2_deg']:.0%}",
            f"{row['recall_15_deg_0.5']:.0%}",
            f"{row['confident']:.0%}",
            f"{row['confident_over_2_deg']} / {row['confident_over_5_deg']}",
            str(row["failed"]),
            f"{row['cpu_seconds_mean']:.2f}",
            f"{row['batches_mean']:.1f}",
        ))  # fmt: skip
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    parts = [row for name, row in results.items() if not name.endswith("-all")]
    wholes = [row for name, row in results.items() if name.endswith("-all")]
    return f"\n{rows}\n\nOf all sets but `SCENE-all`: {_claims(parts)}. Of these: {_claims(wholes)}.\n"


def _claims(rows: list[dict]) -> str:
    confident = sum(round(row["confident"] * row["pairs"]) for row in rows)
    over2, over5 = (sum(row[f"confident_over_{degrees}_deg"] for row in rows) for degrees in (2, 5))
    pairs = sum(row["pairs"] for row in rows)
    return f"{confident} of {pairs} poses confident, {over2} of them over 2 and {over5} over 5 degrees off"


def write_json(path: Path, results: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(results, indent=1) + "\n")
    temporary.replace(path)


if __name__ == "__main__":
    main()
