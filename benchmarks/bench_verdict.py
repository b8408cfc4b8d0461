"""What `confident` is worth: how often it is said of points that have no pose in common, and of the wrong twin.

python benchmarks/bench_verdict.py --data ../shared/data --trials 1000 --output benchmarks/results/verdict.json

noise: image points and scene points drawn evenly and independently, several sizes. shuffled: keypoints of one photo
against the map points or surface points that another one sees. twins: points with a symmetry, exact or nearly so, of
which a camera sees all; an exact one has no single answer, of the others only one pose is right. hard: pairs on which a
verdict is easily wrong (`hard_scenes.py`); an error of a tenth of the distance counts as one of 3 degrees.
"""

import argparse
import json
import warnings
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_search import source
from hard_scenes import CAMERA, HEIGHT, SCENES, WIDTH, Pose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import Solution, solve
from bpnp.datamodules.meshes.surfaces import read_mesh, sample_surface
from bpnp.report.figures import save_figure

Array = NDArray[np.float64]
NOISE_SIZES = ((4, 4), (6, 6), (8, 8), (10, 17), (20, 20), (10, 50), (30, 30), (50, 50), (20, 100), (100, 20),
               (100, 100), (200, 200), (400, 400), (1000, 1000))  # fmt: skip
SHUFFLED = ("castle-P30", "fountain-P11", "south_building", "statue_of_liberty", "walkthrough", "psb")
SHUFFLED_SIZES = (8, 15, 40, 120, 400, 1000)
KINDS = ("noise", "shuffled", "twins", "surfaces", "hard")
CLAIMS = (0.0, -1.0, -2.0, -3.0)  # log10 of false alarms
# Points of the larger side up to which this share of the trials is made.
SIZES = ((50, 1.0), (400, 0.2), (np.inf, 0.01))
SURFACES = HARD = 0.1  # share of the trials
MESH_VERTICES, SAMPLES = (100, 2000), 400
WRONG_DEG, WRONG_SHIFT = 3.0, 0.1


def trials_of(points: int, trials: int) -> int:
    """Fewer trials of large sets, each of which takes seconds."""
    return max(int(next(share for most, share in SIZES if points <= most) * trials), 3)


