"""What all benchmarks share: their options, the outcome of a problem, the summary of many, and the file of a record."""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import fdtri, stdtrit

from bpnp import Solution, warm_up
from bpnp.files import written_whole
from bpnp.search.evidence.uncertainty import ONE_SIGMA

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("BPNP_SHARED_DATA", ROOT.parent / "shared" / "data"))
TIME_LIMIT = 60.0  # seconds: so many that a search ends by its own rules, also on a busy machine
NO_POSE_DEG = 180.0
NEAR_FOCAL = 0.03  # of a focal length that counts as right
FAR_DEG = 3.0  # from which a confident pose with an unknown focal length is counted, whatever its bound
BOUND = 0.999  # share of the confident poses that are within their bound

T = TypeVar("T")
Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation, translation: camera = R p + t


@dataclass(frozen=True, eq=False)
class Similarity:
    """Another frame of a scene, in which p is at scale * turn p + shift."""

    scale: float
    turn: Array
    shift: Array

    def points(self, points3d: Array) -> Array:
        return self.scale * points3d @ self.turn.T + self.shift

    def pose(self, rotation: Array, translation: Array) -> Pose:
        """A camera's pose, its depths in the unit of the new frame."""
        turned = rotation @ self.turn.T
        return turned, self.scale * translation - turned @ self.shift


def parser(doc: str | None) -> argparse.ArgumentParser:
    """The options that every benchmark has: data, seed, number of problems, rows, and a file for the record."""
    result = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("--data", type=Path, default=DATA, help="folder with colmap, photos and psb")
    result.add_argument("--seed", type=int, default=9, help="of the problems and of the search (default: %(default)s)")
    result.add_argument("--limit", type=int, default=12, help="problems a row (default: %(default)s)")
    result.add_argument("--only", nargs="*", default=[""], help="parts of names: only rows with one of them")
    result.add_argument("--output", type=Path, help="JSON file for machine, commit, command and rows")
    return result


def spread(items: Sequence[T], limit: int, first: float = 0.0) -> list[T]:
    """At most `limit`, spread evenly, the first one after this part of a step."""
    return [items[k] for k in sorted({int((k + first) * len(items) / limit) for k in range(limit)})]


@dataclass(frozen=True)
class Problem:
    """Something to solve, and the poses of which any is right: none where points have no pose in common.

    points3d: of the scene, whose middle tells how far a pose is off. distance: unit of the error of the camera's
    centre. focal: the true focal length in pixels, scale: that of a rig's scene, where it is to be found too.
    """

    name: str
    solve: Callable[[], Solution]
    poses: Sequence[Pose]
    points3d: Array = field(default_factory=lambda: np.zeros((1, 3)))
    distance: float = 1.0
    focal: float = np.nan
    scale: float = np.nan


@dataclass(frozen=True)
class Outcome:
    """Of one problem: error of the rotation, and of the camera's centre in units of the problem's distance.

    verdict: "" of a method that has none. outside: whether the true pose lies beyond the bound that the solution claims
    (`beyond_bound`). focal: the focal length that was found, of the true one; NaN where it was known. scale_sigmas: how
    far the scale is off in its own standard deviations; None where it was known.
    """

    problem: str
    rotation_deg: float
    shift: float
    verdict: str
    cpu_seconds: float
    outside: bool = True
    focal: float = np.nan
    scale_sigmas: float | None = None


Rows = Iterable[tuple[str, Callable[[], Iterable[Problem | Outcome]]]]  # the name of each, and what draws its problems


def outcomes(problems: Iterable[Problem | Outcome]) -> list[Outcome]:
    """What is found of each, compared with its first pose; all are drawn before the first one is solved."""
    return [one if isinstance(one, Outcome) else solved(one) for one in list(problems)]


def solved(problem: Problem) -> Outcome:
    rotation, translation = problem.poses[0]
    start = time.process_time()
    found = problem.solve()
    seconds = time.process_time() - start
    shift = np.linalg.norm(found.rotation.T @ found.translation - rotation.T @ translation) / problem.distance
    outside = beyond_bound(found, rotation, translation)
    turn, ratio = degrees(found.rotation, rotation), float(found.focal_length / problem.focal)
    sigmas = abs(found.scale - problem.scale) / found.scale_std if np.isfinite(problem.scale) else None
    return Outcome(problem.name, turn, float(shift), found.verdict, seconds, outside, ratio, sigmas)


def beyond_bound(found: Solution, rotation: Any, translation: Any) -> bool:
    """Whether the true rotation, or the true pose, lies outside the region that the solution claims to hold it with a
    probability of 99.9 %, as the bound in `reason` does: of errors e with e^T C^-1 e / d below the quantile of F with
    d and the degrees of freedom of the residuals, C the covariance less what widens it for few residuals.

    The promise of a confident pose is broken by one that is wrong (some degrees off) and beyond its bound.
    """
    if not (np.isfinite(found.covariance).all() and np.isfinite(rotation).all()):
        return True
    error = np.r_[Rotation.from_matrix(rotation @ found.rotation.T).as_rotvec(), translation - found.translation]
    size = 3 if len(found.covariance) < 6 else 6  # of directions the rotation alone; a focal length is the last one
    error, covariance = error[:size], found.covariance[:size, :size]
    unit = 1 / np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # radians and units of the scene differ by decades
    free = max(2 * len(found.matches) - len(found.covariance), 1)
    widened = stdtrit(free, ONE_SIGMA) ** 2
    return any(
        (error * unit)[:d] @ np.linalg.pinv((covariance * np.outer(unit, unit))[:d, :d]) @ (error * unit)[:d]
        > d * fdtri(d, free, BOUND) / widened
        for d in (3, size)
    )


