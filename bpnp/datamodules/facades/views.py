"""What a random camera sees of a scene of `sfm_scenes`, and the pair of point sets that comes of it."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.datamodules.augment import SIDES, Drawn, DrawnSide, Side, bounds
from bpnp.datamodules.facades.scenes import Array, Scene, Walls, draw_scene
from bpnp.datamodules.pair import Pair

LONG_SIDE = 1200.0  # of an image, pixels: a focal length of 800 to 1650 pixels at 75 to 40 degrees
MIN_DEPTH = 0.5  # metres; nothing nearer to the camera is seen
RELIEF = 0.8  # metres; a wall hides nothing that is nearer to its plane
SCENE_POINTS = 20  # points of a scene for each true pair that is wanted, at least 640 in all
ATTEMPTS = 50  # scenes drawn, until a camera sees enough


@dataclass(frozen=True)
class SfmOptions:
    """How the pairs of SfM-like scenes are drawn; see `SfmSceneDataModule`."""

    num_points: int = 128
    min_points: int = 16
    clutter: Drawn = 0.0
    clutter_side: DrawnSide = "both"
    scale_range: tuple[float, float] = (0.1, 10.0)
    field_of_view: Drawn = (40.0, 75.0)
    noise_px: Drawn = (0.5, 1.5)

    def __post_init__(self) -> None:
        if not 4 <= self.min_points <= self.num_points:
            raise ValueError(
                f"expected `min_points` from 4 to `num_points`, got {self.min_points} and {self.num_points}"
            )
        ranges = {"clutter": (0, np.inf), "noise_px": (0, np.inf), "field_of_view": (5, 150)}
        for name, (least, most) in ranges.items():
            low, high = bounds(getattr(self, name))
            if not (least <= low <= high <= most and high < np.inf):
                raise ValueError(
                    f"expected `{name}` from {least} to {most}, a number or (low, high), got {getattr(self, name)}"
                )
        if not 0 < self.scale_range[0] <= self.scale_range[1] < np.inf:
            raise ValueError(f"expected a positive `scale_range` (low, high), got {self.scale_range}")
        if self.clutter_side not in (*SIDES, "random"):
            raise ValueError(f'expected `clutter_side` "both", "2d", "3d" or "random", got {self.clutter_side!r}')


class Camera(NamedTuple):
    """camera = rotation p + translation, metres; half (2,): half the image's width and height over the focal length."""

    rotation: Array
    translation: Array
    centre: Array
    half: Array


class Sight(NamedTuple):
    """What is seen of a scene: true pairs and other keypoints, as indices of its points with image points for each."""

    true: NDArray[np.int64]
    unmapped: NDArray[np.int64]
    image: Array  # (n, 2) of all the scene's points; only those of the two are meaningful


def draw_camera(walls: Walls, field_of_view: float, rng: np.random.Generator) -> Camera:
    """A camera before one of the first building's walls, mostly at eye level, that looks at a place on it."""
    wall = rng.integers(walls.main)
    width, height = float(walls.width[wall]), float(walls.height[wall])
    aside, aloft, far, level, eye, tilted, shape, upright = rng.random(8).tolist()
    slant, roll = rng.standard_normal(2).tolist()
    angle = max(-1.15, min(1.15, math.radians(30) * slant))  # from the normal
    away = math.cos(angle) * walls.normal[wall] + math.sin(angle) * walls.along[wall]
    distance = max(4.0, math.sqrt(width * height) * 0.4 * 6.25**far)  # 0.4 to 2.5 times the wall's extent
    up = 1.4 + 1.1 * eye if level < 0.7 else 0.8 * height * eye
    flat = walls.start[wall] + width * (0.15 + 0.7 * aside) * walls.along[wall]
    centre = np.array([*(flat + distance * away), up])

    x, y = -distance * float(away[0]), -distance * float(away[1])
    z = height * (0.15 + 0.6 * aloft) - up
    level_length, length = math.hypot(x, y), math.hypot(x, y, z)
    ahead = np.array([x, y, z]) / length
    right = np.array([y, -x, 0.0]) / level_length
    down = np.array([x * z, y * z, -(level_length**2)]) / (level_length * length)
    roll *= math.radians(3 if tilted < 0.9 else 20)
    cos, sin = math.cos(roll), math.sin(roll)
    rotation = np.array([cos * right - sin * down, sin * right + cos * down, ahead])
    half = math.tan(math.radians(field_of_view) / 2) * np.array([1.0, 3 / 4 if shape < 0.5 else 2 / 3])
    return Camera(rotation, -rotation @ centre, centre, half if upright < 0.7 else half[::-1])


