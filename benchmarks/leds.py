"""Few points: LEDs of rings, headsets, drones and markers among other lights.

A device is drawn from a kind and a seed: LEDs with outward normals in random positions on a ring, on the shell of a
headset, on the frame of a drone, or on the arms of a marker; metres and pixels. Every frame has a new pose, every fifth
frame a new device.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from record import Problem
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.arrays import Array
from bpnp.cameras import camera_from

Kind = Literal["ring", "headset", "drone", "marker"]
MOST_POSES = 2000  # that are drawn for one picture
FACING_DEG = 78.0  # largest angle between a normal and the line of sight to a LED that is seen
DISTANCE, OFF_AXIS = (0.25, 0.8), 0.5  # metres; of the device from the optical axis, share of half the picture
SIZES = {"ring": 17, "headset": 34, "drone": 8, "marker": 5}


@dataclass(frozen=True)
class Device:
    """LEDs (n, 3), metres, and their outward unit normals (n, 3)."""

    points3d: Array
    normals3d: Array


@dataclass(frozen=True)
class Camera:
    """Pinhole camera or equidistant fisheye: image radius f tan(theta) or f theta, square image."""

    focal: float = 480.0
    size: int = 800
    fisheye: bool = False

    def project(self, camera: Array) -> Array:
        """Project points (n, 3) in the camera frame to pixels (n, 2); NaN for points that are not visible."""
        radius, depth = np.linalg.norm(camera[:, :2], axis=-1), camera[:, 2]
        if self.fisheye:
            scale = self.focal * np.arctan2(radius, depth) / np.maximum(radius, 1e-12)
        else:
            scale = self.focal / np.where(depth > 0, depth, np.nan)
        pixels = camera[:, :2] * scale[:, None] + self.size / 2
        inside = ((pixels >= 0) & (pixels < self.size)).all(-1, keepdims=True)
        return np.where(inside, pixels, np.nan)

    @property
    def model(self) -> tuple[str, list[float]]:
        """Camera in a form that `bpnp.solve` accepts."""
        pinhole = [self.focal, self.focal, self.size / 2, self.size / 2]
        return ("OPENCV_FISHEYE", [*pinhole, 0.0, 0.0, 0.0, 0.0]) if self.fisheye else ("PINHOLE", pinhole)


class Setting(NamedTuple):
    """Row: kind of device, number of other lights, fraction of undetected LEDs, pixels of noise, and range of the
    number of visible LEDs.
    """

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


@dataclass(frozen=True)
class Frame:
    """Frame: pixels (m, 2) in random order, the device, the pose camera = R p + t, and the LED of each pixel (-1 for
    none).
    """

    pixels: Array
    camera: Camera
    device: Device
    rotation: Array
    translation: Array
    led: NDArray[np.int64]


def device(kind: Kind, seed: int) -> Device:
    """Draw the layout of a device of a kind."""
    rng = np.random.default_rng([seed, list(SIZES).index(kind)])
    count = SIZES[kind]
    if kind == "ring":
        angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
        tilt = np.radians(rng.uniform(-35, 35, count))
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], -1)
        up = np.array([0.0, 0.0, 1.0])
        points = 0.045 * outward + rng.uniform(-0.012, 0.012, count)[:, None] * up
        normals = np.cos(tilt)[:, None] * outward + np.sin(tilt)[:, None] * up
    elif kind == "headset":
        normals = _spread_directions(count, rng)
        points = normals / np.linalg.norm(normals / np.array([0.09, 0.05, 0.06]), axis=-1, keepdims=True)
        points += rng.normal(0, 0.002, points.shape)
    elif kind == "drone":
        arm = np.arange(count) % 4
        angle = np.pi / 4 + np.pi / 2 * arm + rng.uniform(-0.25, 0.25, count)
        radius = rng.uniform(0.06, 0.18, count)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.03, 0.03, count)], -1)
        normals = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), rng.uniform(-1, 1, count)], -1)
    else:
        points = rng.uniform(-0.06, 0.06, (count, 3)) * np.array([1, 1, 0.6])
        normals = np.tile([0.0, 0.0, 1.0], (count, 1)) + rng.normal(0, 0.25, (count, 3))
    return Device(points, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def frame(device: Device, setting: Setting, rng: np.random.Generator) -> Frame | None:
    """Draw a frame of a device in a random pose, with half of the other lights around it; None if the number of LEDs
    that the setting needs is never visible.
    """
    camera, background, most = setting.camera, setting.background, setting.most
    pointing = camera_from(camera.model)
    for _ in range(MOST_POSES):
        rotation = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        towards = np.r_[pointing.normalise(camera.size / 2 * (1 + OFF_AXIS * rng.uniform(-1, 1, (1, 2))))[0], 1]
        towards /= np.linalg.norm(towards)
        translation = rng.uniform(*DISTANCE) * towards
        led, pixels = seen(device, setting, rotation, translation, rng)
        if len(led) < setting.least:
            continue
        if most is not None and len(led) > most:
            chosen = rng.choice(len(led), most, replace=False)
            led, pixels = led[chosen], pixels[chosen]
        lights = camera.size * rng.random((background, 2))
        near = rng.random(background) < 0.5
        spread = 1.5 * np.ptp(pixels, axis=0).max()
        lights[near] = (pixels.mean(0) + spread * rng.uniform(-1, 1, (background, 2)))[near]
        lights = np.clip(lights, 0, camera.size - 1)
        order = rng.permutation(len(led) + background)
        every, which = np.concatenate([pixels, lights]), np.concatenate([led, np.full(background, -1)])
        return Frame(every[order], camera, device, rotation, translation, which[order])
    return None


def seen(
    device: Device, setting: Setting, rotation: Array, translation: Array, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Return the detected LEDs and their noisy pixels."""
    points = device.points3d @ rotation.T + translation
    sight = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    facing = (sight * (device.normals3d @ rotation.T)).sum(-1) > np.cos(np.radians(FACING_DEG))
    pixels = setting.camera.project(points)
    detected = facing & np.isfinite(pixels).all(-1) & (rng.random(len(points)) >= setting.missing)
    led = np.flatnonzero(detected)
    return led, pixels[led] + setting.noise * rng.standard_normal((len(led), 2))


