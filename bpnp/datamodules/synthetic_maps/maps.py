"""The sparse map that photos of a scene give, and a photo's keypoints against a part of it: one pair."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.augment import Drawn, bounds
from bpnp.datamodules.pair import Pair
from bpnp.datamodules.synthetic_maps.buildings import facades, from_the_air, several_buildings
from bpnp.datamodules.synthetic_maps.objects import statue, table_top
from bpnp.datamodules.synthetic_maps.photos import Camera, camera_at, details, image_shape, look, nearby_camera
from bpnp.datamodules.synthetic_maps.scene import Array, Kind, Scene, Viewpoint
from bpnp.datamodules.synthetic_maps.surrounded import courtyard, interior, street

Frame = Literal["upright", "view"]
LONG_SIDE = 1200.0  # of an image, pixels
LEAST_POINTS = 1500  # feature points of a scene
MOST_ERROR_PX = 5.0  # of a true pair, pixels; beyond, a reconstruction drops the keypoint from its point
CHANGED = 0.8  # share of the points that were not matched of which the photo has no keypoint
ATTEMPTS = 50  # scenes drawn, until enough true pairs are found


class KindOfScene(NamedTuple):
    """A kind of scene; its default weight; feature points of a scene for each point of a pair, of which a photo sees a
    part; and whether the camera is within the scene: then its field of view is in the upper half of the range."""

    draw: Kind
    weight: float
    density: int
    within: bool = False


KINDS = {
    "facades": KindOfScene(facades, 0.25, 16),
    "several_buildings": KindOfScene(several_buildings, 0.12, 24),
    "from_the_air": KindOfScene(from_the_air, 0.08, 8),
    "street": KindOfScene(street, 0.12, 24, within=True),
    "courtyard": KindOfScene(courtyard, 0.08, 20, within=True),
    "interior": KindOfScene(interior, 0.12, 20, within=True),
    "statue": KindOfScene(statue, 0.16, 12),
    "table_top": KindOfScene(table_top, 0.07, 10),
}
WEIGHTS = {name: kind.weight for name, kind in KINDS.items()}


@dataclass(frozen=True)
class MapOptions:
    """How pairs of synthetic maps are drawn; see `SfmSceneDataModule`.

    frame: of the map, "upright" for the third axis upwards and any heading, "view" for the coordinates of the first of
    the cameras whose map points are taken. tilt_deg: standard deviation of the upright frame's turn about each of its
    horizontal axes, as where the vertical is known roughly.
    """

    num_points: int = 256
    min_points: int = 16
    outliers: Drawn = (0.25, 1.0)
    views: tuple[int, int] = (1, 3)
    kinds: Mapping[str, float] = field(default_factory=lambda: dict(WEIGHTS))
    frame: Frame = "upright"
    tilt_deg: float = 0.0
    scale_range: tuple[float, float] = (0.1, 10.0)
    field_of_view: Drawn = (24.0, 115.0)
    noise_px: Drawn = (0.1, 1.5)

    def __post_init__(self) -> None:
        if not 4 <= self.min_points <= self.num_points:
            raise ValueError(
                f"expected `min_points` from 4 to `num_points`, got {self.min_points} and {self.num_points}"
            )
        ranges = {"outliers": (0, 1), "noise_px": (0, np.inf), "field_of_view": (5, 150)}
        for name, (least, most) in ranges.items():
            low, high = bounds(getattr(self, name))
            if not (least <= low <= high <= most and high < np.inf):
                raise ValueError(
                    f"expected `{name}` from {least} to {most}, a number or (low, high), got {getattr(self, name)}"
                )
        if not 0 < self.scale_range[0] <= self.scale_range[1] < np.inf:
            raise ValueError(f"expected a positive `scale_range` (low, high), got {self.scale_range}")
        if not 0 <= self.tilt_deg <= 180:
            raise ValueError(f"expected `tilt_deg` from 0 to 180, got {self.tilt_deg}")
        if self.frame not in get_args(Frame):
            raise ValueError(f"expected `frame` among {', '.join(get_args(Frame))}, got {self.frame!r}")
        if not 1 <= self.views[0] <= self.views[1]:
            raise ValueError(f"expected `views` (low, high) of 1 or more, got {self.views}")
        if not set(self.kinds) <= set(KINDS) or not all(w >= 0 for w in self.kinds.values()) or not any(
            self.kinds.values()
        ):  # fmt: skip
            raise ValueError(f"expected `kinds` as weights of {', '.join(KINDS)}, got {dict(self.kinds)}")


class MapPoints(NamedTuple):
    """Points (n, 3) of a map, triangulated, and which points of the scene they are, of (n,)."""

    of: NDArray[np.int64]
    points: Array


def draw_map_pair(name: str, options: MapOptions, rng: np.random.Generator) -> Pair:
    """A new scene, a map of it by some photos, and one more photo's keypoints.

    A scene whose photo shares fewer than `min_points` points with the map is drawn anew. Raises ValueError if 50 are.
    """
    kinds = list(options.kinds)
    weights = np.array([options.kinds[kind] for kind in kinds])
    for _ in range(ATTEMPTS):
        kind = KINDS[kinds[rng.choice(len(kinds), p=weights / weights.sum())]]
        low, high = bounds(options.field_of_view)
        view = (math.sqrt(low * high), high) if kind.within else (low, high)
        half = math.tan(math.radians(_log_uniform(view, rng)) / 2)
        pair = _draw(name, kind, half, options, rng)
        if pair is not None:
            return pair
    raise ValueError(
        f"expected a photo that shares {options.min_points} points with its map in {ATTEMPTS} scenes, got none in "
        f"{name}; try a smaller `min_points` or a larger `num_points`"
    )


def _draw(name: str, kind: KindOfScene, half: float, options: MapOptions, rng: np.random.Generator) -> Pair | None:
    """A pair of a scene of this kind; None if photo and map share too few points."""
    scene, view = kind.draw(max(LEAST_POINTS, kind.density * options.num_points), half, rng)
    reach = details(scene, view, half, rng)
    shape = image_shape(half, rng)
    photo = camera_at(view.centre, view.target, shape, rng)
    noise_px = _log_uniform(options.noise_px, rng)
    focal = LONG_SIDE / 2 / half

    sight = look(scene, photo, reach, rng, alone=True)
    keypoints = sight.image + noise_px / focal * rng.standard_normal(sight.image.shape)
    cameras = [nearby_camera(view, shape, rng) for _ in range(rng.integers(*options.views, endpoint=True))]
    mapped = triangulated(scene, view, cameras, reach, noise_px / focal, rng)

    _, place2d, place3d = np.intersect1d(sight.of, mapped.of, assume_unique=True, return_indices=True)
    found = _matched(photo, cameras[0], mapped.points[place3d], keypoints[place2d], MOST_ERROR_PX / focal, rng)
    true2d, true3d = place2d[found], place3d[found]
    if len(true2d) < options.min_points:
        return None
    # A point that is seen from another side mostly has no keypoint either.
    changed = place2d[~found & (rng.random(len(found)) < CHANGED)]
    others2d = np.setdiff1d(np.arange(len(keypoints)), np.concatenate([true2d, changed]))
    others3d = np.setdiff1d(np.arange(len(mapped.of)), true3d)
    kept, extra2d, extra3d = _amounts(len(true2d), len(others2d), len(others3d), options, rng)
    if kept < options.min_points:
        return None
    heading = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    tilt = Rotation.from_rotvec([*(math.radians(options.tilt_deg) * rng.standard_normal(2)), 0.0]).as_matrix()
    scale = _log_uniform(options.scale_range, rng)
    turn, origin = tilt @ heading, 20 * scale * rng.standard_normal(3)  # of the map's axes
    if options.frame == "view":
        turn, origin = cameras[0].rotation, scale * cameras[0].translation
    pick = rng.permutation(len(true2d))[:kept]
    chosen2d = np.concatenate([true2d[pick], rng.permutation(others2d)[:extra2d]])
    chosen3d = np.concatenate([true3d[pick], rng.permutation(others3d)[:extra3d]])
    points3d = scale * mapped.points[chosen3d] @ turn.T + origin
    rotation = photo.rotation @ turn.T
    translation = scale * photo.translation - rotation @ origin
    return Pair(
        name, keypoints[chosen2d].astype(np.float32), points3d.astype(np.float32), kept, rotation, translation, focal
    )  # fmt: skip


def triangulated(
    scene: Scene, view: Viewpoint, cameras: list[Camera], reach: Array, noise: float, rng: np.random.Generator
) -> MapPoints:
    """The points of which one of the cameras and enough other photos have a keypoint.

    noise: of a keypoint, radians. A point is off along the ray of the camera by a normal error of its inverse depth,
    noise / (baseline sqrt(photos)): with few photos from almost one place far points are anywhere along the ray.
    """
    photos = int(2 ** rng.uniform(1, 4))  # others that may see a point
    least = int(rng.integers(1, 3))  # of them that have to
    distance = float(np.linalg.norm(view.centre - view.target))
    baseline = distance * _log_uniform(view.parallax, rng)
    index, points = [], []
    known = np.zeros(len(scene.points), bool)
    for camera in cameras:
        sight = look(scene, camera, reach, rng, alone=False)
        track = rng.binomial(photos, scene.repeatability[sight.of])
        keep = (track >= least) & ~known[sight.of]
        seen = sight.of[keep]
        known[seen] = True
        depth = sight.depth[keep]
        inverse = 1 / depth + noise / (baseline * np.sqrt(track[keep])) * rng.standard_normal(len(seen))
        along = 1 / (depth * np.maximum(inverse, 1e-5 / depth))
        index.append(seen)
        points.append(camera.centre + along[:, None] * (scene.points[seen] - camera.centre))
    order = np.argsort(np.concatenate(index))
    return MapPoints(np.concatenate(index)[order], np.concatenate(points)[order])


def _matched(
    photo: Camera, other: Camera, points: Array, keypoints: Array, most: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Which keypoints (k, 2) are matched with their map points (k, 3).

    They have to be near the projection, and the map's first camera has to see the point at a similar angle.
    """
    camera = points @ photo.rotation.T + photo.translation
    near = camera[:, 2] > 0
    error = np.linalg.norm(camera[:, :2] / np.where(near, camera[:, 2], 1.0)[:, None] - keypoints, axis=-1)
    ours, theirs = points - photo.centre, points - other.centre
    cosine = (ours * theirs).sum(-1) / np.sqrt((ours**2).sum(-1) * (theirs**2).sum(-1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    return near & (error < most) & (rng.random(len(points)) < 0.95 * np.exp(-((angle / 0.6) ** 2)))


def _amounts(
    true: int, others2d: int, others3d: int, options: MapOptions, rng: np.random.Generator
) -> tuple[int, int, int]:
    """True pairs, and points of each side without a partner: thinned alike to `num_points` of the larger side."""
    outliers = _uniform(options.outliers, rng)
    allowed = np.inf if outliers >= 1 else true * outliers / (1 - outliers)
    extra2d, extra3d = min(others2d, allowed), min(others3d, allowed)
    share = min(1.0, options.num_points / (true + max(extra2d, extra3d)))
    return int(true * share), int(extra2d * share), int(extra3d * share)


def _uniform(value: Drawn, rng: np.random.Generator) -> float:
    low, high = bounds(value)
    return float(rng.uniform(low, high)) if low < high else low


def _log_uniform(value: Drawn, rng: np.random.Generator) -> float:
    low, high = bounds(value)
    return float(low * (high / low) ** rng.random()) if 0 < low < high else _uniform(value, rng)
