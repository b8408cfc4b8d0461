"""Results of planted problems for the tests of the page and of the figures."""

import base64
import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from planted import padded, plant, seen
from scipy.spatial.transform import Rotation

from bpnp.report import ProblemRow, Results, write_results
from bpnp.report.points import ProblemPoints, write_points
from bpnp.types import Batch

HOSTILE = "</script><script>document.title='owned'</script><b>&amp;%%data%%\udcff"


def inflated(text: str) -> str:
    """Decompress text that `compress_text` put into the page."""
    return gzip.decompress(base64.b64decode(text)).decode()


def rows(count: int, seed: int, estimates: tuple[str, ...] = ("ransac", "pnp")) -> list[ProblemRow]:
    """Random rows of problems whose sizes do not depend on the seed; the first has a hostile name, every seventh no
    pose, the second no reprojection error."""
    rng, sizes = np.random.default_rng(seed), np.random.default_rng(0)
    planted = []
    for i in range(count):
        name = HOSTILE if i == 0 else f"scene/{i:04d}"
        m, n = (int(size) for size in sizes.integers(10, 99, 2))
        for estimate in estimates:
            found = i % 7 != 6
            errors = (
                [float(rng.gamma(1, 8)), *rng.gamma(1, 0.5, 3).tolist()] if found else [180.0, np.inf, np.inf, 180.0]
            )
            if i == 1:
                errors[3] = np.nan
            converged = found and bool(rng.random() < 0.8)
            inliers, seconds = int(rng.integers(0, m)), float(rng.gamma(4, 0.01))
            planted.append(
                ProblemRow(i, name, estimate, *errors, inliers, m, n, min(m, n), 12, 1e-8, converged, found, seconds)
            )
    return planted


def planted(sizes: tuple[int, ...], clutter: int) -> Batch:
    """Exact problems; `clutter` points of each side have no match, and matches are shuffled."""
    scenes = [
        plant(1, size - clutter, seed=i, outliers2d=clutter, outliers3d=clutter, dtype=torch.float32)
        for i, size in enumerate(sizes)
    ]
    return replace(padded(scenes), ids=tuple(f"problem {i}" for i in range(len(sizes))))


def row(index: int, estimate: str = "pnp", **changes: object) -> ProblemRow:
    """A row of random errors, with changes."""
    values = np.random.default_rng(index).gamma(1.0, 5.0, 4).tolist()
    first = ProblemRow(index, f"problem {index}", estimate, *values, 3, 10, 12, 9, 4, 1e-7, True, True, 0.25)
    return replace(first, **changes)  # type: ignore[arg-type]


def drawn_problem(index: int, name: str, count: int = 30) -> ProblemPoints:
    """Points in front of a camera, exactly projected; `ransac` is the true pose, `pnp` has none."""
    rng = np.random.default_rng(index)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.2, 4.0])
    points3d = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    match = np.arange(count, dtype=np.int32)
    missing = (np.full((3, 3), np.nan), np.full(3, np.nan))
    estimates = {"ransac": (rotation, translation), "pnp": missing}
    points2d = seen(points3d, rotation, translation).astype(np.float32)
    return ProblemPoints(
        index, name, points2d, points3d, match, match[::-1].copy(), (rotation, translation), estimates, 2.0
    )


def write_run(folder: Path, count: int, seed: int) -> Results:
    """Results with the points of their worst and their first pair."""
    planted = rows(count, seed)
    results = write_results(folder / "test", planted, correspondence_loss=0.25, settings={"command": HOSTILE})
    first = [row for row in planted if row.estimate == "ransac"]
    worst = max(first, key=lambda row: (row.rotation_error_deg, -row.index))
    write_points(folder / "test", [drawn_problem(row.index, row.id) for row in (first[0], worst)])
    return results