def noise(trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    """Each size's name, a solution, and NaN: nothing is right."""
    for m, n in NOISE_SIZES:
        for _ in range(trials_of(max(m, n), trials)):
            points2d = rng.uniform((0, 0), (WIDTH, HEIGHT), (m, 2))
            yield f"{m} x {n}", solve(points2d, rng.uniform(-1, 1, (n, 3)), CAMERA), np.nan


def shuffled(data: Path, trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    sources = {name: source(name, data, 8) for name in SHUFFLED}
    for size in SHUFFLED_SIZES:
        for _ in range(trials_of(size, trials)):
            first, second = (sources[name] for name in rng.choice(SHUFFLED, 2, replace=False))
            image = first.problem(int(rng.integers(len(first)))).points2d[0].double().numpy()
            scene = second.problem(int(rng.integers(len(second)))).points3d[0].double().numpy()
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
                yield f"{2 * corners} points, displaced by {displaced:g}", found, degrees(found, rotation)


def surfaces(data: Path, trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    """Meshes in random poses, 4 to 6 radii away."""
    files = sorted((data / "psb").rglob("*.off"))
    for _ in range(max(int(SURFACES * trials), 3)):
        while True:
            mesh = read_mesh(files[rng.integers(len(files))])
            if MESH_VERTICES[0] <= len(mesh.vertices) <= MESH_VERTICES[1]:
                break
        middle = mesh.vertices.mean(0)
        radius = np.abs(mesh.vertices - middle).max()
        points = (sample_surface(mesh, SAMPLES, rng) - middle) / radius
        rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.0, 0, rng.uniform(4, 6)])
        seen = ((mesh.vertices - middle) / radius @ rotation.T + translation) @ CAMERA.T
        found = solve(seen[:, :2] / seen[:, 2:], points, CAMERA)
        yield f"vertices against {SAMPLES} points of the faces", found, degrees(found, rotation)


def hard(trials: int, rng: np.random.Generator) -> Iterator[tuple[str, Solution, float]]:
    """Each kind of hard pair."""
    for draw_pair in SCENES:
        for _ in range(max(int(HARD * trials), 3)):
            points2d, points3d, poses = draw_pair(rng)
            found = solve(points2d, points3d, CAMERA)
            yield draw_pair.__name__, found, min((_error(found, pose, points3d) for pose in poses), default=np.nan)


def _error(found: Solution, pose: Pose, points: Array) -> float:
    """Error of the rotation, degrees, or that of the points' middle if it is larger, a tenth of its distance as 3."""
    middle, there = points.mean(0), pose[0] @ points.mean(0) + pose[1]
    shift = np.linalg.norm(found.rotation @ middle + found.translation - there) / np.linalg.norm(there)
    return max(degrees(found, pose[0]), WRONG_DEG / WRONG_SHIFT * float(shift)) if found.found else 180.0


def degrees(found: Solution, rotation: Array) -> float:
    """Error of the rotation, 180 where there is none."""
    return float(np.degrees(Rotation.from_matrix(found.rotation.T @ rotation).magnitude())) if found.found else 180.0


def summary(found: list[tuple[Solution, float]]) -> dict[str, float]:
    """Of the solutions and errors of a row: trials, the share with false alarms up to each claim, and the shares
    confident and wrongly so."""
    alarms = np.array([solution.log10_false_alarms for solution, _ in found])
    sure = np.array([solution.verdict == "confident" for solution, _ in found])
    wrong = sure & ~(np.array([error for _, error in found]) <= WRONG_DEG)
    return {
        "trials": len(found),
        **{f"at or below 1e{claim:g}": float((alarms <= claim).mean()) for claim in CLAIMS},
        "lowest": float(alarms.min()),
        "confident": float(sure.mean()),
        "confident and wrong": int(wrong.sum()),
        "failed": float(np.mean([solution.verdict == "failed" for solution, _ in found])),
    }


def draw(alarms: dict[str, list[float]], path: Path) -> None:
    """Observed shares of unrelated points against the claim, all sizes of a kind together."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name, values in alarms.items():
        ordered = np.sort(np.array(values))
        axes.step(ordered, np.arange(1, len(ordered) + 1) / len(ordered), where="post", label=name)
    bound = np.linspace(-4, 0, 50)
    axes.plot(bound, 10**bound, "k--", label="bound of the theory")
    axes.set(xlabel="log10 of the number of false alarms", ylabel="share of pairs at or below", yscale="log")
    axes.axvline(-2, color="0.6", label="confident")
    axes.set_xlim(-4, 20)
    axes.grid(alpha=0.3)
    axes.legend()
    save_figure(figure, path)


def rows_of(
    kind: str, data: Path | None, trials: int, rng: np.random.Generator
) -> Iterator[tuple[str, Solution, float]]:  # fmt: skip
    """What a kind measures; nothing without the data that it needs."""
    if kind == "noise":
        yield from noise(trials, rng)
    elif kind == "twins":
        yield from twins(trials, rng)
    elif kind == "hard":
        yield from hard(trials, rng)
    elif data:
        yield from (shuffled if kind == "shuffled" else surfaces)(data, trials, rng)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="without it no shuffled pairs")
    parser.add_argument("--trials", type=int, default=200, help="of the small sizes; fewer of the large ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    record: dict[str, Any] = {"results": {}, "alarms": {}}
    if options.output and options.output.exists():
        record = json.loads(options.output.read_text())
    for kind in options.kinds:
        rng = np.random.default_rng([options.seed, KINDS.index(kind)])
        results: dict[str, Any] = {"seed": options.seed}
        alarms: list[float] = []
        for name, rows in groupby(rows_of(kind, options.data, options.trials, rng), key=lambda row: row[0]):
            found = [(solution, error) for _, solution, error in rows]
            results[name] = summary(found)
            print(kind, name, " ".join(f"{key}: {value:.4g}" for key, value in results[name].items()), flush=True)
            alarms += [round(solution.log10_false_alarms, 2) for solution, _ in found]
            record["results"][kind] = results
            if kind in ("noise", "shuffled"):
                record["alarms"][kind] = sorted(alarms)
            if options.output:
                options.output.parent.mkdir(parents=True, exist_ok=True)
                options.output.write_text(json.dumps(record) + "\n")
    if options.picture:
        draw(record["alarms"], options.picture)


if __name__ == "__main__":
    main()
