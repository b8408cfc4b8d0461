"""Track a controller with 17 LEDs for 20 seconds at 60 frames per second, and find it again behind an occluder.

    python examples/constellation.py [--seconds 20] [--seed 0] [--out constellation.png]

The run is simulated and takes about one CPU second per second. The controller moves and rotates in front of a
camera; three other lights are in the room. From second 6 to 8 it is hidden completely, from 12 to 14 mostly. Each frame
is solved by `bpnp.solve` with a prior, the pose extrapolated from the last two frames. If the prior does not fit, all
poses are searched. Every 30th frame is first solved without the prior, so that a wrong pose cannot confirm itself. The
program prints a summary and draws some frames, the errors and the times.
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rich.progress
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial.transform import Rotation

import bpnp

Array = NDArray[np.float64]
RATE = 60  # frames per second
FOCAL, SIZE = 600.0, (640, 480)
CAMERA = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
FACING = math.cos(math.radians(78.0))
HIDDEN, HALF_HIDDEN = (6.0, 8.0), (12.0, 14.0)  # seconds
AGAIN = 30  # every 30th frame is first solved without the prior
SIGMA_DEG, SIGMA = 3.0, 0.012  # standard deviation of a predicted pose, degrees and metres


class Seen(NamedTuple):
    """A frame: its time, seconds; pixels (m, 2); the true pose; and the number of visible LEDs."""

    second: float
    pixels: Array
    rotation: Array
    translation: Array
    leds: int


class Answer(NamedTuple):
    """Result for a frame: rotation error, degrees, NaN without a pose; verdict; CPU milliseconds; pose."""

    error: float
    verdict: str
    milliseconds: float
    predicted: bool
    rotation: Array
    translation: Array


def controller(seed: int) -> tuple[Array, Array]:
    """Return 17 LEDs (17, 3) on a ring with a radius of 5 cm, metres, and their outward normals (17, 3)."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(17) + rng.uniform(-0.3, 0.3, 17)) / 17
    tilt = np.radians(rng.uniform(-35, 35, 17))
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], -1)
    up = np.array([0.0, 0, 1])
    points = 0.05 * outward + rng.uniform(-0.012, 0.012, 17)[:, None] * up
    return points, np.cos(tilt)[:, None] * outward + np.sin(tilt)[:, None] * up


def motion(second: float) -> tuple[Array, Array]:
    """Return the pose of the controller: slow rotations about two axes, and faster movements of the hand."""
    turn = Rotation.from_euler("zxy", [0.9 * second, 1.1 + 0.7 * math.sin(0.8 * second), 0.6 * math.sin(1.3 * second)])
    place = [0.09 * math.sin(1.1 * second), 0.06 * math.sin(1.7 * second), 0.45 + 0.12 * math.sin(0.6 * second)]
    return turn.as_matrix(), np.array(place)


def picture(second: float, points: Array, normals: Array, rng: np.random.Generator) -> Seen:
    """Draw a frame: LEDs that face the camera, with 0.3 pixels of noise and 5 % missing, and three other lights."""
    rotation, translation = motion(second)
    camera = points @ rotation.T + translation
    sight = camera / np.linalg.norm(camera, axis=-1, keepdims=True)
    shown = (-(sight * (normals @ rotation.T)).sum(-1) > FACING) & (rng.random(len(points)) > 0.05)
    pixels = FOCAL * camera[:, :2] / camera[:, 2:] + np.array(SIZE) / 2
    if HIDDEN[0] <= second < HIDDEN[1]:
        shown[:] = False
    if HALF_HIDDEN[0] <= second < HALF_HIDDEN[1]:
        shown &= pixels[:, 0] > np.median(pixels[:, 0])
    lights = np.array([[90.0, 60], [560, 120], [330, 420]])
    seen = np.concatenate([pixels[shown] + 0.3 * rng.standard_normal((shown.sum(), 2)), lights])
    return Seen(second, rng.permutation(seen), rotation, translation, int(shown.sum()))


def track(frames: Sequence[Seen], points: Array, normals: Array) -> list[Answer]:
    """Solve all frames, each with the pose extrapolated from the last two as a prior.

    A pose is accepted if it is confident, or if it is ambiguous and close to the prediction.
    """
    answers: list[Answer] = []
    for number, seen in enumerate(rich.progress.track(frames, "tracking", console=Console(stderr=True))):
        prior, solution, predicted = prediction(answers), None, False
        start = time.process_time()
        if len(seen.pixels) >= 4:
            if prior is None or number % AGAIN == 0:
                solution = bpnp.solve(seen.pixels, points, CAMERA, normals3d=normals)
            if prior is not None and (solution is None or solution.verdict != "confident"):
                solution, predicted = bpnp.solve(seen.pixels, points, CAMERA, normals3d=normals, prior=prior), True
        milliseconds = 1000 * (time.process_time() - start)
        if solution is None or not (solution.verdict == "confident" or (predicted and continues(solution, prior))):
            verdict = "failed" if solution is None else solution.verdict
            answers.append(Answer(math.nan, verdict, milliseconds, predicted, *no_pose()))
            continue
        error = math.degrees(Rotation.from_matrix(solution.rotation @ seen.rotation.T).magnitude())
        pose = solution.rotation, solution.translation
        answers.append(Answer(error, solution.verdict, milliseconds, predicted, *pose))
    return answers


