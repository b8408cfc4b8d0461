"""Rigs: several cameras fixed to each other around a headset, against one of them alone.

    python -m benchmarks rigs --limit 60 --seed 54

Each camera sees 4 to 6 of the LEDs, without normals, and a light that is not the headset's. one camera: the first of a
rig alone. scale unknown: of 0.2 to 5, which is found. Right is a rotation within 3 degrees.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from bench_constellation import Camera, device
from record import TIME_LIMIT, Array, Problem, measured, parser
from scipy.spatial.transform import Rotation

import bpnp

RIGHT_DEG = 3.0
LEAST, MOST, NOISE_PX, AROUND = 4, 6, 0.2, 0.5  # LEDs of a camera, noise, metres from the device to a camera
PINHOLE = Camera()


def pose_matrix(rotation: Array, translation: Array) -> Array:
    return np.block([[rotation, np.reshape(translation, (3, 1))], [np.zeros((1, 3)), 1.0]])


def problems(cameras: int, used: int, limit: int, seed: int, is_metric: bool = True) -> Iterator[Problem]:
    """A new device every fifth frame; so many cameras in random places that look at it, of which the first are used.

    The pose is rig_from_world, that of the first camera.
    """
    rng, number = np.random.default_rng([seed, cameras]), 0
    while number < limit:
        shown = device("headset", 1000 * seed + number // 5)
        poses, pixels = [], []
        for _ in range(cameras):
            turn = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
            poses.append(pose_matrix(turn, AROUND * np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.7, 1.3)])))
            camera = shown.points3d @ turn.T + poses[-1][:3, 3]
            sight = -camera / np.linalg.norm(camera, axis=-1, keepdims=True)
            facing = np.flatnonzero((sight * (shown.normals3d @ turn.T)).sum(-1) > np.cos(np.radians(75)))
            picked = rng.permutation(facing)[: rng.integers(LEAST, MOST + 1)]
            image = PINHOLE.project(camera[picked]) + NOISE_PX * rng.standard_normal((len(picked), 2))
            image = image[np.isfinite(image).all(-1)]
            pixels.append(rng.permutation(np.concatenate([image, rng.uniform(0, PINHOLE.size, (1, 2))])))
        if min(map(len, pixels)) <= LEAST:
            continue
        known: dict[str, Any] = {"seed": seed, "time_limit": TIME_LIMIT}
        scale = np.nan if is_metric else 0.2 * 25 ** rng.random()
        if used > 1:
            known["rig"] = [one @ np.linalg.inv(poses[0]) for one in poses[:used]]
            points3d = shown.points3d if is_metric else shown.points3d / scale
            models = [PINHOLE.model] * used
            search = partial(bpnp.solve, pixels[:used], points3d, models, scale=not is_metric, **known)
        else:
            search = partial(bpnp.solve, pixels[0], shown.points3d, PINHOLE.model, **known)
        yield Problem(f"{number}", search, [(poses[0][:3, :3], poses[0][:3, 3])], shown.points3d, scale=scale)
        number += 1


def main() -> None:
    chosen = parser(__doc__).parse_args()
    bpnp.warm_up()
    rows = [
        (f"LEDs, {name}", partial(problems, cameras, used, chosen.limit, chosen.seed, is_metric))
        for name, cameras, used, is_metric in (
            ("2 cameras", 2, 2, True),
            ("4 cameras", 4, 4, True),
            ("one camera", 2, 1, True),
            ("2 cameras, scale unknown", 2, 2, False),
            ("4 cameras, scale unknown", 4, 4, False),
        )
    ]
    measured(rows, chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