def look(scene: Scene, camera: Camera, detected: float, rng: np.random.Generator) -> Sight:
    """What the camera sees: points in the image, in front of their surface and of every wall, that are detected.

    detected: the probability that a point which is seen face to face is detected; slanted ones have less.
    """
    x, y, depth = camera.rotation @ scene.points.T + camera.translation[:, None]
    reach = np.maximum(depth, MIN_DEPTH)
    inside = (np.abs(x) < camera.half[0] * reach) & (np.abs(y) < camera.half[1] * reach) & (depth > MIN_DEPTH)
    near = np.flatnonzero(inside)
    towards, normals = camera.centre - scene.points[near], scene.normals[near]
    facing = np.einsum("ij,ij->i", towards, normals) / np.sqrt(np.einsum("ij,ij->i", towards, towards))
    facing[~normals.any(1)] = 1.0
    seen = near[rng.random(len(near)) * 0.35 < detected * np.minimum(facing, 0.35)]
    seen = seen[~hidden(scene.walls, camera.centre, scene.points[seen])]
    mapped = scene.mapped[seen]
    return Sight(seen[mapped], seen[~mapped], np.array([x, y]).T / reach[:, None])


def hidden(walls: Walls, centre: Array, points: Array) -> NDArray[np.bool_]:
    """Whether a wall is between the camera's centre (3,) and each of the points (n, 3)."""
    offset = np.einsum("ij,ij->i", walls.start, walls.normal)
    ours, theirs = centre[:2] @ walls.normal.T - offset, points[:, :2] @ walls.normal.T - offset
    apart = (ours * theirs < 0) & (np.abs(theirs) > RELIEF)
    share = ours / np.where(apart, ours - theirs, 1.0)  # of the way to the point, where it crosses the wall's plane
    first = np.einsum("ij,ij->i", walls.start, walls.along)
    place = centre[:2] @ walls.along.T - first + share * ((points[:, :2] - centre[:2]) @ walls.along.T)
    up = centre[2] + share * (points[:, 2:] - centre[2])
    return np.asarray((apart & (place > 0) & (place < walls.width) & (up < walls.height)).any(1))


def draw_sfm_pair(name: str, options: SfmOptions, rng: np.random.Generator) -> Pair:
    """A new scene, seen by a camera, with natural clutter.

    A scene of which the camera sees fewer than `min_points` mapped points is drawn anew. Raises ValueError if 50 are.
    """
    wanted, side = _drawn(options.clutter, rng), _drawn_side(options.clutter_side, rng)
    field_of_view = _drawn(options.field_of_view, rng)
    for _ in range(ATTEMPTS):
        scene = draw_scene(max(640, SCENE_POINTS * options.num_points), rng)
        camera = draw_camera(scene.walls, field_of_view, rng)
        sight = look(scene, camera, rng.uniform(0.4, 1.0), rng)
        if len(sight.true) >= options.min_points:
            break
    else:
        raise ValueError(
            f"expected a camera that sees {options.min_points} mapped points in {ATTEMPTS} scenes, got none in {name}; "
            "try a smaller `min_points` or a larger `field_of_view`"
        )
    true = rng.permutation(sight.true)[: options.num_points]
    extra = round(wanted * len(true))
    extra2d = rng.permutation(sight.unmapped)[: extra * (side != "3d")]
    extra3d = _unseen(scene, sight.true, extra * (side != "2d"), rng)

    focal = LONG_SIDE / 2 / float(camera.half.max())
    points2d = sight.image[np.concatenate([true, extra2d])]
    points2d += _drawn(options.noise_px, rng) / focal * rng.standard_normal(points2d.shape)
    points3d = scene.points[np.concatenate([true, extra3d])]
    points3d, rotation, translation = _in_frame(points3d, camera, options, rng)
    return Pair(
        name, points2d.astype(np.float32), points3d.astype(np.float32), len(true), rotation, translation, focal
    )  # fmt: skip


def _drawn(value: Drawn, rng: np.random.Generator) -> float:
    low, high = bounds(value)
    return float(rng.uniform(low, high)) if low < high else low


def _drawn_side(side: DrawnSide, rng: np.random.Generator) -> Side:
    sides: tuple[Side, ...] = ("both", "2d", "3d")
    return sides[rng.integers(3)] if side == "random" else side


def _unseen(scene: Scene, seen: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """`count` mapped points that are not seen, without repetition, the likelier the nearer to those that are."""
    mask = scene.mapped.copy()
    mask[seen] = False
    others = np.flatnonzero(mask)
    middle = scene.points[seen].mean(0)
    distance = np.sqrt(((scene.points - middle) ** 2).sum(1))
    # The smallest of exponential numbers over their weights are a draw by weight, one after the other.
    keys = rng.exponential(size=len(others)) * np.exp(distance[others] / (3 * max(1.0, distance[seen].mean())))
    return others[np.argsort(keys)[:count]]


def _in_frame(
    points: Array, camera: Camera, options: SfmOptions, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Points and pose in an upright frame of any scale and an origin nearby."""
    low, high = options.scale_range
    scale = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    origin = 20 * scale * rng.standard_normal(3)
    return scale * points + origin, camera.rotation, scale * camera.translation - camera.rotation @ origin