def _spread_directions(count: int, rng: np.random.Generator) -> Array:
    """Draw directions in the front three quarters of the sphere, no two of them very close."""
    chosen: list[Array] = []
    while len(chosen) < count:
        trial = rng.standard_normal((64, 3))
        trial /= np.linalg.norm(trial, axis=-1, keepdims=True)
        trial = trial[trial[:, 2] > -0.5]
        if chosen:
            trial = trial[np.argsort((trial @ np.array(chosen).T).max(-1))]
        chosen.append(trial[0])
    return np.array(chosen)


FISHEYE = Camera(focal=330.0, size=900, fisheye=True)
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


def problems(name: str, limit: int, seed: int, time_limit: float | None = None) -> Iterator[Problem]:
    """Yield frames of one of SETTINGS, with the camera given; `time_limit` as for `solve`."""
    setting = SETTINGS[name]
    number = list(SETTINGS).index(name)
    return frames(setting, number, limit, seed, camera=setting.camera.model, time_limit=time_limit)


def frames(setting: Setting, number: int, limit: int, seed: int, /, **options: Any) -> Iterator[Problem]:
    """Yield frames of a setting, whose number is part of the seed; every fifth frame has a new device."""
    rng = np.random.default_rng([seed, number])
    for i in range(limit):
        shown = picture(setting, 1000 * seed + i // 5, rng)
        normals = shown.device.normals3d if setting.normals else None
        prior = vertical(shown, rng) if setting.gravity else None
        yield problem(f"{setting.name}/{i}", shown, normals3d=normals, prior=prior, **options)


def problem(name: str, shown: Frame, **options: Any) -> Problem:
    """Return the problem of a frame with options of `solve`; without a camera the focal length is to be estimated."""
    focal = np.nan if "camera" in options else shown.camera.focal
    search = partial(bpnp.solve, shown.pixels, shown.device.points3d, **options)
    distance = float(np.linalg.norm(shown.translation))
    return Problem(name, search, [(shown.rotation, shown.translation)], shown.device.points3d, distance, focal)


def picture(setting: Setting, seed: int, rng: np.random.Generator) -> Frame:
    """Return a frame of the device with this seed, or of the next device with enough visible LEDs."""
    for number in range(100):
        if (shown := frame(device(setting.kind, seed + 10**6 * number), setting, rng)) is not None:
            return shown
    raise ValueError(f"none of 100 drawn devices of {setting.name} shows enough LEDs")


def vertical(shown: Frame, rng: np.random.Generator) -> bpnp.GravityPrior:
    """Return the device's z axis as the up direction, accurate to a degree."""
    tilt = Rotation.from_rotvec(np.radians(1.0) * rng.standard_normal(3)).as_matrix()
    return bpnp.GravityPrior(tilt @ shown.rotation[:, 2], np.array([0.0, 0.0, 1.0]), 1.5)
