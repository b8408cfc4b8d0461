"""Shared parts of the benchmarks: options, the outcome of a problem, the summary of many, and the record file."""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.special import fdtr

from bpnp import Solution, warm_up
from bpnp.arrays import Array, PoseArrays
from bpnp.files import write_atomically
from bpnp.search.verdict.covariance import student_factor
from bpnp.search.verdict.uncertainty import BLOCKS, FEWEST_IN_BLOCKS, POSE

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("BPNP_SHARED_DATA", ROOT.parent / "shared" / "data"))
TIME_LIMIT = 60.0  # seconds, enough for a search to end by its own rules, also on a busy machine
NO_POSE_DEG = 180.0
NEAR_FOCAL = 0.03  # largest relative error of a correct focal length; of a camera centre, in depths
MOST_SIGMAS = 3.0  # standard deviations that the error of a focal length may have
FAR_DEG = 3.0  # from which a confident pose with an unknown focal length is counted, whatever its bound
BOUND = 0.999  # probability of the region around a pose that `beyond_bound` tests
BOUNDS = (0.5, 0.9, 0.99, BOUND)  # probabilities of regions for which a summary has the fraction of errors inside

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform to another frame of a scene: p is at scale * turn p + shift."""

    scale: float
    turn: Array
    shift: Array

    def points(self, points3d: Array) -> Array:
        return self.scale * points3d @ self.turn.T + self.shift

    def pose(self, rotation: Array, translation: Array) -> PoseArrays:
        """A camera's pose, its depths in the unit of the new frame."""
        turned = rotation @ self.turn.T
        return turned, self.scale * translation - turned @ self.shift


def parser(doc: str | None, *, without: Collection[str] = ()) -> argparse.ArgumentParser:
    """Return a parser with the options that most benchmarks have, whose help is `doc`."""
    result = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    options: dict[str, dict[str, Any]] = {
        "data": {"type": Path, "default": DATA, "help": "folder with colmap, photos and psb"},
        "seed": {"type": int, "default": 9, "help": "of the problems and of the search (default: %(default)s)"},
        "only": {"nargs": "+", "default": [""], "help": "parts of names: only rows with one of them"},
        "limit": {"type": positive, "default": 12, "help": "problems a row (default: %(default)s)"},
        "time-limit": {"type": float, "default": TIME_LIMIT, "help": "seconds a problem (default: %(default)s)"},
        "output": {"type": Path, "help": "JSON file for machine, commit, command and rows"},
    }
    for name, settings in options.items():
        if name not in without:
            result.add_argument(f"--{name}", **settings)
    return result


