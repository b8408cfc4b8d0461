"""Problems of random scenes: the sparse map of a scene and one more photo of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp.arrays import Array
from bpnp.checks import check_positive, check_within
from bpnp.datamodules.augment import Augmentation, NumberOrRange, bounds
from bpnp.datamodules.loader import PARTS, ProblemDataModule
from bpnp.datamodules.problem import Counts, Problem, stack_problems
from bpnp.datamodules.synthetic_maps.kinds import facades, statue, street
from bpnp.datamodules.synthetic_maps.scene import (
    DrawnCamera,
    DrawnScene,
    Viewpoint,
    camera_at,
    details,
    find_visible,
    image_shape,
    nearby_camera,
)
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch

Frame = Literal["upright", "y_down", "view"]
Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # turns the third axis upwards to -y
LONG_SIDE = 1200.0  # longer side of an image, pixels
LEAST_POINTS = 1500  # least number of feature points of a scene
MOST_ERROR_PX = 5.0  # largest error of a match, pixels; a reconstruction drops keypoints beyond it
CHANGED = 0.8  # fraction of the unmatched points that have no keypoint in the photo
ATTEMPTS = 50  # largest number of scenes drawn for one problem


# Function that draws each kind, and number of feature points of its scene per point of a problem (a photo sees a part).
KINDS = {"facades": (facades, 16), "street": (street, 24), "statue": (statue, 12)}
WEIGHTS = {"facades": 0.5, "street": 0.25, "statue": 0.25}
WITHIN = "street"  # kind whose camera is within the scene, with a field of view in the upper half of the range


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Options of `draw_map_problem`; see `SyntheticMapDataModule` for those not listed."""

    num_points: int = 256
    min_points: int = 16
    outliers: NumberOrRange = (0.25, 1.0)
    views: tuple[int, int] = (1, 3)
    kinds: Mapping[str, float] = field(default_factory=WEIGHTS.copy)
    # Frame of the map: "upright" for the third axis upwards, "y_down" for the second axis downwards, "view" for the
    # coordinates of the first of the cameras whose map points are taken.
    frame: Frame = "upright"
    # Standard deviation of the rotation about each horizontal axis of a frame "upright" or "y_down", degrees, as where
    # the vertical is known roughly.
    tilt_deg: float | int = 0.0
    # Standard deviation of the heading of a frame "upright" or "y_down", degrees; at 0 the first of the cameras looks
    # along the second axis ("upright") or the third ("y_down"). None for any heading.
    heading_deg: float | int | None = None
    scale_range: tuple[float, float] = (0.1, 10.0)
    field_of_view: NumberOrRange = (24.0, 115.0)
    noise_px: NumberOrRange = (0.1, 1.5)

    def __post_init__(self) -> None:
        check_within(MIN_POINTS, self.num_points, min_points=self.min_points)
        check_within(0, 1, outliers=self.outliers)
        check_within(0, math.inf, noise_px=self.noise_px, scale_range=self.scale_range)
        check_within(5, 150, field_of_view=self.field_of_view)
        check_within(0, 180, tilt_deg=self.tilt_deg)
        if self.heading_deg is not None:
            check_within(0, math.inf, heading_deg=self.heading_deg)
        check_within(1, math.inf, views=self.views)
        check_positive(scale_range=self.scale_range[0])
        if self.frame not in get_args(Frame):
            raise ValueError(f"`frame` is {self.frame!r}; it is one of {', '.join(get_args(Frame))}")
        weights = list(self.kinds.values())
        if not set(self.kinds) <= set(KINDS) or not all(weight >= 0 for weight in weights) or not any(weights):
            raise ValueError(f"`kinds` is {dict(self.kinds)}; it needs weights of {', '.join(KINDS)}")


