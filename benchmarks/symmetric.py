"""Objects of k equal parts and some unique points: the true pose explains more points than its images under the
symmetry.

Kinds: cloud (random points), tower (parts around an upright axis), wheel (points of a rim and of spokes), few (a cloud
of few points), and device (LEDs with normals, nearly symmetric under a half turn). Objects have 0 to 12 unique points;
with 0 they are exactly symmetric, and no pose can be distinguished from its rotated copies.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from record import Problem
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.arrays import Array

NOISE = 1e-3  # of normalised image coordinates
JITTER = 0.004  # of a near symmetry, in extents of the device


class Kind(NamedTuple):
    """Points per part, unique points, and random image points as a fraction of all."""

    name: str
    fold: int
    each: int
    unique: int
    outliers: float = 0.0

    @property
    def label(self) -> str:
        return f"{self.name}, {self.fold} parts of {self.each}, {self.unique} unique, {self.outliers:.0%} outliers"


KINDS = (
    *(Kind("cloud", fold, 90 // fold, unique) for fold in (2, 3, 5) for unique in (0, 4, 8, 12)),
    *(Kind("cloud", fold, 180 // fold, unique, 0.2) for fold in (3, 6) for unique in (0, 8, 12)),
    *(Kind("tower", fold, 90 // fold, unique, 0.2) for fold in (2, 3, 4) for unique in (0, 8, 12)),
    *(Kind("wheel", fold, 120 // fold, unique) for fold in (4, 6) for unique in (0, 8, 12)),
    *(Kind("few", fold, each, unique) for fold, each in ((2, 10), (3, 7), (5, 6)) for unique in (0, 3, 8)),
)


def points_of(kind: Kind, rng: np.random.Generator) -> Array:
    """Return the points (n, 3) of an object, the unique ones last."""
    part = rng.uniform(-1, 1, (kind.each, 3))
    unique = rng.uniform(-1, 1, (kind.unique, 3))
    if kind.name == "tower":
        part = part * (0.2, 0.3, 1) + (0.3, 0, 0)
        unique *= (0.5, 0.5, 1)
    elif kind.name == "wheel":
        rim = rng.random(kind.each) < 0.5
        angle = np.where(rim, rng.uniform(-np.pi, np.pi, kind.each) / kind.fold, 0.05 * part[:, 1])
        radius = np.where(rim, 1 + 0.03 * part[:, 0], rng.uniform(0.1, 1, kind.each))
        part = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 * part[:, 2]], -1)
        unique *= (0.8, 0.8, 0.2)
    rotations = Rotation.from_rotvec([[0, 0, 2 * np.pi * k / kind.fold] for k in range(kind.fold)])
    return np.concatenate([*(part @ turn.T for turn in rotations.as_matrix()), unique])


def problems(kind: Kind, limit: int, seed: int, time_limit: float | None = None) -> Iterator[Problem]:
    """Yield problems of a kind: any rotation, four to six units away, with noise of a pixel at a focal length of 1000.

    With outliers a fifth of the object's points are hidden too. `time_limit` as for `solve`, here and below.
    """
    for k in range(limit):
        rng = np.random.default_rng([seed, KINDS.index(kind), k])
        points = points_of(kind, rng)
        points = points @ Rotation.random(random_state=rng).as_matrix().T
        rotation = Rotation.random(random_state=rng).as_matrix()
        translation = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(4, 6)])
        camera = points @ rotation.T + translation
        image = camera[:, :2] / camera[:, 2:] + NOISE * rng.normal(size=(len(points), 2))
        if kind.outliers:
            shown = image[rng.permutation(len(image))[: int(0.8 * len(image))]]
            count = round(len(shown) * kind.outliers / (1 - kind.outliers))
            image = np.concatenate([shown, rng.uniform(shown.min(0), shown.max(0), (count, 2))])
        options: dict[str, Any] = {"seed": k, "time_limit": time_limit}
        search = partial(bpnp.solve, rng.permutation(image), rng.permutation(points), **options)
        # An exactly symmetric object has no correct pose: the rotated copies of a pose fit as well.
        yield Problem(f"{kind.label} #{k}", search, [(rotation, translation)] if kind.unique else [], points)


def near_symmetric_device(rng: np.random.Generator, pairs: int = 14, unique: int = 4) -> tuple[Array, Array]:
    """Return LEDs (n, 3), metres, and normals (n, 3) of a shell that a half turn maps onto itself, except for jitter
    and some unique LEDs.
    """
    outward = rng.normal(size=(pairs + unique, 3)) * (1, 1, 0.4)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = outward / np.linalg.norm(outward / (0.09, 0.05, 0.04), axis=1, keepdims=True)
    half = np.array([-1.0, -1.0, 1.0])
    points = np.concatenate([points, points[:pairs] * half])
    normals = np.concatenate([outward, outward[:pairs] * half])
    return points + JITTER * 0.09 * rng.normal(size=points.shape), normals


def device_problems(
    limit: int, seed: int, time_limit: float | None = None, *, normals: bool = True, frames: int = 20
) -> Iterator[Problem]:
    """Yield pictures of near-symmetric devices, `frames` of each.

    They show LEDs that face the camera, with noise of 0.3 pixels at a focal length of 500, and none to three other
    lights.
    """
    camera = np.array([[500.0, 0, 400], [0, 500, 400], [0, 0, 1]])
    for k in range(limit):
        points, outward = near_symmetric_device(np.random.default_rng([seed, 1, k // frames]))
        rng = np.random.default_rng([seed, 2, k])
        seen = np.empty((0, 2))
        while len(seen) < 8:
            rotation = Rotation.random(random_state=rng).as_matrix()
            translation = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.25, 0.7)])
            at = points @ rotation.T + translation
            facing = -((outward @ rotation.T) * at).sum(1) > 0.25 * np.linalg.norm(at, axis=1)
            seen = (at[:, :2] / at[:, 2:] * 500 + 400)[facing]
        others = rng.uniform(seen.min(0) - 30, seen.max(0) + 30, (rng.integers(0, 4), 2))
        pixels = rng.permutation(np.concatenate([seen + 0.3 * rng.normal(size=seen.shape), others]))
        options: dict[str, Any] = {"normals3d": outward if normals else None, "seed": k, "time_limit": time_limit}
        search = partial(bpnp.solve, pixels, points, camera, **options)
        name = f"device {k // frames}, {'' if normals else 'no '}normals #{k}"
        yield Problem(name, search, [(rotation, translation)], points)


def pitch_problems(tilt_deg: float, limit: int, seed: int, time_limit: float | None = None) -> Iterator[Problem]:
    """Yield pictures of a part of a playing field from the stands: crossings of its lines with a pixel of noise.

    The direction of gravity is known to 2 degrees. The camera is rolled by up to 3 degrees and tilted down by 15
    degrees and up to `tilt_deg` more. A half turn maps the field onto itself, so two poses are correct.
    """
    camera = np.array([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]])
    half = [(0, 0), (0, 68), (16.5, 13.84), (16.5, 54.16), (5.5, 24.84), (5.5, 43.16), (0, 13.84), (0, 54.16)]
    halfway = [(52.5, 0), (52.5, 68), (52.5, 24.85), (52.5, 43.15), (0, 24.84), (0, 43.16), (11, 34)]
    field = np.array([*half, *halfway])
    field = np.concatenate([field, field[field[:, 0] < 52] * (-1, 1) + (105, 0)])
    points = np.column_stack([field - (52.5, 34), np.zeros(len(field))])
    for k in range(limit):
        rng = np.random.default_rng([seed, 3, k])
        seen = np.empty((0, 2))
        while len(seen) < 9:
            down = np.radians(15 + rng.uniform(0, tilt_deg))
            at = np.array([rng.uniform(-40, 40), -60.0, rng.uniform(12, 30)])
            aim = Rotation.from_euler("x", np.pi / 2 + down) * Rotation.from_euler("z", rng.uniform(-0.4, 0.4))
            rotation = (Rotation.from_euler("z", np.radians(rng.uniform(-3, 3))) * aim).as_matrix()
            translation = -rotation @ at
            there = points @ rotation.T + translation
            pixels = there[:, :2] / there[:, 2:] * 1000 + (640, 360)
            inside = (there[:, 2] > 0) & (pixels > 0).all(1) & (pixels < (1280, 720)).all(1)
            seen = pixels[inside]
        up = Rotation.from_rotvec(np.radians(1.0) * rng.normal(size=3)).as_matrix() @ rotation[:, 2]
        prior = bpnp.GravityPrior(up, np.array([0.0, 0.0, 1.0]), 2.0)
        options: dict[str, Any] = {"prior": prior, "seed": k, "time_limit": time_limit}
        search = partial(bpnp.solve, rng.permutation(seen + rng.normal(size=seen.shape)), points, camera, **options)
        half_turn = np.diag([-1.0, -1.0, 1.0])  # which maps the field onto itself
        poses = [(rotation, translation), (rotation @ half_turn, translation)]
        yield Problem(f"pitch, tilt {tilt_deg:g} #{k}", search, poses, points)
