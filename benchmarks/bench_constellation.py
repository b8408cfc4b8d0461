"""Few points: LEDs of rings, headsets, drones and markers among other lights; success, verdicts and CPU seconds.

    python -m benchmarks constellation --limit 200 --only "ring, 3 lights" drone

Every frame has a new pose, every fifth a new device. Right is a rotation within 3 degrees.
"""

import contextlib
from functools import partial
from typing import NamedTuple

import numpy as np
from constellations import Camera, Frame, Kind, device, frame
from record import Outcome, measured, parser, solved
from scipy.spatial.transform import Rotation

import bpnp

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


def outcomes(name: str, limit: int, seed: int) -> list[Outcome]:
    """Frames of a setting; every fifth has a new device."""
    setting = SETTINGS[name]
    rng = np.random.default_rng([seed, list(SETTINGS).index(name)])
    frames = [picture(setting, 1000 * seed + i // 5, rng) for i in range(limit)]
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


def main() -> None:
    chosen = parser(__doc__).parse_args()
    bpnp.warm_up()
    rows = ((name, partial(outcomes, name, chosen.limit, chosen.seed)) for name in SETTINGS)
    measured(rows, chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