def draw_map_problem(name: str, options: MapOptions, rng: np.random.Generator) -> Problem:
    """Draw a scene, a map of it by some photos, and the keypoints of one more photo.

    If the photo shares fewer than `min_points` points with the map, another scene is drawn; ValueError after 50 scenes.
    """
    kinds = list(options.kinds)
    weights = np.array([options.kinds[kind] for kind in kinds])
    for _ in range(ATTEMPTS):
        kind = kinds[rng.choice(len(kinds), p=weights / weights.sum())]
        low, high = bounds(options.field_of_view)
        view = (math.sqrt(low * high), high) if kind == WITHIN else (low, high)
        half = math.tan(math.radians(_log_uniform(view, rng)) / 2)
        if (problem := _draw(name, kind, half, options, rng)) is not None:
            return problem
    raise ValueError(
        f"no photo of {ATTEMPTS} scenes shares {options.min_points} points with its map in {name}; use a smaller "
        "`min_points` or a larger `num_points`"
    )


def _draw(name: str, kind: str, half: float, options: MapOptions, rng: np.random.Generator) -> Problem | None:
    """Draw a problem of one kind of scene; None if photo and map share too few points."""
    draw_scene, density = KINDS[kind]
    scene, view = draw_scene(max(LEAST_POINTS, density * options.num_points), half, rng)
    reach = details(scene, view, half, rng)
    shape = image_shape(half, rng)
    photo = camera_at(view.centre, view.target, shape, rng)
    noise_px = _log_uniform(options.noise_px, rng)
    focal = LONG_SIDE / 2 / half

    sight = find_visible(scene, photo, reach, rng, alone=True)
    keypoints = sight.image + noise_px / focal * rng.standard_normal(sight.image.shape)
    cameras = [nearby_camera(view, shape, rng) for _ in range(rng.integers(*options.views, endpoint=True))]
    map_index, map_points = triangulate(scene, view, cameras, reach, noise_px / focal, rng)

    _, common2d, common3d = np.intersect1d(sight.of, map_index, assume_unique=True, return_indices=True)
    matched = _draw_matches(photo, cameras[0], map_points[common3d], keypoints[common2d], MOST_ERROR_PX / focal, rng)
    matched2d, matched3d = common2d[matched], common3d[matched]
    if len(matched2d) < options.min_points:
        return None
    # A point seen from another side mostly has no keypoint either.
    changed = common2d[~matched & (rng.random(len(matched)) < CHANGED)]
    others2d = np.setdiff1d(np.arange(len(keypoints)), np.concatenate([matched2d, changed]))
    others3d = np.setdiff1d(np.arange(len(map_index)), matched3d)
    matches, extra2d, extra3d = _amounts(len(matched2d), len(others2d), len(others3d), options, rng)
    if matches < options.min_points:
        return None
    if options.heading_deg is None:
        angle = rng.uniform(0, 2 * np.pi)
    else:
        ahead = cameras[0].rotation[2]
        angle = math.atan2(ahead[0], ahead[1]) + math.radians(options.heading_deg) * rng.standard_normal()
    heading = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    tilt = Rotation.from_rotvec([*(math.radians(options.tilt_deg) * rng.standard_normal(2)), 0.0]).as_matrix()
    scale = _log_uniform(options.scale_range, rng)
    map_rotation, origin = tilt @ heading, 20 * scale * rng.standard_normal(3)
    if options.frame == "y_down":
        map_rotation = Y_DOWN @ map_rotation
    elif options.frame == "view":
        map_rotation, origin = cameras[0].rotation, scale * cameras[0].translation
    pick = rng.permutation(len(matched2d))[:matches]
    chosen2d = np.concatenate([matched2d[pick], rng.permutation(others2d)[:extra2d]])
    chosen3d = np.concatenate([matched3d[pick], rng.permutation(others3d)[:extra3d]])
    points3d = scale * map_points[chosen3d] @ map_rotation.T + origin
    rotation = photo.rotation @ map_rotation.T
    translation = scale * photo.translation - rotation @ origin
    points2d = keypoints[chosen2d].astype(np.float32)
    return Problem(name, points2d, points3d.astype(np.float32), matches, rotation, translation, focal)


