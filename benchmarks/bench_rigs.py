"""Rigs against one of their cameras alone: LEDs of a headset, and photos of COLMAP models.

    python -m benchmarks rigs --limit 60 --seed 54 --only LEDs
    python -m benchmarks rigs --limit 8 --only photos

LEDs: each camera sees 4 to 6 LEDs, without normals, and one other light. The row "one camera" has the first camera of a
rig alone. photos: three overlapping photos as one rig, and each of them alone, against the points of one view, with all
keypoints and points, also those without a correspondence; --limit per scene. scale unknown: the scale of the scene is
0.2 to 5 and is estimated. Success: rotation within 3 degrees.
"""

import argparse
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from leds import Camera, device
from record import Problem, Row, parser, run
from scipy.spatial.transform import Rotation
from view_problems import LEAST_MATCHES, MOST_POINTS, REPORTED, images_of, model_of, overlapping, view_problem

import bpnp
from bpnp.arrays import Array

RIGHT_DEG = 3.0
LEAST, MOST, NOISE_PX, AROUND = 4, 6, 0.2, 0.5  # LEDs of a camera, noise, metres from the device to a camera
PINHOLE = Camera()


def pose_matrix(rotation: Array, translation: Array) -> Array:
    return np.block([[rotation, np.reshape(translation, (3, 1))], [np.zeros((1, 3)), 1.0]])


def problems(cameras: int, used: int, scale: bool, options: argparse.Namespace) -> Iterator[Problem]:
    """Yield problems with cameras at random positions that look at a device; the search uses only the first ones.

    Every fifth frame has a new device. The pose is rig_from_world, that of the first camera.
    """
    rng, number = np.random.default_rng([options.seed, cameras]), 0
    while number < options.limit:
        shown = device("headset", 1000 * options.seed + number // 5)
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
        points3d = shown.points3d / (0.2 * 25 ** rng.random()) if scale else shown.points3d
        search = rig_search(pixels[:used], points3d, [PINHOLE.model] * used, poses, options, scale=scale)
        yield Problem(f"{number}", search, [(poses[0][:3, :3], poses[0][:3, 3])], shown.points3d)
        number += 1


def of_photos(used: slice, options: argparse.Namespace) -> Iterator[Problem]:
    """Yield a photo and the two that overlap with it most, or some of the three, against the points of a fourth."""
    for name in options.scenes:
        scene = model_of(options.data, name)
        for query in images_of(scene, options.limit):
            shown = view_problem(scene, query, against="view", outliers=1.0, seed=options.seed)
            local = [view for _, view in overlapping(scene, query) if f"{name}/{view.name}" != shown.view][:2]
            if len(local) < 2 or shown.matched.sum() < LEAST_MATCHES:
                continue
            rng, pixels = np.random.default_rng([options.seed, query.image_id]), [shown.pixels[0]]
            for view in local:
                keypoints = rng.permutation(np.concatenate([view.points2d, view.clutter2d]))[:MOST_POINTS]
                pixels.append(view.camera.focal * keypoints.astype(np.float64))
            rig = [query, *local][used]
            poses = [pose_matrix(each.rotation, each.translation) for each in rig]
            matrices = [np.diag([each.camera.focal] * 2 + [1.0]) for each in rig]
            search = rig_search(pixels[used], shown.points3d, matrices, poses, options)
            pose = rig[0].rotation, rig[0].translation
            yield Problem(shown.name, search, [pose], shown.points3d, shown.distance)


def rig_search(
    pixels: Sequence[Array],
    points3d: Array,
    cameras: Sequence[Any],
    poses: Sequence[Array],
    options: argparse.Namespace,
    **arguments: Any,
) -> partial[bpnp.Solution]:
    """Return the search for cameras with the poses camera_from_world, in the frame of the first."""
    arguments |= {"seed": options.seed, "time_limit": options.time_limit}
    if len(pixels) == 1:
        return partial(bpnp.solve, pixels[0], points3d, cameras[0], **arguments)
    rig = [one @ np.linalg.inv(poses[0]) for one in poses[: len(pixels)]]
    return partial(bpnp.solve, list(pixels), points3d, list(cameras), rig=rig, **arguments)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    for name, cameras, used, scale in (
        ("2 cameras", 2, 2, False), ("4 cameras", 4, 4, False), ("one camera", 2, 1, False),
        ("2 cameras, scale unknown", 2, 2, True), ("4 cameras, scale unknown", 4, 4, True),
    ):  # fmt: skip
        yield Row(f"LEDs, {name}", partial(problems, cameras, used, scale, options), RIGHT_DEG)
    for name, photos in (("camera 1", (0, 1)), ("camera 2", (1, 2)), ("camera 3", (2, 3)), ("3 cameras", (0, 3))):
        yield Row(f"photos, {name}", partial(of_photos, slice(*photos), options), RIGHT_DEG)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--scenes", nargs="+", default=REPORTED, help="COLMAP models of the photos")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
