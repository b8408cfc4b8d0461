"""Few points: LED devices, noise, gravity, two devices, craters; success, false accepts and milliseconds.

python benchmarks/bench_constellation.py [--frames 200] [--seed 0] [--peers 20] [--only ring craters] [--out FILE.json]

Every frame has a new pose, every fifth a new device; `--seed` changes devices and frames. "right" is a rotation within
3 degrees; "limit" is the share of frames in which least squares on the true matches is that close; "wrong" counts
frames that were called confident, are not right, and are farther off than four of the standard deviations that they
claim. Milliseconds are processor time of the whole call. With --peers the constellation baseline, SoftPOSIT and blind
RANSAC are run on frames of some rows.
"""

import argparse
import contextlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from constellations import Camera, Frame, Kind, device, frame, noise_frame
from craters import crater_view
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from timing import machine, write_json

import bpnp
from bpnp.models.baselines import Constellation, RandomRansac, SoftPOSIT
from bpnp.solving.matches import fit_pose
from bpnp.types import Batch

Array = NDArray[np.float64]
RIGHT_DEG = 3.0
DEVIATIONS = 4.0  # standard deviations that one in a thousand is farther off, with equal ones about three axes
FISHEYE = Camera(focal=330.0, size=900, fisheye=True)


class Setting(NamedTuple):
    """A row of the table."""

    name: str
    kind: Kind
    background: int = 0
    missing: float = 0.0
    noise: float = 0.2
    least: int = 7
    normals: bool = True
    gravity: bool = False
    camera: Camera = Camera()
    most: int | None = None


class Outcome(NamedTuple):
    """Of one frame: error of the rotation, degrees, verdict, milliseconds, and the error of the best possible fit.

    deviation: standard deviation of the rotation, degrees, that the solution claims.
    """

    error: float
    verdict: str
    milliseconds: float
    limit: float
    deviation: float = 0.0


SETTINGS = [
    *(Setting(f"{kind}, all seen", kind) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 3 lights", kind, background=3) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 3 lights, fisheye", kind, background=3, camera=FISHEYE) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 3 lights, 1 px", kind, background=3, noise=1.0) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 8 lights, 20 % missing", kind, 8, 0.2) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 10 lights, 50 % missing", kind, 10, 0.5, least=5) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, no normals, 3 lights", kind, background=3, normals=False) for kind in ("ring", "headset")),
    *(Setting(f"{kind}, 5 seen, gravity", kind, least=5, most=5, gravity=True) for kind in ("ring", "headset")),
    Setting("drone, 3 lights", "drone", background=3, least=5, normals=False),
    Setting("marker, all seen", "marker", least=5, normals=False),
]
COMPARED = ("ring, all seen", "ring, 3 lights", "marker, all seen")
NOISE = [(6, 6), (8, 8), (10, 17), (20, 20), (30, 30), (50, 50), (10, 50), (20, 100), (100, 20)]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200, help="a row (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--peers", type=int, default=0, help="frames of some rows for the baselines")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names: only rows with one of them")
    parser.add_argument("--failures", type=Path, help="draw the first two frames of the first row that are not right")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "constellation.json")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.failures:
        setting = next(s for s in SETTINGS if any(part in s.name for part in options.only))
        draw_failures(setting, options.frames, options.seed, options.failures)
        return
    rows = [
        (name, run)
        for name, run in rows_of(options.frames, options.seed, options.peers)
        if any(part in name for part in options.only)
    ]
    record: dict[str, Any] = {"machine": machine(), "seed": options.seed, "rows": []}
    table = Table("", "frames", "right %", "limit %", "confident %", "wrong", "p50 ms", "p95", "p99")
    bpnp.solve(*_first_call())  # compiles
    for name, run in rows:
        outcomes = run()
        row = {"name": name, **summary(outcomes)}
        record["rows"].append(row)
        table.add_row(name, *(_short(value) for value in list(row.values())[1:]))
        write_json(options.out, record)
    Console().print(table)
    if record["rows"]:
        draw(record["rows"], options.out.with_suffix(".png"))


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def rows_of(frames: int, seed: int, peers: int) -> list[tuple[str, Callable[[], list[Outcome]]]]:
    """The name of every row and what measures it."""
    rows: list[tuple[str, Callable[[], list[Outcome]]]] = []
    for setting in SETTINGS:
        rows.append((setting.name, lambda setting=setting: devices(setting, frames, seed)))  # type: ignore[misc]
    rows.append(("two devices in one picture", lambda: two_devices(frames, seed)))
    rows.append(("craters", lambda: craters(frames, seed)))
    for m, n in NOISE:
        rows.append((f"noise {m} x {n}", lambda m=m, n=n: noise(m, n, frames, seed)))  # type: ignore[misc]
    for setting in [s for s in SETTINGS if peers and s.name in COMPARED]:
        for solver in (Constellation(), SoftPOSIT(start="random"), RandomRansac(threshold=0.003, time_limit=5.0)):
            rows.append(
                (
                    f"{type(solver).__name__}: {setting.name}",
                    lambda setting=setting, solver=solver: devices(setting, peers, seed, solver),  # type: ignore[misc]
                )
            )
    return rows


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """The numbers of a row; noise has no right answer."""
    right = np.array([outcome.error < RIGHT_DEG for outcome in outcomes])
    confident = np.array([outcome.verdict == "confident" for outcome in outcomes])
    far = np.array([outcome.error > DEVIATIONS * outcome.deviation for outcome in outcomes])
    times = np.array([outcome.milliseconds for outcome in outcomes])
    limit = float(np.mean([outcome.limit < RIGHT_DEG for outcome in outcomes]))
    return {
        "frames": len(outcomes),
        "right": 100 * float(right.mean()),
        "limit": 100 * limit,
        "confident": 100 * float(confident.mean()),
        "wrong": int((confident & ~right & far).sum()),
        **{f"p{share}": float(np.percentile(times, share)) for share in (50, 95, 99)},
    }