def sigmas(found: Solution, rotation: Any, translation: Any, middle: Array) -> list[float]:
    """The error of a pose along six independent directions, in the standard deviations that its covariance claims; that
    of the shift at the middle of the scene (3,), since far from it a turn moves points by more than the first order."""
    if found.covariance.shape != (6, 6) or not np.isfinite(found.covariance).all():
        return []
    seen = found.rotation @ middle
    moved = np.eye(6)
    moved[3:, :3] = np.cross(np.eye(3), seen).T  # w x (R m)
    covariance = moved @ found.covariance @ moved.T
    shift = rotation @ middle + translation - seen - found.translation
    error = np.r_[Rotation.from_matrix(rotation @ found.rotation.T).as_rotvec(), shift]
    unit = 1 / np.sqrt(np.diag(covariance))
    return np.linalg.solve(np.linalg.cholesky(covariance * np.outer(unit, unit)), error * unit).tolist()


def degrees(one: Any, other: Any) -> float:
    """Angle between two rotations (3, 3), 180 where one is not there."""
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return NO_POSE_DEG
    return float(np.degrees(Rotation.from_matrix(one @ other.T).magnitude()))


def summary(found: Sequence[Outcome], right_deg: float, right_shift: float = np.inf) -> dict[str, Any]:
    """Quartiles of the rotation's error, shares right and confident, how many are confident, wrong and beyond their own
    bound, CPU seconds; where focal lengths were not known the share that are near, and how many are confident and far.
    """
    turn, shift = (np.array([getattr(o, name) for o in found]) for name in ("rotation_deg", "shift"))
    right = (turn < right_deg) & ((shift < right_shift) | np.isinf(right_shift))
    sure = np.array([o.verdict == "confident" for o in found])
    focal = np.array([o.focal for o in found])
    near: dict[str, Any] = {}
    if np.isfinite(focal).any():
        near["focal_near"] = round(float((np.abs(focal - 1) < NEAR_FOCAL).mean()), 4)
        near["confident_and_far"] = int((sure & (turn > FAR_DEG)).sum())
    if sigmas := [o.scale_sigmas for o in found if o.scale_sigmas is not None]:
        near["scale_sigmas"] = [round(float((np.array(sigmas) < limit).mean()), 4) for limit in (1, 2, 3)]
    return near | {
        "problems": len(found),
        "rotation_q_deg": [round(float(q), 4) for q in np.percentile(turn, (25, 50, 75))],
        "right": round(float(right.mean()), 4),
        "confident": round(float(sure.mean()), 4) if any(o.verdict for o in found) else None,
        "confident_and_wrong": int((sure & ~right & np.array([o.outside for o in found])).sum()),
        "cpu_seconds": round(float(np.mean([o.cpu_seconds for o in found])), 4),
        "median_cpu_seconds": round(float(np.median([o.cpu_seconds for o in found])), 4),
    }


def line(row: dict[str, Any]) -> str:
    """A summary on one line."""
    quartiles = " / ".join(f"{q:.3g}" for q in row["rotation_q_deg"])
    confident = "-" if row["confident"] is None else f"{row['confident']:.0%}"
    return (
        f"{row['problems']} problems, rotation {quartiles} deg, right {row['right']:.0%}, confident {confident}, "
        f"of them wrong {row['confident_and_wrong']}, {row['cpu_seconds']:.3g} CPU s, "
        f"median {row['median_cpu_seconds']:.3g}"
        + (
            f", focal length within {NEAR_FOCAL:.0%}: {row['focal_near']:.0%}, "
            f"confident and beyond {FAR_DEG:g} deg {row['confident_and_far']}"
            if "focal_near" in row
            else ""
        )
        + (f", scale within 1, 2, 3 sigmas: {row['scale_sigmas']}" if "scale_sigmas" in row else "")
    )


def measured(rows: Rows, options: argparse.Namespace, right_deg: float, right_shift: float = np.inf) -> None:
    """Print a line for each row as it comes, and write all with their outcomes to `--output`."""
    warm_up()
    results: dict[str, dict[str, Any]] = {}
    for name, problems in rows:
        if not any(part in name for part in options.only):
            continue
        found = outcomes(problems())
        if not found:
            print(f"{name}: no problems", flush=True)
            continue
        results[name] = summary(found, right_deg, right_shift)
        print(f"{name}: {line(results[name])}", flush=True)
        if options.output:
            results[name]["outcomes"] = [asdict(outcome) for outcome in found]
            write(options.output, {"rows": results})


def write(path: Path, record: dict[str, Any]) -> None:
    """A JSON file of what was measured, with the machine, the commit and the command that measured it."""
    commit = subprocess.run(
        ["git", "-C", ROOT, "describe", "--always", "--dirty"], capture_output=True, text=True, check=False
    )
    head = {"commit": commit.stdout.strip() or "unknown", "command": " ".join(sys.argv), "machine": machine()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(head | record, indent=1) + "\n")


def machine() -> dict[str, Any]:
    """What the figures were measured on, and how busy it was."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "kind": f"cpu-{os.cpu_count()}core",
        "cpu": names[0] if names else platform.processor(),
        "threads": torch.get_num_threads(),
        "load_average": [round(x, 2) for x in os.getloadavg()],
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
