"""Problems in which a wrong verdict is likely: repeated structures, dependent points, wrong models.

Each function draws a problem: pixels, scene points, and the true poses; none if the points have no pose in common.
Units of length are arbitrary; the noise is half a pixel.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array, PoseArrays

Drawn = tuple[Array, Array, list[PoseArrays]]
FOCAL, WIDTH, HEIGHT = 500.0, 640, 480  # pixels
CAMERA = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
NOISE = 0.5  # pixels
WINDOW = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.8, 0], [0, 0.8, 0], [0.25, 0.9, 0.15]])


def board(rng: np.random.Generator) -> Drawn:
    """Draw part of a lattice of 14 x 10 points."""
    points = 0.3 * np.array([[i, j, 0.0] for i in range(14) for j in range(10)])
    return _in_frame(points, points, _facing(rng, 40, (1.5, 2.5), aside=0.8), rng)


def wallpaper(rng: np.random.Generator) -> Drawn:
    """Draw part of a motif of five points in relief, repeated 8 x 5 times."""
    motif = rng.uniform(0, 0.5, (5, 3)) * (1, 1, 0.3)
    points = np.concatenate([motif + (0.5 * i, 0.5 * j, 0) for i in range(8) for j in range(5)])
    return _in_frame(points, points, _facing(rng, 40, (1.5, 2.5), aside=0.8), rng)


def stairs(rng: np.random.Generator) -> Drawn:
    """Draw part of twelve steps with the same eight points across."""
    points = np.array([[x, 0.2 * k, 0.25 * k] for x in rng.uniform(-1, 1, 8) for k in range(12)])
    return _in_frame(points, points, _facing(rng, 40, (2, 3), aside=0.6), rng)


def row_of_windows(rng: np.random.Generator) -> Drawn:
    """Draw part of two rows of six windows and a door."""
    door = np.array([[6.2, 0, 0], [6.9, 0, 0], [6.9, 1.9, 0], [6.2, 1.9, 0]])
    points = np.concatenate([*(WINDOW[:4] + (i, 1.5 * j, 0) for i in range(6) for j in range(2)), door])
    points += 0.002 * rng.standard_normal(points.shape)
    return _in_frame(points, points, _facing(rng, 45, (4, 6), aside=1.8), rng)


def ending_facade(rng: np.random.Generator) -> Drawn:
    """Draw columns 4 to 9 of a facade against a map of columns 1 to 6."""
    column = np.repeat(np.arange(9), 10)
    points = np.concatenate([WINDOW + (i, 1.5 * j, 0) for i in range(9) for j in range(2)])
    points += 0.002 * rng.standard_normal(points.shape)
    return _in_frame(points[column >= 3], points, _facing(rng, 45, (6, 8), aside=0.3), rng, column < 6)


def colonnade(rng: np.random.Generator) -> Drawn:
    """Draw columns 3 to 6 of a colonnade against a map of columns 4 to 8."""
    column = np.repeat(np.arange(8), 12)
    points = np.tile(rng.uniform(-1, 1, (12, 3)) * (0.15, 1, 0.15), (8, 1)) + np.outer(column, (0.8, 0, 0))
    points += 0.003 * rng.standard_normal(points.shape)
    seen = (column >= 2) & (column < 6)
    return _in_frame(points[seen], points, _facing(rng, 30, (3, 5), aside=0.3), rng, column >= 3)


def gappy_facade(rng: np.random.Generator) -> Drawn:
    """Draw part of two rows of nine windows; a fifth of the points is missing in the map, another in the image."""
    points = np.concatenate([WINDOW + (i, 1.5 * j, 0) for i in range(9) for j in range(2)])
    points += 0.002 * rng.standard_normal(points.shape)
    seen, mapped = rng.random((2, len(points))) < 0.8
    return _in_frame(points[seen], points, _facing(rng, 45, (4, 6), aside=1.8), rng, mapped)


def facade_with_door(rng: np.random.Generator) -> Drawn:
    """Draw two rows of six windows, and eight points around a door that make the pose unique."""
    windows = [WINDOW[:4] + (i, 1.5 * j, 0) for i in range(6) for j in range(2)]
    points = np.concatenate([*windows, rng.uniform((0, -1, 0), (5, -0.3, 0.5), (8, 3))])
    return _in_frame(points, points, _facing(rng, 40, (6, 8), aside=0.3), rng)


def lines(rng: np.random.Generator) -> Drawn:
    """Draw five lines of 15 points, evenly spaced, in the image, and five others in the scene."""
    image, scene = (np.concatenate([_line(rng, axes) for _ in range(5)]) for axes in (2, 3))
    return image * 200 + (320, 240), scene, []


def clumps(rng: np.random.Generator) -> Drawn:
    """Draw five to eight clumps of eight keypoints, and as many of scene points, at other places."""
    count, width = int(rng.choice([5, 6, 8])), rng.choice([1.0, 3.0, 6.0])
    image = np.repeat(rng.uniform((0, 0), (WIDTH, HEIGHT), (count, 2)), 8, 0)
    scene = np.repeat(rng.standard_normal((count, 3)), 8, 0)
    image += width * rng.standard_normal(image.shape)
    return image, scene + width / 100 * rng.standard_normal(scene.shape), []


def helix(rng: np.random.Generator) -> Drawn:
    """Draw a curve that is sampled at different points in the image and in the scene."""
    count = int(rng.choice([40, 100]))
    angles = rng.uniform(0, 12.5, (2, count))
    image, scene = (np.column_stack([np.cos(a), np.sin(a), 0.15 * a - 0.9]) for a in angles)
    return _project(image, scene, _any(rng), rng)


def stretched(rng: np.random.Generator) -> Drawn:
    """Draw a cloud of 8 to 100 points that is stretched by 10 to 30 % along one axis in the image."""
    scene = rng.standard_normal((int(rng.choice([8, 12, 30, 100])), 3))
    factors = 1, 1, 1 + rng.choice([-0.3, -0.2, 0.1, 0.2, 0.3])
    return _project(scene * factors, scene, _any(rng), rng)


def hinged(rng: np.random.Generator) -> Drawn:
    """Draw a cloud of 12 to 200 points with one half rotated by 4 to 12 degrees; the pose of either half is correct."""
    scene = rng.uniform(-1, 1, (int(rng.choice([12, 24, 60, 200])), 3)) * (2, 1, 1)
    hinge = Rotation.from_euler("yz"[rng.integers(2)], rng.uniform(4, 12), degrees=True).as_matrix()
    image, (rotation, translation) = np.where(scene[:, :1] > 0, scene @ hinge.T, scene), _any(rng)
    pixels, _, _ = _project(image, scene, (rotation, translation), rng)
    return pixels, scene, [(rotation, translation), (rotation @ hinge, translation)]


def wrong_focal_cloud(rng: np.random.Generator) -> Drawn:
    """Draw a cloud of 8 to 100 points, seen by a camera of 0.5 to 2 times the focal length."""
    scene = rng.standard_normal((int(rng.choice([8, 15, 40, 100])), 3))
    return _project(scene, scene, _any(rng), rng, rng.choice([0.5, 0.6, 0.8, 1.2, 1.5, 2.0]))


def wrong_focal_plane(rng: np.random.Generator) -> Drawn:
    """Draw a plane of 8 to 40 points, seen by a camera of 0.5 to 2 times the focal length."""
    scene = rng.uniform(-1, 1, (int(rng.choice([8, 15, 40])), 3)) * (1, 1, 0)
    return _project(scene, scene, _facing(rng, 60, (3, 6)), rng, rng.choice([0.5, 0.6, 0.8, 1.2, 1.5, 2.0]))


SCENES: tuple[Callable[[np.random.Generator], Drawn], ...] = (
    ending_facade, colonnade, gappy_facade, row_of_windows, facade_with_door, stretched, hinged, wrong_focal_cloud,
    wrong_focal_plane, helix, lines, clumps, stairs, board, wallpaper,
)  # fmt: skip


def _line(rng: np.random.Generator, axes: int) -> Array:
    return rng.uniform(-1, 1, axes) + np.outer(np.linspace(0, 1, 15), rng.uniform(-1.5, 1.5, axes))


def _any(rng: np.random.Generator) -> PoseArrays:
    return Rotation.random(rng=rng).as_matrix(), np.array([*rng.normal(0, 0.3, 2), rng.uniform(4, 8)])


def _facing(rng: np.random.Generator, degrees: float, distance: tuple[float, float], aside: float = 0.4) -> PoseArrays:
    """Return a pose in front of a plane, with the optical axis rotated by up to `degrees` and shifted by `aside`."""
    axis = rng.standard_normal(3)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(5, degrees)) * axis / np.linalg.norm(axis)).as_matrix()
    return turn, np.array([*rng.uniform(-aside, aside, 2), rng.uniform(*distance)])


def _project(image: Array, scene: Array, pose: PoseArrays, rng: np.random.Generator, focal: float = 1.0) -> Drawn:
    """Return the shuffled pixels of the points `image` under the pose, with `focal` times the focal length."""
    camera = image @ pose[0].T + pose[1]
    pixels = camera[:, :2] / camera[:, 2:] * focal * FOCAL + (WIDTH / 2, HEIGHT / 2)
    return rng.permutation(pixels + NOISE * rng.standard_normal(pixels.shape)), scene, [pose]


def _in_frame(
    seen: Array, points: Array, pose: PoseArrays, rng: np.random.Generator, mapped: NDArray[np.bool_] | None = None
) -> Drawn:  # fmt: skip
    """Return the visible points that lie in the image, and the points of the map, both relative to their centroid."""
    centroid = points.mean(0)
    ahead = seen[((seen - centroid) @ pose[0].T + pose[1])[:, 2] > 0.05]
    pixels, _, _ = _project(ahead - centroid, points, pose, rng)
    inside = (pixels > 0).all(1) & (pixels < (WIDTH, HEIGHT)).all(1)
    return pixels[inside], (points if mapped is None else points[mapped]) - centroid, [pose]
