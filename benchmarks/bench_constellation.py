"""Few points: LEDs of rings, headsets, drones and markers among other lights; success, verdicts and milliseconds.

    python -m benchmarks constellation --limit 200 --only "ring, 3 lights" noise

Every frame has a new pose, every fifth a new device. Right is a rotation within 3 degrees. --peers: the
baselines too, on --limit frames of some rows. noise: points without a pose, where every confident answer is wrong.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from constellations import Camera, Frame, Kind, device, frame, noise_frame
from record import Outcome, degrees, measured, parser, solved
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.models.baselines import Constellation, RandomRansac, SoftPOSIT
from bpnp.types import Batch

RIGHT_DEG = 3.0
FISHEYE = Camera(focal=330.0, size=900, fisheye=True)


class Setting(NamedTuple):
    """A row: a kind of device, lights that are not its own, share of its LEDs that are not detected, pixels of noise,
    least and most LEDs that are seen."""

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


SETTINGS = {
    setting.name: setting
    for kind in ("ring", "headset")
    for setting in (
        Setting(f"{kind}, all seen", kind),
        Setting(f"{kind}, 3 lights", kind, background=3),
        Setting(f"{kind}, 3 lights, fisheye", kind, background=3, camera=FISHEYE),
        Setting(f"{kind}, 3 lights, 1 px", kind, background=3, noise=1.0),
        Setting(f"{kind}, 8 lights, 20 % missing", kind, 8, 0.2),
        Setting(f"{kind}, 10 lights, 50 % missing", kind, 10, 0.5, least=5),
        Setting(f"{kind}, no normals, 3 lights", kind, background=3, normals=False),
        Setting(f"{kind}, 5 seen, gravity", kind, least=5, most=5, gravity=True),
    )
} | {
    "drone, 3 lights": Setting("drone, 3 lights", "drone", background=3, least=5, normals=False),
    "marker, all seen": Setting("marker, all seen", "marker", least=5, normals=False),
}
COMPARED = ("ring, all seen", "ring, 3 lights", "marker, all seen")
NOISE = [(6, 6), (8, 8), (10, 17), (20, 20), (30, 30), (50, 50), (10, 50), (20, 100), (100, 20)]


def outcomes(name: str, limit: int, seed: int, solver: Any = None) -> list[Outcome]:
    """Frames of a setting; every fifth has a new device."""
    setting = SETTINGS[name]
    rng = np.random.default_rng([seed, list(SETTINGS).index(name)])
    frames = [picture(setting, 1000 * seed + i // 5, rng) for i in range(limit)]
    if solver is not None:
        return [by_baseline(shown, solver) for shown in frames]
    return [
        solved(f"{name} {i}", shown.rotation, shown.translation, partial(search, shown, setting, rng))
        for i, shown in enumerate(frames)
    ]


def picture(setting: Setting, seed: int, rng: np.random.Generator) -> Frame:
    """A frame of the device with this seed, or of the next one whose LEDs can be seen."""
    for number in range(100):
        with contextlib.suppress(ValueError):
            return frame(
                device(setting.kind, seed + 10**6 * number), rng, camera=setting.camera, noise=setting.noise,
                background=setting.background, missing=setting.missing, least=setting.least, most=setting.most,
            )  # fmt: skip
    raise ValueError(f"expected a device of {setting.name} whose LEDs can be seen, got none of 100")


def search(shown: Frame, setting: Setting, rng: np.random.Generator) -> bpnp.Solution:
    prior, normals = None, shown.device.normals3d if setting.normals else None
    if setting.gravity:
        up, up_device = shown.gravity
        tilt = Rotation.from_rotvec(np.radians(1.0) * rng.standard_normal(3)).as_matrix()
        prior = bpnp.GravityPrior(tilt @ up, up_device, 1.5)
    return bpnp.solve(shown.pixels, shown.device.points3d, shown.camera.model, normals3d=normals, prior=prior)


def by_baseline(shown: Frame, solver: Any) -> Outcome:
    """A baseline on the normalised image and a device of unit size; confident where it says that it has converged."""
    rays, size = shown.bearings, float(np.abs(shown.device.points3d).max())
    batch = Batch.from_arrays(
        [(rays[:, :2] / rays[:, 2:]).astype(np.float32)], [(shown.device.points3d / size).astype(np.float32)]
    )
    start = time.process_time()
    (pose,) = solver(batch).poses.values()
    seconds = time.process_time() - start
    error = degrees(pose.rotation[0].double().numpy(), shown.rotation)
    return Outcome("", error, 0.0, "confident" if bool(pose.stats.converged[0]) else "failed", seconds)


def noise(m: int, n: int, limit: int, seed: int) -> list[Outcome]:
    """Points that have no pose in common: every confident answer is wrong."""
    rng, nowhere = np.random.default_rng([seed, m, n]), np.full((3, 3), np.nan)
    frames = [noise_frame(m, n, rng) for _ in range(limit)]
    return [
        solved(f"noise {i}", nowhere, np.zeros(3), partial(bpnp.solve, *points, Camera().model))
        for i, points in enumerate(frames)
    ]


def rows(limit: int, seed: int, *, peers: bool) -> Iterator[tuple[str, Callable[[], list[Outcome]]]]:
    """The name of every row and what measures it."""
    for name in SETTINGS:
        yield name, partial(outcomes, name, limit, seed)
    for m, n in NOISE:
        yield f"noise {m} x {n}", partial(noise, m, n, limit, seed)
    for name in COMPARED if peers else ():
        for solver in (Constellation(), SoftPOSIT(start="random"), RandomRansac(threshold=0.003, time_limit=5.0)):
            yield f"{type(solver).__name__}: {name}", partial(outcomes, name, limit, seed, solver)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--only", nargs="*", default=[""], help="parts of names: only rows with one of them")
    options.add_argument("--peers", action="store_true", help="the baselines too")
    chosen = options.parse_args()
    bpnp.warm_up()
    every = rows(chosen.limit, chosen.seed, peers=chosen.peers)
    picked = ((name, run()) for name, run in every if any(part in name for part in chosen.only))
    measured(picked, chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