def triangulate(
    scene: DrawnScene, view: Viewpoint, cameras: list[DrawnCamera], reach: Array, noise: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Return the indices (k,) of the scene points in the map, ascending, and their map positions (k, 3).

    A point is in the map if one of the cameras and enough other photos have a keypoint of it. Its position is off along
    the ray of the camera by a normal error of its inverse depth, noise / (baseline sqrt(photos)): with few photos from
    almost one position, far points are anywhere along the ray. `noise` is the standard deviation of a keypoint in
    radians, `reach` is as in `find_visible`.
    """
    photos = int(2 ** rng.uniform(1, 4))  # number of other photos that may see a point
    least = int(rng.integers(1, 3))  # number of them that have to see it
    distance = float(np.linalg.norm(view.centre - view.target))
    baseline = distance * _log_uniform(view.parallax, rng)
    index, points = [], []
    in_map = np.zeros(len(scene.points), bool)
    for camera in cameras:
        sight = find_visible(scene, camera, reach, rng, alone=False)
        track = rng.binomial(photos, scene.repeatability[sight.of])
        is_new = (track >= least) & ~in_map[sight.of]
        added = sight.of[is_new]
        in_map[added] = True
        depth = sight.depth[is_new]
        inverse = 1 / depth + noise / (baseline * np.sqrt(track[is_new])) * rng.standard_normal(len(added))
        along = 1 / (depth * np.maximum(inverse, 1e-5 / depth))
        index.append(added)
        points.append(camera.centre + along[:, None] * (scene.points[added] - camera.centre))
    order = np.argsort(np.concatenate(index))
    return np.concatenate(index)[order], np.concatenate(points)[order]


def _draw_matches(
    photo: DrawnCamera, other: DrawnCamera, points: Array, keypoints: Array, most: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Draw which keypoints (k, 2) are matched with their map points (k, 3).

    They have to be near the projection, and the map's first camera has to see the point at a similar angle.
    """
    camera = points @ photo.rotation.T + photo.translation
    near = camera[:, 2] > 0
    error = np.linalg.norm(camera[:, :2] / np.where(near, camera[:, 2], 1.0)[:, None] - keypoints, axis=-1)
    ray, other_ray = points - photo.centre, points - other.centre
    cosine = (ray * other_ray).sum(-1) / np.sqrt((ray**2).sum(-1) * (other_ray**2).sum(-1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    return near & (error < most) & (rng.random(len(points)) < 0.95 * np.exp(-((angle / 0.6) ** 2)))


def _amounts(
    matches: int, others2d: int, others3d: int, options: MapOptions, rng: np.random.Generator
) -> tuple[int, int, int]:
    """Return the numbers of matches and of points of each side without correspondence.

    They are reduced in proportion so that the larger side has `num_points`.
    """
    outliers = _uniform(options.outliers, rng)
    allowed = np.inf if outliers >= 1 else matches * outliers / (1 - outliers)
    extra2d, extra3d = min(others2d, allowed), min(others3d, allowed)
    factor = min(1.0, options.num_points / (matches + max(extra2d, extra3d)))
    return int(matches * factor), int(extra2d * factor), int(extra3d * factor)


def _uniform(value: NumberOrRange, rng: np.random.Generator) -> float:
    low, high = bounds(value)
    return float(rng.uniform(low, high)) if low < high else low


def _log_uniform(value: NumberOrRange, rng: np.random.Generator) -> float:
    low, high = bounds(value)
    return float(low * (high / low) ** rng.random()) if 0 < low < high else _uniform(value, rng)


class MapSource:
    """Source of problems with one scene each, drawn on demand as a function of (seed, epoch, index), at least one."""

    def __init__(self, options: MapOptions, *, count: int, seed: Sequence[int], label: str) -> None:
        check_within(1, math.inf, **{f"{label}_problems": count})
        self.options, self.count, self.seed, self.label = options, count, tuple(seed), label

    @property
    def counts(self) -> Counts:
        """Upper limits of the numbers of points of each problem."""
        most = np.full(self.count, self.options.num_points)
        return Counts(most, most, most)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Return problems; see `ProblemSource.batch`."""
        rngs = ((i, np.random.default_rng([*self.seed, epoch, i])) for i in index.tolist())
        return stack_problems(
            [draw_map_problem(f"map/{self.label}/{i:06d}", self.options, rng) for i, rng in rngs], index
        )


class SyntheticMapDataModule(ProblemDataModule):
    """Keypoints of a photo against the part of a sparse map that some other photos see, all drawn at random.

    Every problem has its own scene, drawn on demand. A point is in the map if enough photos have a keypoint of it; its
    position is off along its ray by the error of its triangulation. Three kinds of points have no correspondence:
    keypoints of one photo only, points that the photo does not see, and missed matches. Works without a Trainer:
    `setup()`, then the loaders.

    Args:
        train_problems: Number of training problems in an epoch.
        fresh_views: Draw new scenes and cameras every epoch, the default; False for fixed problems.
        val_problems: Number of validation problems, fixed.
        test_problems: Number of problems to test and predict on, fixed.
        num_points: Largest number of points of a side; of more, matches and others are reduced in proportion.
        min_points: Least number of matches, at least 4; a scene with fewer is replaced.
        outliers: Largest fraction of the points of each side without correspondence; 1 keeps all of them. Two
            numbers, [low, high], draw it uniformly for each problem.
        views: Smallest and largest number of photos whose map points are taken.
        kinds: Weight of each kind of scene; None for half facades, and a quarter each street and statue.
        frame: Frame of the map: "any", the default, rotated at random; "upright", the third axis upwards; "y_down", the
            second axis downwards, as in many maps of COLMAP; "view", the coordinates of the first of the cameras whose
            map points are taken.
        tilt_deg: Standard deviation of the rotation about each horizontal axis of a frame "upright" or "y_down",
            degrees.
        heading_deg: Standard deviation of the heading of a frame "upright" or "y_down", degrees; at 0 the first of the
            cameras whose map points are taken looks along the second axis ("upright") or the third ("y_down"), as in a
            map of COLMAP that began with this photo. None for any heading. Other frames do not use it.
        scale_range: Smallest and largest number of scene units in a metre, drawn for each scene, uniform in its
            logarithm.
        field_of_view: Field of view of the longer side of an image, degrees; a number or [low, high], uniform in the
            logarithm.
        noise_px: Standard deviation of the noise of 2D points, pixels of an image with 1200 on its longer side; a
            number or [low, high], uniform in the logarithm.
        **loading: Options of `ProblemDataModule`: train_outliers, test_outliers, batch_size, eval_batch_size,
            max_cells, num_workers and seed.
    """

    def __init__(
        self,
        *,
        train_problems: int = 40_000,
        fresh_views: bool = True,
        val_problems: int = 200,
        test_problems: int = 200,
        num_points: int = 256,
        min_points: int = 16,
        outliers: NumberOrRange = (0.25, 1.0),
        views: tuple[int, int] = (1, 3),
        kinds: Mapping[str, float] | None = None,
        frame: Literal["any", "upright", "y_down", "view"] = "any",
        tilt_deg: float | int = 0.0,
        heading_deg: float | int | None = None,
        scale_range: tuple[float, float] = (0.1, 10.0),
        field_of_view: NumberOrRange = (24.0, 115.0),
        noise_px: NumberOrRange = (0.1, 1.5),
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        self.options = MapOptions(
            num_points=num_points,
            min_points=min_points,
            outliers=outliers,
            views=views,
            kinds=WEIGHTS if kinds is None else kinds,
            frame="upright" if frame == "any" else frame,
            tilt_deg=tilt_deg,
            heading_deg=heading_deg,
            scale_range=scale_range,
            field_of_view=field_of_view,
            noise_px=noise_px,
        )
        self.problems = {"train": train_problems, "val": val_problems, "test": test_problems}
        self.fresh = fresh_views
        self.augmentations = dict.fromkeys(PARTS, Augmentation(rotate=frame == "any"))

    def _source(self, split: str, seed: tuple[int, int]) -> MapSource:
        return MapSource(self.options, count=self.problems[split], seed=seed, label=split)