def continues(solution: bpnp.Solution, prior: bpnp.PosePrior | None) -> bool:
    """Return True if an ambiguous pose is within three standard deviations of the prediction."""
    if prior is None or solution.verdict == "failed" or prior.translation is None:
        return False
    turn = Rotation.from_matrix(solution.rotation @ np.asarray(prior.rotation).T).magnitude()
    shift = np.linalg.norm(solution.translation - np.asarray(prior.translation))
    return bool(math.degrees(turn) < 3 * prior.rotation_sigma_deg and shift < 3 * prior.translation_sigma)


def prediction(answers: Sequence[Answer]) -> bpnp.PosePrior | None:
    """Return the pose extrapolated from the last two at constant velocity; None without a last pose."""
    if not answers or math.isnan(answers[-1].error):
        return None
    last = answers[-1]
    if len(answers) == 1 or math.isnan(answers[-2].error):
        return bpnp.PosePrior(last.rotation, last.translation, 2 * SIGMA_DEG, 2 * SIGMA)
    before = answers[-2]
    rotation = last.rotation @ before.rotation.T @ last.rotation
    return bpnp.PosePrior(rotation, 2 * last.translation - before.translation, SIGMA_DEG, SIGMA)


def no_pose() -> tuple[Array, Array]:
    """Return a pose of NaN."""
    return np.full((3, 3), math.nan), np.full(3, math.nan)


def longest(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    most = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        most = max(most, run)
    return most


def summary(frames: Sequence[Seen], answers: Sequence[Answer]) -> dict[str, float]:
    """Return the figures of a run by name."""
    visible = np.array([seen.leds >= 5 for seen in frames])
    error = np.array([answer.error for answer in answers])
    times = np.array([answer.milliseconds for answer in answers])
    predicted = np.array([answer.predicted for answer in answers])
    wrong = error > 3
    return {
        "pictures": len(frames),
        "tracked % of those with 5 LEDs or more": 100 * float((error[visible] < 3).mean()),
        "wrong % of all": 100 * float(wrong.mean()),
        "longest wrong, s": longest(wrong) / RATE,
        "median error, deg": float(np.nanmedian(error)),
        "p50 ms, predicted": float(np.median(times[predicted])),
        "p99 ms, predicted": float(np.percentile(times[predicted], 99)),
        "p50 ms, not predicted": float(np.median(times[~predicted & visible])),
        "found again after hidden, s": found_after(HIDDEN[1], frames, error),
        "found again after mostly hidden, s": found_after(HALF_HIDDEN[1], frames, error),
    }


def found_after(end: float, frames: Sequence[Seen], error: Array) -> float:
    """Return the seconds from the end of an occlusion to the next right pose; NaN if there is none."""
    return next((seen.second - end for k, seen in enumerate(frames) if seen.second >= end and error[k] < 3), math.nan)


def draw(frames: Sequence[Seen], answers: Sequence[Answer], points: Array, path: Path) -> None:
    """Draw some frames with the estimated pose, and the errors and times of the run."""
    import matplotlib.pyplot as plt

    seconds = np.array([seen.second for seen in frames])
    moments = [s for s in (2, 4, 5.9, 7, 9, 11, 13, 18) if s <= seconds[-1]]
    figure = plt.figure(figsize=(13, 7), layout="constrained")
    grid = figure.add_gridspec(3, max(len(moments), 1), height_ratios=[1.2, 1, 1])
    for column, moment in enumerate(moments):
        k = int(np.argmin(np.abs(seconds - moment)))
        axes: Any = figure.add_subplot(grid[0, column])
        axes.plot(*frames[k].pixels.T, "o", color="black", ms=3)
        if not math.isnan(answers[k].error):
            camera = points @ answers[k].rotation.T + answers[k].translation
            axes.plot(*(FOCAL * camera[:, :2] / camera[:, 2:] + np.array(SIZE) / 2).T, "o", mfc="none", color="#cb181d")
        axes.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0), xticks=[], yticks=[], aspect="equal")
        axes.set_title(f"{moment:g} s: {answers[k].verdict}", fontsize=8)
    error, times = (np.array([getattr(answer, name) for answer in answers]) for name in ("error", "milliseconds"))
    predicted = np.array([answer.predicted for answer in answers])
    below = figure.add_subplot(grid[1, :])
    below.semilogy(seconds, error, ".", ms=2, color="#2171b5")
    below.axhline(3, color="#cb181d", lw=0.8)
    below.set(ylabel="rotation error, deg", xlim=(0, seconds[-1]))
    last = figure.add_subplot(grid[2, :], sharex=below)
    last.semilogy(seconds[predicted], times[predicted], ".", ms=2, color="#2171b5", label="with a predicted pose")
    last.semilogy(seconds[~predicted], times[~predicted], ".", ms=3, color="#cb181d", label="without")
    last.set(xlabel="seconds", ylabel="processor time, ms")
    last.legend(fontsize=8, loc="upper right")
    for axes in (below, last):
        axes.axvspan(*HIDDEN, color="0.8", lw=0)
        axes.axvspan(*HALF_HIDDEN, color="0.92", lw=0)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Simulate, track, print the figures and draw the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length; a second takes about one CPU second")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("constellation.png"))
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    points, normals = controller(options.seed)
    frames = [picture(k / RATE, points, normals, rng) for k in range(round(options.seconds * RATE))]
    print(f"{len(frames)} pictures, about {options.seconds:.0f} CPU s", file=sys.stderr)
    bpnp.solve(frames[0].pixels, points, CAMERA, normals3d=normals)  # compiles
    answers = track(frames, points, normals)
    found = summary(frames, answers)
    for name, value in found.items():
        print(f"{name:40s} {value:.4g}")
    draw(frames, answers, points, options.out)
    return found


if __name__ == "__main__":
    main()