def devices(setting: Setting, frames: int, seed: int, solver: Any = "search") -> list[Outcome]:
    """Frames of one device."""
    rng = np.random.default_rng([seed, SETTINGS.index(setting)])
    return [_outcome(picture, setting, rng, solver) for picture in pictures(setting, frames, seed, rng)]


def pictures(setting: Setting, frames: int, seed: int, rng: np.random.Generator) -> list[Frame]:
    """Frames of a setting; every fifth has a new device."""
    return [_picture(setting, 1000 * seed + i // 5, rng) for i in range(frames)]


def _picture(setting: Setting, seed: int, rng: np.random.Generator) -> Frame:
    """A frame of the device with this seed, or of the next one whose LEDs can be seen."""
    for number in range(100):
        with contextlib.suppress(ValueError):
            return frame(
                device(setting.kind, seed + 10**6 * number), rng, camera=setting.camera, noise=setting.noise,
                background=setting.background, missing=setting.missing, least=setting.least, most=setting.most,
            )  # fmt: skip
    raise ValueError(f"expected a device of {setting.name} whose LEDs can be seen, got none of 100")


def _outcome(picture: Frame, setting: Setting, rng: np.random.Generator, solver: Any) -> Outcome:
    if solver != "search":
        return _peer_outcome(picture, solver)
    start = time.process_time()
    solution = _solved(picture, setting, rng)
    milliseconds = 1000 * (time.process_time() - start)
    error = degrees(solution.rotation, picture.rotation)
    return Outcome(error, solution.verdict, milliseconds, limit(picture), solution.rotation_std_deg)


def _solved(picture: Frame, setting: Setting, rng: np.random.Generator) -> bpnp.Solution:
    prior, normals = None, picture.device.normals3d if setting.normals else None
    if setting.gravity:
        up, own = picture.gravity
        tilt = Rotation.from_rotvec(np.radians(1.0) * rng.standard_normal(3)).as_matrix()
        prior = bpnp.GravityPrior(tilt @ up, own, 1.5)
    return bpnp.solve(picture.pixels, picture.device.points3d, picture.camera.model, normals3d=normals, prior=prior)


def _peer_outcome(picture: Frame, solver: Any) -> Outcome:
    """A baseline on the normalised image and a device of unit size; confident where it says that it has converged."""
    rays, size = picture.bearings, float(np.abs(picture.device.points3d).max())
    batch = Batch.from_arrays(
        [(rays[:, :2] / rays[:, 2:]).astype(np.float32)], [(picture.device.points3d / size).astype(np.float32)]
    )
    start = time.process_time()
    (pose,) = solver(batch).poses.values()
    milliseconds = 1000 * (time.process_time() - start)
    error = degrees(pose.rotation[0].double().numpy(), picture.rotation)
    verdict = "confident" if bool(pose.stats.converged[0]) else "failed"
    return Outcome(error, verdict, milliseconds, limit(picture))


def two_devices(frames: int, seed: int) -> list[Outcome]:
    """Two rings in one picture, asked for together: the error is the larger one, confident if both are."""
    rng, outcomes = np.random.default_rng([seed, 99]), []
    for i in range(frames):
        pair = [frame(device("ring", 1000 * seed + 2 * (i // 5) + j), rng, least=7) for j in range(2)]
        pixels = np.concatenate([picture.pixels for picture in pair])
        image = pixels[rng.permutation(len(pixels))]
        start = time.process_time()
        solutions = bpnp.solve_many(
            [image] * 2, [picture.device.points3d for picture in pair], pair[0].camera.model,
            normals3d=[picture.device.normals3d for picture in pair],
        )  # fmt: skip
        milliseconds = 1000 * (time.process_time() - start)
        error = max(degrees(s.rotation, picture.rotation) for s, picture in zip(solutions, pair, strict=True))
        sure = all(solution.verdict == "confident" for solution in solutions)
        best = max(limit(picture) for picture in pair)
        deviation = max(solution.rotation_std_deg for solution in solutions)
        outcomes.append(Outcome(error, "confident" if sure else "ambiguous", milliseconds, best, deviation))
    return outcomes


def craters(frames: int, seed: int) -> list[Outcome]:
    """Craters: the error counts as wrong too where the place is off by more than 5 km."""
    rng, outcomes = np.random.default_rng([seed, 98]), []
    for _ in range(frames):
        view = crater_view(rng)
        start = time.process_time()
        solution = bpnp.solve(view.pixels, view.points3d, view.camera, prior=view.prior)
        milliseconds = 1000 * (time.process_time() - start)
        off = float(np.linalg.norm(solution.centre + view.rotation.T @ view.translation))
        error = degrees(solution.rotation, view.rotation) if off < 5 else 180.0
        outcomes.append(Outcome(error, solution.verdict, milliseconds, 0.0, solution.rotation_std_deg))
    return outcomes


def noise(m: int, n: int, frames: int, seed: int) -> list[Outcome]:
    """Points that have no pose in common: every confident answer is wrong."""
    rng, outcomes = np.random.default_rng([seed, m, n]), []
    for _ in range(frames):
        pixels, points = noise_frame(m, n, rng)
        start = time.process_time()
        solution = bpnp.solve(pixels, points, Camera().model)
        outcomes.append(Outcome(180.0, solution.verdict, 1000 * (time.process_time() - start), 180.0))
    return outcomes


def limit(picture: Frame) -> float:
    """Error of least squares on the true matches, started at the true pose."""
    own = picture.led >= 0
    points = picture.device.points3d[picture.led[own]]

    def project(rotation: Array, translation: Array) -> Array:
        return picture.camera.project(points @ rotation.T + translation)

    rotation, _ = fit_pose(project, picture.pixels[own], picture.rotation, picture.translation, scale=1.0)
    return degrees(rotation, picture.rotation)


def degrees(one: Array, other: Array) -> float:
    """Angle between two rotations, 180 where there is none."""
    if not np.isfinite(one).all():
        return 180.0
    return math.degrees(Rotation.from_matrix(one @ other.T).magnitude())


def _first_call() -> tuple[Any, ...]:
    picture = frame(device("ring", 0), np.random.default_rng(0), least=7)
    return picture.pixels, picture.device.points3d, picture.camera.model


def draw_failures(setting: Setting, frames: int, seed: int, path: Path, count: int = 2) -> None:
    """Lights, where the LEDs that were detected really are, and where the answer puts them."""
    import matplotlib.pyplot as plt

    rng = np.random.default_rng([seed, SETTINGS.index(setting)])
    figure, panels = plt.subplots(1, count, figsize=(5.5 * count, 5.6), layout="constrained")
    shown = 0
    for picture in pictures(setting, frames, seed, rng):
        solution = _solved(picture, setting, rng)
        error = degrees(solution.rotation, picture.rotation)
        if error < RIGHT_DEG:
            continue
        panel, points, own = panels[shown], picture.device.points3d, picture.led >= 0
        panel.plot(*picture.pixels[~own].T, "x", color="0.5", label="lights that are not the device's")
        panel.plot(*picture.pixels[own].T, "k.", ms=9, label="detected LEDs")
        for pose, colour, size, name in (
            ((picture.rotation, picture.translation), "#31a354", 11, "all LEDs, true pose"),
            ((solution.rotation, solution.translation), "#cb181d", 16, "all LEDs, answer"),
        ):
            seen = picture.camera.project(points @ pose[0].T + pose[1])
            panel.plot(*seen.T, "o", mfc="none", mec=colour, ms=size, label=name)
        middle, half = picture.pixels[own].mean(0), 0.9 * np.ptp(picture.pixels[own], axis=0).max() + 10
        panel.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half), aspect="equal")
        panel.set_title(
            f"{setting.name}: {own.sum()} LEDs seen, answer {error:.0f} deg off,\n{solution.verdict}, "
            f"log10 of false alarms {solution.log10_false_alarms:.1f}",
            fontsize=9,
        )
        shown += 1
        if shown == count:
            break
    panels[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Bars of what was right and of what was confident; the time of the median and of the slowest hundredth."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 0.3 * len(rows) + 1.2), sharey=True, layout="constrained")
    places = np.arange(len(rows))[::-1]
    left.barh(places, [row["right"] for row in rows], color="#9ecae1", label="right")
    left.barh(places, [row["confident"] for row in rows], height=0.35, color="#2171b5", label="confident")
    for place, row in zip(places, rows, strict=True):
        if row["wrong"]:
            left.text(101, place, f"{row['wrong']} wrong", va="center", color="#cb181d", fontsize=8)
    left.set(xlabel="% of the frames", yticks=places, yticklabels=[row["name"] for row in rows], xlim=(0, 118))
    left.legend(fontsize=8, loc="lower left")
    for name, colour in (("p50", "#2171b5"), ("p99", "#cb181d")):
        right.plot([row[name] for row in rows], places, "o", color=colour, label=name)
    right.set(xscale="log", xlabel="processor time, ms")
    right.grid(axis="x", alpha=0.3)
    right.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
