"""Rotation of a camera from stars: fields of 5 to 180 degrees, 30 % false stars, 20 % missing, 0.3 pixels of noise.

    python -m benchmarks stars --limit 50 --only "2000, 20 deg" --peers

Success: rotation within 0.2 degrees. Every tenth frame has a new catalogue, so that the median time excludes its index.
A field is drawn again until 8 stars or more are detected. Catalogues for fields of 5 degrees cover a belt of the sky,
with 15 stars in a field. --peers: also run tetra3rs, if it is installed.
"""

import argparse
import importlib.util
import struct
import tempfile
import time
from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from leds import Camera
from numpy.typing import NDArray
from record import Array, Outcome, Problem, Row, degrees, parser, run
from scipy.spatial.transform import Rotation

import bpnp

RIGHT_DEG = 0.2
SIZE = 2000  # pixels of a side
FALSE, MISSING, NOISE_PX, LEAST = 0.3, 0.2, 0.3, 8
CATALOGUES, FIELDS = (2000, 5000, 10_000), (5.0, 20.0, 60.0, 180.0)
WIDE = 100.0  # degrees from which the camera is a fisheye
NARROW, IN_VIEW = 5.0, 15.0  # degrees of a field up to which a catalogue is a belt of the sky; its stars in a field


class Frame(NamedTuple):
    pixels: Array  # (m, 2) of stars and others
    directions: Array  # (n, 3)
    rotation: Array
    star: NDArray[np.int64]  # (m,) which direction each pixel is, -1: none


def lens(field: float, factor: float = 1.0) -> Camera:
    """Return the camera of a field of view in degrees, with `factor` times its focal length."""
    half = np.radians(field / 2)
    return Camera(float(factor * SIZE / 2 / (half if field > WIDE else np.tan(half))), SIZE, field > WIDE)


def anywhere(rng: np.random.Generator, count: int, field: float) -> Array:
    """Draw pixels evenly over the image, which is round for a fisheye."""
    if field < WIDE:
        return rng.uniform(0, SIZE, (count, 2))
    radius, around = SIZE / 2 * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    return SIZE / 2 + radius[:, None] * np.stack([np.cos(around), np.sin(around)], -1)


@lru_cache(2)
def catalogue(count: int, field: float, seed: int) -> Array:
    """Draw directions (count, 3) evenly over the sphere or, for narrow fields, over a belt."""
    rng = np.random.default_rng([seed, count])
    area = count / (IN_VIEW / field**2) * np.radians(1) ** 2
    height = rng.uniform(-1, 1, count) * (min(1.0, area / (4 * np.pi)) if field <= NARROW else 1.0)
    around = rng.uniform(0, 2 * np.pi, count)
    aside = np.sqrt(1 - height**2)
    return np.stack([aside * np.cos(around), aside * np.sin(around), height], -1)


def frame(count: int, field: float, seed: int, i: int, false: float = FALSE) -> Frame:
    """Draw a field around a star, again until LEAST stars or more are detected."""
    rng = np.random.default_rng([seed, count, int(field), i])
    directions = catalogue(count, field, 1000 * seed + i // 10)
    while True:
        to_middle, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], directions[rng.integers(count)][None])
        rotation = (Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]) * to_middle).as_matrix()
        pixels = lens(field).project(directions @ rotation.T)
        shown = np.isfinite(pixels[:, 0]) & (np.linalg.norm(pixels - SIZE / 2, axis=-1) < SIZE / (2 - (field < WIDE)))
        star = np.flatnonzero(shown & (rng.random(count) > MISSING))
        if len(star) >= LEAST:
            break
    others = anywhere(rng, round(len(star) * false / (1 - false)), field)
    every = np.concatenate([pixels[star] + NOISE_PX * rng.standard_normal((len(star), 2)), others])
    order = rng.permutation(len(every))
    return Frame(every[order], directions, rotation, np.r_[star, np.full(len(others), -1)][order])


def problems(count: int, field: float, limit: int, seed: int, time_limit: float) -> Iterator[Problem]:
    for i in range(limit):
        shown = frame(count, field, seed, i)
        arguments: dict[str, Any] = {"at_infinity": True, "seed": i, "time_limit": time_limit}
        search = partial(bpnp.solve, shown.pixels, shown.directions, lens(field).model, **arguments)
        yield Problem(f"{i}", search, [(shown.rotation, np.zeros(3))])


@lru_cache(2)
def tetra_database(count: int, field: float, seed: int) -> Any:
    """Write tetra3rs's index of a catalogue, in its own file format; all stars are equally bright."""
    tetra3rs: Any = importlib.import_module("tetra3rs")
    x, y, z = catalogue(count, field, seed).T
    records = np.zeros(count, "<i8, <f8, <f8, <f4, <f4, <f4")  # number, right ascension, declination, magnitude, motion
    records["f0"], records["f3"] = np.arange(count), 5 + np.arange(count) / count
    records["f1"], records["f2"] = np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        file.write(b"GDR3" + struct.pack("<IQ", 1, count) + records.tobytes())
        file.flush()
        return tetra3rs.SolverDatabase.generate_from_gaia(
            catalog_path=file.name, max_fov_deg=1.4 * field, epoch_proper_motion_year=2016.0
        )


def by_tetra(count: int, field: float, limit: int, seed: int) -> Iterator[Outcome]:
    """Solve the same frames with tetra3rs; every result that it returns counts as confident."""
    for i in range(limit):
        shown = frame(count, field, seed, i)
        database = tetra_database(count, field, 1000 * seed + i // 10)
        start = time.process_time()
        found = database.solve_from_centroids(
            shown.pixels - SIZE / 2, fov_estimate_deg=field, image_width=SIZE, image_height=SIZE, match_radius=0.002
        )
        seconds = time.process_time() - start
        turned = np.asarray(found.rotation_matrix_icrs_to_camera) if found else np.full((3, 3), np.nan)
        yield Outcome("", degrees(turned, shown.rotation), 0.0, "confident" if found else "failed", seconds)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    for count, field in product(CATALOGUES, FIELDS):
        name, shown = f"{count}, {field:.0f} deg", (count, field, options.limit, options.seed)
        yield Row(name, partial(problems, *shown, options.time_limit), RIGHT_DEG)
        if options.peers and field < WIDE:
            yield Row(f"tetra3rs: {name}", partial(by_tetra, *shown), RIGHT_DEG)


def main() -> None:
    options = parser(__doc__, without=["data"])
    options.add_argument("--peers", action="store_true", help="also run tetra3rs")
    chosen = options.parse_args()
    if chosen.peers and importlib.util.find_spec("tetra3rs") is None:
        options.error("--peers needs tetra3rs, which is not installed: pip install tetra3rs")
    run(rows(chosen), chosen)
