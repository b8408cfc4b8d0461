"""Robust pose from candidate pairs: recall, accuracy and time of every estimator on planted problems.

    python benchmarks/bench_ransac.py --json benchmarks/results/ransac.json

Each problem holds `--pairs` candidate pairs of 1,000 points on each side, in the order of a weight: pairs of the
planted pose with noise of 0.0025 (normalised units), the rest random pairs, so that most points appear several times.
With "ordered" weights the true pairs tend to come first (log weight N(2, 1) against N(0, 1)); with "random" ones they
do not. The threshold is 0.01. Solved is below 1 degree; an estimator that gives no pose counts as 180 degrees.
"CPU ms" is the processor time, the figure to compare where other programs run beside it.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import poselib
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Column, Table
from scipy.spatial.transform import Rotation
from timing import machine, write_json

from bpnp.geometry import rotation_angle
from bpnp.robust.consensus import Matches, consensus, normalised

NOISE, THRESHOLD, POINTS, FOCAL = 0.0025, 0.01, 1000, 1000.0
CAMERA = {"model": "SIMPLE_PINHOLE", "width": 1000, "height": 1000, "params": [FOCAL, 0.0, 0.0]}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """Pairs by falling weight and the rotation that was planted."""

    points2d: Array
    points3d: Array
    rotation: Array


@dataclass(frozen=True)
class Row:
    weights: str
    inliers: float
    method: str
    solved: float
    median_deg: float
    milliseconds: float
    cpu_milliseconds: float


Estimator = Callable[[list[Problem]], Array]


def planted(seed: int, *, inliers: float, pairs: int, ordered: bool) -> Problem:
    """A cube of points seen from a distance of 4 to 6, any rotation."""
    rng = np.random.default_rng(seed)
    points3d = rng.uniform(-1, 1, (POINTS, 3))
    rotation = Rotation.random(random_state=rng).as_matrix()
    camera = points3d @ rotation.T + [*rng.uniform(-0.3, 0.3, 2), rng.uniform(4, 6)]
    points2d = camera[:, :2] / camera[:, 2:] + rng.normal(0, NOISE, (POINTS, 2))
    true = round(inliers * pairs)
    first = rng.integers(0, POINTS, pairs)
    first[:true] = rng.permutation(POINTS)[:true]
    second = (first + rng.integers(1, POINTS, pairs)) % POINTS
    second[:true] = first[:true]
    quality = rng.standard_normal(pairs) + 2.0 * ordered * (np.arange(pairs) < true)
    order = np.argsort(-quality)
    return Problem(points2d[first[order]], points3d[second[order]], rotation)


def with_torch(problems: list[Problem], *, hypotheses: int) -> Array:
    """All problems in one batch."""
    arrays = [[getattr(p, name) for p in problems] for name in ("points2d", "points3d")]
    points2d, points3d = (torch.as_tensor(np.stack(a), dtype=torch.float32) for a in arrays)
    real = torch.ones(points2d.shape[:2], dtype=torch.bool)  # the most probable pair first, as they are
    pairs, *_ = normalised(Matches(points2d, points3d, real))
    return consensus(pairs, THRESHOLD, hypotheses, 0)[0][..., :3].numpy()


def with_poselib(problems: list[Problem], *, options: dict[str, float | bool]) -> Array:
    options = {"max_reproj_error": THRESHOLD * FOCAL, **options}
    poses = [poselib.estimate_absolute_pose(p.points2d * FOCAL, p.points3d, CAMERA, options, {})[0] for p in problems]
    return np.stack([pose.R for pose in poses])


def with_opencv(problems: list[Problem], *, flag: int) -> Array:
    rotations = []
    for p in problems:
        found, vector, _, _ = cv2.solvePnPRansac(
            p.points3d, p.points2d, np.eye(3), None, iterationsCount=1000, reprojectionError=THRESHOLD, flags=flag
        )
        rotations.append(cv2.Rodrigues(vector)[0] if found else np.full((3, 3), np.nan))
    return np.stack(rotations)


ESTIMATORS: dict[str, tuple[int, Estimator]] = {  # problems at a time, and the call
    "torch, 1,024": (4, partial(with_torch, hypotheses=1024)),
    "torch, 2,048": (4, partial(with_torch, hypotheses=2048)),
    "torch, 16,384": (4, partial(with_torch, hypotheses=16384)),
    "PoseLib, PROSAC": (1, partial(with_poselib, options={"progressive_sampling": True})),
    "PoseLib, uniform": (1, partial(with_poselib, options={})),
    "PoseLib, PROSAC, 1,000": (
        1,
        partial(with_poselib, options={"progressive_sampling": True, "max_iterations": 1000}),
    ),
    "OpenCV P3P, 1,000": (1, partial(with_opencv, flag=cv2.SOLVEPNP_P3P)),
    "OpenCV AP3P, 1,000": (1, partial(with_opencv, flag=cv2.SOLVEPNP_AP3P)),
}


def measure(name: str, problems: list[Problem], *, weights: str, inliers: float) -> Row:
    size, estimate = ESTIMATORS[name]
    estimate(problems[:size])
    errors, seconds, cpu_seconds = [], [], []
    for start in range(0, len(problems), size):
        part = problems[start : start + size]
        begin, cpu_begin = time.perf_counter(), time.process_time()
        rotations = estimate(part)
        seconds.append((time.perf_counter() - begin) / len(part))
        cpu_seconds.append((time.process_time() - cpu_begin) / len(part))
        planted_rotations = torch.as_tensor(np.stack([p.rotation for p in part]))
        errors.append(torch.rad2deg(rotation_angle(torch.as_tensor(rotations), planted_rotations)))
    error = torch.cat(errors).nan_to_num(nan=180.0)
    return Row(
        weights=weights,
        inliers=inliers,
        method=name,
        solved=float((error < 1).double().mean()),
        median_deg=float(error.median()),
        milliseconds=1000 * float(np.median(seconds)),
        cpu_milliseconds=1000 * float(np.median(cpu_seconds)),
    )


def show(rows: list[Row]) -> None:
    columns = ("weights", "inliers", "method", "solved", "median deg", "ms a pair", "CPU ms")
    table = Table(*(Column(name, no_wrap=True) for name in columns))
    for i, row in enumerate(rows):
        group_ends = i + 1 == len(rows) or rows[i + 1].inliers != row.inliers
        table.add_row(
            row.weights, f"{row.inliers:.0%}", row.method, f"{row.solved:.0%}", f"{row.median_deg:.2f}",
            f"{row.milliseconds:.1f}", f"{row.cpu_milliseconds:.1f}", end_section=group_ends,
        )  # fmt: skip
    Console().print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--problems", type=int, default=20, help="problems a row")
    parser.add_argument("--pairs", type=int, default=1500, help="candidate pairs a problem")
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.05, 0.1, 0.3, 0.6])
    parser.add_argument("--threads", type=int, default=1, help="threads for torch; the others use one")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    rows = []
    for ordered in (True, False):
        for inliers in options.inliers:
            problems = [
                planted(seed, inliers=inliers, pairs=options.pairs, ordered=ordered) for seed in range(options.problems)
            ]
            weights = "ordered" if ordered else "random"
            rows += [measure(name, problems, weights=weights, inliers=inliers) for name in ESTIMATORS]
    show(rows)
    if options.json:
        settings = {**vars(options), "json": options.json.name}
        write_json(options.json, {"machine": machine(), "settings": settings, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
