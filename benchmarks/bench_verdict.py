"""What `confident` is worth: how often it is said of points that have no pose in common, and of the wrong twin.

python benchmarks/bench_verdict.py --data ../shared/data --trials 200 --output benchmarks/results/verdict.json

noise: image points and scene points drawn evenly and independently, several sizes. shuffled: keypoints of one photo
against the map points or surface points that another one sees. twins: points with a symmetry, exact or nearly so, of
which a camera sees all; an exact one has no single answer, of the others only one pose is right.
"""

import argparse
import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bench_search import source
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import Solution, solve
from bpnp.report.figures import save_figure

Array = NDArray[np.float64]
FOCAL, WIDTH, HEIGHT = 500.0, 640, 480  # pixels
CAMERA = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
NOISE_SIZES = ((4, 4), (6, 6), (8, 8), (10, 17), (20, 20), (10, 50), (30, 30), (50, 50), (20, 100), (100, 20),
               (100, 100), (200, 200), (400, 400), (1000, 1000))  # fmt: skip
SHUFFLED = ("castle-P30", "fountain-P11", "south_building", "statue_of_liberty", "walkthrough", "psb")
SHUFFLED_SIZES = (8, 15, 40, 120, 400, 1000)
CLAIMS = (0.0, -1.0, -2.0, -3.0)  # log10 of false alarms
LARGE = 100  # points of both sides together, from which a tenth of the trials is made
WRONG_DEG = 5.0


def noise(trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    """Each size's name, a solution, and NaN: nothing is right."""
    for m, n in NOISE_SIZES:
        for _ in range(trials if m + n < LARGE else max(trials // 10, 3)):
            points2d = rng.uniform((0, 0), (WIDTH, HEIGHT), (m, 2))
            yield f"{m} x {n}", solve(points2d, rng.uniform(-1, 1, (n, 3)), CAMERA), np.nan


def shuffled(data: Path, trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    sources = {name: source(name, data, 8) for name in SHUFFLED}
    for size in SHUFFLED_SIZES:
        for _ in range(trials // 2 if size < LARGE // 2 else max(trials // 20, 3)):
            first, second = (sources[name] for name in rng.choice(SHUFFLED, 2, replace=False))
            image = first.pair(int(rng.integers(len(first)))).points2d[0].double().numpy()
            scene = second.pair(int(rng.integers(len(second)))).points3d[0].double().numpy()
            yield f"{size}", solve(rng.permutation(image)[:size], rng.permutation(scene)[:size]), np.nan


def twins(trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    """Regular rings and prisms whose corners are displaced by a share of their radius: 0 is an exact symmetry."""
    for corners in (6, 12):
        for displaced in (0.0, 0.002, 0.01, 0.05):
            for _ in range(max(trials // 4, 3)):
                angle = 2 * np.pi * np.arange(corners) / corners
                ring = np.column_stack([np.cos(angle), np.sin(angle), np.full(corners, 0.4)])
                points = np.concatenate([ring, ring * (0.8, 0.8, -1)])
                points = points + displaced * rng.standard_normal(points.shape)
                rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.0, 0, rng.uniform(5, 9)])
                seen = (points @ rotation.T + translation) @ CAMERA.T
                points2d = seen[:, :2] / seen[:, 2:] + 0.3 * rng.standard_normal((len(seen), 2))
                found = solve(points2d, points, CAMERA)
                turned = Rotation.from_matrix(found.rotation.T @ rotation) if found.found else None
                error = np.degrees(turned.magnitude()) if turned is not None else 180.0
                yield f"{2 * corners} points, displaced by {displaced:g}", found, float(error)


def table(rows: list[tuple[str, Solution, float]]) -> dict[str, dict[str, float]]:
    """Per name: trials, the share with false alarms up to each claim, and the shares confident and wrongly so."""
    results = {}
    for name in dict.fromkeys(name for name, _, _ in rows):
        own = [(solution, error) for key, solution, error in rows if key == name]
        alarms = np.array([solution.log10_false_alarms for solution, _ in own])
        sure = np.array([solution.verdict == "confident" for solution, _ in own])
        wrong = sure & ~(np.array([error for _, error in own]) <= WRONG_DEG)
        results[name] = {
            "trials": len(own),
            **{f"at or below 1e{claim:g}": float((alarms <= claim).mean()) for claim in CLAIMS},
            "lowest": float(alarms.min()),
            "confident": float(sure.mean()),
            "confident and wrong": int(wrong.sum()),
            "failed": float(np.mean([solution.verdict == "failed" for solution, _ in own])),
        }
    return results


def draw(alarms: dict[str, Array], path: Path) -> None:
    """Observed shares of unrelated points against the claim, all sizes of a kind together."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name, values in alarms.items():
        ordered = np.sort(values)
        axes.step(ordered, np.arange(1, len(ordered) + 1) / len(ordered), where="post", label=name)
    bound = np.linspace(-4, 0, 50)
    axes.plot(bound, 10**bound, "k--", label="bound of the theory")
    axes.set(xlabel="log10 of the number of false alarms", ylabel="share of pairs at or below", yscale="log")
    axes.axvline(-2, color="0.6", label="confident")
    axes.set_xlim(-4, 20)
    axes.grid(alpha=0.3)
    axes.legend()
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="without it no shuffled pairs")
    parser.add_argument("--trials", type=int, default=200, help="of the small sizes; a tenth of the large ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    kinds = {"noise": noise(options.trials, np.random.default_rng(options.seed))}
    if options.data:
        kinds["shuffled"] = shuffled(options.data, options.trials, np.random.default_rng(options.seed + 1))
    kinds["twins"] = twins(options.trials, np.random.default_rng(options.seed + 2))
    results, alarms = {}, {}
    for kind, rows in kinds.items():
        found = list(rows)
        results[kind] = table(found)
        for name, row in results[kind].items():
            print(kind, name, " ".join(f"{key}: {value:.4g}" for key, value in row.items()), flush=True)
        if kind != "twins":
            alarms[kind] = np.array([solution.log10_false_alarms for _, solution, _ in found])
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"seed": options.seed, "results": results}, indent=1) + "\n")
    if options.picture:
        draw(alarms, options.picture)


if __name__ == "__main__":
    main()
