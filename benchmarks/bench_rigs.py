"""Rigs: several cameras fixed to each other, against each of them alone; LEDs of a device, and photos of COLMAP models.

    python -m benchmarks rigs --limit 100 --seed 42
    python -m benchmarks rigs --limit 10 --only photos --scenes fountain-P11 tabletop

LEDs: cameras around a headset, each of which sees 4 to 6 of its LEDs and a light that is not its own, without normals;
photos: one, and three that overlap as one rig, against the points of one view with all keypoints and points that have
no partner. one camera: the first of the rig alone. Right is a rotation within 3 degrees.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from constellations import Camera, device
from record import TIME_LIMIT, Array, Outcome, Rows, measured, parser, solved
from reliability import REPORTED
from scipy.spatial.transform import Rotation
from view_problems import LEAST_MATCHES, MOST_POINTS, overlapping, photos, view_problem

import bpnp
from bpnp.datamodules.colmap.reconstruction import ImagePoints, read_reconstruction

RIGHT_DEG = 3.0
LEAST, MOST, NOISE_PX, AROUND = 4, 6, 0.2, 0.5  # LEDs of a camera, noise, metres from the device to a camera
PINHOLE = Camera()


class Problem(NamedTuple):
    """Pixels, cameras and cam_from_rig of each camera, the scene, and the pose rig_from_world, that of camera 0."""

    name: str
    pixels: list[Array]
    cameras: list[object]
    rig: list[Array]
    points3d: Array
    rotation: Array
    translation: Array

    def solve(self, cameras: int, seed: int) -> bpnp.Solution:
        if cameras == 1:
            return bpnp.solve(self.pixels[0], self.points3d, self.cameras[0], seed=seed, time_limit=TIME_LIMIT)
        chosen = self.pixels[:cameras], self.points3d, self.cameras[:cameras]
        return bpnp.solve(*chosen, rig=self.rig[:cameras], seed=seed, time_limit=TIME_LIMIT)


def pose(rotation: Array, translation: Array) -> Array:
    return np.block([[rotation, np.reshape(translation, (3, 1))], [np.zeros((1, 3)), 1.0]])


def leds(cameras: int, limit: int, seed: int) -> Iterator[Problem]:
    """A new device every fifth frame; cameras in random places that look at it."""
    rng, number = np.random.default_rng([seed, cameras]), 0
    while number < limit:
        shown = device("headset", 1000 * seed + number // 5)
        poses, pixels = [], []
        for _ in range(cameras):
            turn = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
            poses.append(pose(turn, AROUND * np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.7, 1.3)])))
            camera = shown.points3d @ turn.T + poses[-1][:3, 3]
            sight = -camera / np.linalg.norm(camera, axis=-1, keepdims=True)
            facing = np.flatnonzero((sight * (shown.normals3d @ turn.T)).sum(-1) > np.cos(np.radians(75)))
            picked = rng.permutation(facing)[: rng.integers(LEAST, MOST + 1)]
            image = PINHOLE.project(camera[picked]) + NOISE_PX * rng.standard_normal((len(picked), 2))
            image = image[np.isfinite(image).all(-1)]
            pixels.append(rng.permutation(np.concatenate([image, rng.uniform(0, PINHOLE.size, (1, 2))])))
        if min(map(len, pixels)) <= LEAST:
            continue
        mounts = [one @ np.linalg.inv(poses[0]) for one in poses]
        models: list[object] = [PINHOLE.model] * cameras
        yield Problem(f"{number}", pixels, models, mounts, shown.points3d, poses[0][:3, :3], poses[0][:3, 3])
        number += 1


def of_photos(data: Path, name: str, limit: int, seed: int) -> Iterator[Problem]:
    """A photo and the two others that overlap with it most, against the points of a fourth image."""
    scene = read_reconstruction(data / "colmap" / name / "sparse/0", name=name)
    for query in photos(scene, limit):
        shown = view_problem(scene, query, views=1, outliers=1.0, seed=seed)
        beside = [view for _, view in overlapping(scene, query) if view.name not in shown.views][:2]
        if len(beside) < 2 or shown.matches < LEAST_MATCHES:
            continue
        mine, rng = pose(query.rotation, query.translation), np.random.default_rng([seed, query.image_id])
        mounts = [pose(view.rotation, view.translation) @ np.linalg.inv(mine) for view in beside]
        pixels = [query.camera.focal * shown.points2d, *(keypoints(view, rng) for view in beside)]
        cameras: list[object] = [np.diag([each.camera.focal] * 2 + [1.0]) for each in (query, *beside)]
        known = shown.points3d, query.rotation, query.translation
        yield Problem(shown.name, pixels, cameras, [np.eye(4), *mounts], *known)


def keypoints(image: ImagePoints, rng: np.random.Generator) -> Array:
    """Of a photo, with and without a scene point, in pixels from the principal point."""
    every = np.concatenate([image.points2d, image.clutter2d])
    return np.asarray(image.camera.focal * rng.permutation(every)[:MOST_POINTS], np.float64)


def outcomes(problems: Sequence[Problem], cameras: int, seed: int) -> list[Outcome]:
    return [solved(each.name, each.rotation, each.translation, partial(each.solve, cameras, seed)) for each in problems]


def rows(data: Path, scenes: Sequence[str], limit: int, seed: int) -> Rows:
    for cameras in (2, 4):
        yield f"LEDs, {cameras} cameras", lambda n=cameras: outcomes(list(leds(n, limit, seed)), n, seed)  # type: ignore[misc]
    yield "LEDs, one camera", lambda: outcomes(list(leds(2, limit, seed)), 1, seed)
    for cameras, name in ((1, "one camera"), (3, "three cameras")):
        yield (
            f"photos, {name}",
            lambda n=cameras: [  # type: ignore[misc]
                one for scene in scenes for one in outcomes(list(of_photos(data, scene, limit, seed)), n, seed)
            ],
        )


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--scenes", nargs="*", default=REPORTED, help="COLMAP models of the photos")
    chosen = options.parse_args()
    bpnp.warm_up()
    measured(rows(chosen.data, chosen.scenes, chosen.limit, chosen.seed), chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