def positive(text: str) -> int:
    """Return a positive integer of a command line."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive integer")
    return int(text)


def select(items: Iterable[T], only: Sequence[str], name: Callable[[T], str]) -> Iterator[T]:
    """Yield the items with one of these parts in their name, and exit with an error if there is none."""
    found = False
    for item in items:
        if any(part in name(item) for part in only):
            found = True
            yield item
    if not found:
        sys.exit(f"no row has {' or '.join(map(repr, only))} in its name")


def spread(items: Sequence[T], limit: int, first: float = 0.0) -> list[T]:
    """Return at most `limit` items, evenly spread; the first one after this fraction of a step."""
    count = min(limit, len(items))
    return [items[int((k + first) * len(items) / count)] for k in range(count)]


@dataclass(frozen=True)
class Problem:
    """A problem and its true poses: each of them is correct. There is none if the points have no pose in common."""

    name: str
    solve: Callable[[], Solution]
    poses: Sequence[PoseArrays]
    points3d: Array = field(default_factory=lambda: np.zeros((1, 3)))  # the centroid is used for the errors
    distance: float = 1.0  # unit of the error of the camera's centre
    focal: float = np.nan  # true focal length in pixels, if it is estimated


@dataclass(frozen=True)
class Outcome:
    """Errors of the pose of a problem against the nearest true pose."""

    problem: str
    rotation_deg: float
    shift: float  # of the camera centre, in units of the problem's distance
    verdict: str  # "" for a method without one
    cpu_seconds: float
    outside: bool = True  # the true poses lie outside the 99.9 % bound (`beyond_bound`)
    region: float = 1.0  # probability of the smallest region of the solution that holds the nearest true rotation
    focal: float = np.nan  # estimated over true focal length; NaN if it was given
    moved: float = 0.0  # of the scene's centroid in the camera frame, over its distance
    focal_sigmas: float = np.nan  # error of the estimated focal length in standard deviations
    sigmas: Sequence[float] = ()  # errors of a nearly correct pose in standard deviations (`sigmas`)
    reason: str = ""  # of the verdict
    rotation: Sequence[Sequence[float]] = ()  # of the estimated pose (3, 3); empty if only its errors are known
    translation: Sequence[float] = ()


@dataclass(frozen=True)
class Row:
    """Row of a benchmark: the function that draws its problems, and the limits of a correct pose."""

    name: str
    draw: Callable[[], Iterable[Problem | Outcome]]
    right_deg: float
    right_shift: float = np.inf
    right_moved: float = np.inf
    excused: bool = True  # False: a confident pose that is not right is wrong even within its own bound

    def is_right(self, one: Outcome) -> bool:
        limits = (one.rotation_deg, self.right_deg), (one.shift, self.right_shift), (one.moved, self.right_moved)
        return all(error < limit or np.isinf(limit) for error, limit in limits)

    def is_wrong(self, one: Outcome) -> bool:
        """Return True if a pose is not correct, and a confident one would break its promise."""
        return not self.is_right(one) and (one.outside or not self.excused)

    def is_confident_and_wrong(self, one: Outcome) -> bool:
        return one.verdict == "confident" and self.is_wrong(one)


def solve_problem(problem: Problem) -> Outcome:
    start = time.process_time()
    found = problem.solve()
    seconds = time.process_time() - start
    turn, shift, moved, pose = nearest(problem, found.rotation, found.translation)
    outside = all(beyond_bound(found, one) for one in problem.poses)
    region = 1.0 if pose is None else regions(found, pose)[0]
    off = sigmas(found, pose, np.median(problem.points3d, 0)) if turn < FAR_DEG else []
    focal = float(found.focal_length / problem.focal)
    error = abs(found.focal_length - problem.focal) / max(found.focal_length_std, np.finfo(float).tiny)
    answer = found.reason, found.rotation.tolist(), found.translation.tolist()
    return Outcome(
        problem.name, turn, shift, found.verdict, seconds, outside, region, focal, moved, error, off, *answer
    )


def nearest(problem: Problem, rotation: Array, translation: Array) -> tuple[float, float, float, Any]:
    """Return the angle in degrees to the nearest true pose, the shifts as in `Outcome`, and that pose."""
    centroid, errors = np.median(problem.points3d, 0), []
    for true in problem.poses:
        at = true[0] @ centroid + true[1]
        moved = np.linalg.norm(rotation @ centroid + translation - at) / max(np.linalg.norm(at), np.finfo(float).tiny)
        shift = np.linalg.norm(rotation.T @ translation - true[0].T @ true[1]) / problem.distance
        errors.append((degrees(rotation, true[0]), float(shift), float(moved), true))
    return min(errors, default=(NO_POSE_DEG, np.inf, np.inf, None), key=lambda error: error[0])


def beyond_bound(found: Solution, pose: PoseArrays) -> bool:
    """Return True if the true rotation, or the true pose, lies outside the 99.9 % region of the solution.

    A confident pose counts as wrong if it is some degrees off and outside of this region.
    """
    return max(regions(found, pose)) > BOUND


def regions(found: Solution, pose: PoseArrays) -> tuple[float, float]:
    """Return the probabilities of the smallest regions that hold the true rotation, and the true pose; 1 without any.

    As for the bound in `reason`, a region holds the errors e with e^T C^-1 e / d below a quantile of F with d and the
    degrees of freedom of the residuals. C is the covariance without the factor that widens it for few residuals.
    """
    squared, free = np.square(sigmas(found, pose, np.zeros(3))), max(2 * len(found.matches) - len(found.covariance), 1)
    if len(found.covariance) == POSE and len(found.matches) >= FEWEST_IN_BLOCKS:
        free = min(free, BLOCKS**2 - 1)
    if not len(squared):
        return 1.0, 1.0
    widened = student_factor(free)
    turned, moved = (float(fdtr(d, free, squared[:d].sum() * widened / d)) for d in (3, len(squared)))
    return turned, moved


def sigmas(found: Solution, pose: PoseArrays, centroid: Array) -> list[float]:
    """Return the errors along six independent directions, in their standard deviations by the covariance.

    The directions of the rotation come first. The shift is that of the centroid of the scene (3,), because far from it
    a rotation moves points by more than its first order. The list is empty for a solution without a covariance.
    """
    (rotation, translation), rotated = pose, found.rotation @ centroid
    if not (np.isfinite(found.covariance).all() and np.isfinite(rotation).all()):
        return []
    moved = np.eye(6)
    moved[3:, :3] = np.cross(np.eye(3), rotated).T  # w x (R m)
    covariance = moved @ found.covariance[:6, :6] @ moved.T  # an unknown focal length is the last one
    shift = rotation @ centroid + translation - rotated - found.translation
    error = np.r_[Rotation.from_matrix(rotation @ found.rotation.T).as_rotvec(), shift]
    unit = 1 / np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # radians and units of the scene differ by decades
    scaled = covariance * np.outer(unit, unit) + 1e-12 * np.eye(6)
    return np.linalg.solve(np.linalg.cholesky(scaled), error * unit).tolist()


def degrees(one: Any, other: Any) -> float:
    """Return the angle between two rotations (3, 3), degrees; 180 if one of them is NaN."""
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return NO_POSE_DEG
    return float(np.degrees(Rotation.from_matrix(one @ other.T).magnitude()))


def summary(found: Sequence[Outcome], row: Row) -> dict[str, Any]:
    """Return the figures of a row.

    They are the quartiles of the rotation error; the fractions of correct, of wrong (`Row.is_wrong`) and of confident
    poses; the number of poses that are confident and wrong; mean and median CPU seconds; and the fraction of the errors
    of correct poses within 1, 2 and 3 of their standard deviations; the fractions of confident poses whose rotation is
    inside the bounds of `BOUNDS`. With unknown focal lengths also: the fraction that
    is near the true one; the number of confident poses that are more than `FAR_DEG` off; the number of confident poses
    whose focal length is off by more than `MOST_SIGMAS` standard deviations or whose centre is off by more than
    `NEAR_FOCAL`; and the fraction of poses that are correct, confident, and not off in this way.
    """
    turn, focal, seconds = np.array([(o.rotation_deg, o.focal, o.cpu_seconds) for o in found]).T
    right, sure = np.array([row.is_right(o) for o in found]), np.array([o.verdict == "confident" for o in found])
    wrong = np.array([row.is_wrong(o) for o in found])
    result: dict[str, Any] = {
        "problems": len(found),
        "rotation_q_deg": [round(float(q), 4) for q in np.percentile(turn, (25, 50, 75))],
        "right": round(float(right.mean()), 4),
        "wrong": round(float(wrong.mean()), 4),
        "confident": round(float(sure.mean()), 4) if any(o.verdict for o in found) else None,
        "confident_and_wrong": sum(map(row.is_confident_and_wrong, found)),
        "cpu_seconds": round(float(seconds.mean()), 4),
        "median_cpu_seconds": round(float(np.median(seconds)), 4),
    }
    if off := [abs(one) for o, good in zip(found, right, strict=True) if good for one in o.sigmas]:
        result["sigmas"] = [round(float((np.array(off) < limit).mean()), 4) for limit in (1, 2, 3)]
    if sure.any():
        region = np.array([o.region for o in found])[sure]
        result["bounds"] = [round(float((region <= bound).mean()), 4) for bound in BOUNDS]
    if np.isfinite(focal).any():
        result["focal_near"] = round(float((np.abs(focal - 1) < NEAR_FOCAL).mean()), 4)
        result["confident_and_far"] = int((sure & (turn > FAR_DEG)).sum())
        beyond = np.array([o.focal_sigmas > MOST_SIGMAS or o.shift > NEAR_FOCAL for o in found])
        result["confident_and_off"] = int((sure & beyond).sum())
        result["right_and_confident"] = round(float((right & sure & ~beyond).mean()), 4)
    return result


def measure_rows(rows: Iterable[Row]) -> Iterator[tuple[Row, dict[str, Any], list[Outcome]]]:
    """Yield the rows with summary and outcomes, and print a line for each.

    The problems of a row are drawn before the first of them is solved.
    """
    warm_up()
    for row in rows:
        found = [one if isinstance(one, Outcome) else solve_problem(one) for one in list(row.draw())]
        if not found:
            print(f"{row.name}: no problems", flush=True)
            continue
        result = summary(found, row)
        values = (f"{name.replace('_', ' ')} {value}" for name, value in result.items())
        print(f"{row.name}: {', '.join(values)}", flush=True)
        yield row, result, found


def run(rows: Iterable[Row], options: argparse.Namespace) -> list[tuple[Row, list[Outcome]]]:
    """Measure and return the rows that `--only` selects, and write each with its outcomes to `--output` at once."""
    measured, results = [], {}
    for row, result, found in measure_rows(select(rows, options.only, lambda row: row.name)):
        measured.append((row, found))
        results[row.name] = result | {"outcomes": [asdict(outcome) for outcome in found]}
        if options.output:
            write(options.output, {"rows": results})
    return measured


def write(path: Path, record: dict[str, Any]) -> None:
    """Write a JSON file of the measurements, with the machine, the commit and the command."""
    write_json(path, {"commit": commit(), "command": command(sys.argv), "machine": machine()} | record)


def write_json(path: Path, record: dict[str, Any]) -> None:
    """Write a JSON file."""
    with write_atomically(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")


@cache
def commit() -> str:
    """Return the commit of this checkout at the first call; it ends in "-dirty" if files differ from it.

    `python -m benchmarks` calls it at the start: a record that is written, or a later commit, does not change it.
    """
    described = subprocess.run(
        ["git", "-C", ROOT, "describe", "--always", "--dirty"], capture_output=True, text=True, check=False
    )
    return described.stdout.strip() or "unknown"


def measured_today() -> dict[str, str]:
    """Return the commit, the date (UTC) and the processor of a measurement."""
    return {"commit": commit(), "date": f"{datetime.now(UTC):%Y-%m-%d}", "cpu": processor()}


def command(words: Sequence[str]) -> str:
    """Return a command line in which absolute paths are shortened to their last part.

    >>> command(["python -m benchmarks table1", "--run", "/tmp/runs/table1", "--data=/tmp/data", "--steps", "3"])
    'python -m benchmarks table1 --run table1 --data=data --steps 3'
    """
    parts = (word.rpartition("=") for word in words)
    return " ".join(name + sign + (Path(value).name if value.startswith("/") else value) for name, sign, value in parts)


def processor() -> str:
    """Return the name of the processor."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def machine() -> dict[str, Any]:
    """Return the machine on which the figures were measured, and its load."""
    return {
        "kind": f"cpu-{os.cpu_count()}core",
        "cpu": processor(),
        "threads": torch.get_num_threads(),
        "load_average": [round(x, 2) for x in os.getloadavg()],
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
