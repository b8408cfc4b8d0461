"""Craters seen from an orbit: centres only, a catalogue of a larger region, and an attitude known to a degree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import PosePrior

Array = NDArray[np.float64]
RADIUS = 1737.0  # km, of the body
FOCAL, SIZE = 1000.0, 1024  # pixels


@dataclass(frozen=True)
class CraterView:
    """Pixels (m, 2) in random order, catalogue (n, 3) in km around its middle, the pose and a prior on its rotation."""

    pixels: Array
    points3d: Array
    rotation: Array
    translation: Array
    prior: PosePrior

    @property
    def camera(self) -> tuple[str, list[float]]:
        """As `bpnp.solve` takes it."""
        return "PINHOLE", [FOCAL, FOCAL, SIZE / 2, SIZE / 2]


def crater_view(
    rng: np.random.Generator,
    *,
    catalogue: tuple[int, int] = (150, 1200),
    seen: tuple[int, int] = (20, 160),
    missing: float = 0.5,
    false: float = 0.38,
    noise: float = 0.7,
    attitude_deg: float = 1.0,
) -> CraterView:
    """A view of a synthetic catalogue: centres spread at random over a region that the picture shows a part of.

    catalogue, seen: least and most centres in the region and detections in the picture. missing, false: the largest
    share of the centres in the picture that are not detected, and of the detections that are no centres; both are drawn
    evenly from 0. noise: pixels. attitude_deg: standard deviation of the prior's rotation, about each axis.
    """
    while True:
        altitude = rng.uniform(60, 250)
        off_nadir, heading = np.radians(rng.uniform(0, 25)), rng.uniform(0, 2 * np.pi)
        rotation = _looking_down(off_nadir, heading)
        count = int(np.exp(rng.uniform(*np.log(catalogue))))
        wide = rng.uniform(1.0, 2.5) * altitude * SIZE / FOCAL  # side of the region
        ground = altitude * np.tan(off_nadir)
        flat = rng.uniform(-wide / 2, wide / 2, (count, 2))
        points = np.column_stack([flat, np.sqrt(RADIUS**2 - (flat**2).sum(-1)) - RADIUS + rng.normal(0, 0.5, count)])
        direction = rotation[2]
        centre = np.array([0.0, 0, altitude]) - ground * np.array([direction[0], direction[1], 0]) / max(
            float(np.hypot(direction[0], direction[1])), 1e-9
        )
        centre[:2] += rng.uniform(-0.2, 0.2, 2) * wide
        translation = -rotation @ centre
        camera = points @ rotation.T + translation
        pixels = FOCAL * camera[:, :2] / camera[:, 2:] + SIZE / 2
        inside = ((pixels > 0) & (pixels < SIZE)).all(-1) & (camera[:, 2] > 0)
        found = np.flatnonzero(inside & (rng.random(count) >= rng.uniform(0, missing)))
        strays = int(len(found) * (share := rng.uniform(0, false)) / (1 - share))
        if len(found) < 0.6 * seen[0] or not seen[0] <= len(found) + strays <= seen[1]:
            continue
        image = np.concatenate(
            [pixels[found] + noise * rng.standard_normal((len(found), 2)), SIZE * rng.random((strays, 2))]
        )
        tilt = Rotation.from_rotvec(np.radians(attitude_deg) * rng.standard_normal(3)).as_matrix()
        return CraterView(
            rng.permutation(image), points, rotation, translation, PosePrior(tilt @ rotation, None, attitude_deg)
        )


def _looking_down(off_nadir: float, heading: float) -> Array:
    """World to camera: z towards the ground, tilted by `off_nadir` and turned by `heading`."""
    down = np.diag([1.0, -1.0, -1.0])
    return np.asarray(
        Rotation.from_rotvec([off_nadir, 0, 0]).as_matrix() @ down @ Rotation.from_rotvec([0, 0, heading]).as_matrix()
    )
