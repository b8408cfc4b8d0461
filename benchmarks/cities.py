"""Maps merged to one: models at random places, and as many changed copies of them as reach a number of views.

A copy is another place with the statistics of a real one: mirrored or not, its points moved along a smooth field by
about a tenth of the distance from which they are seen, and a third of them dropped.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp import SceneMap
from bpnp.cameras import camera_from
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction
from bpnp.maps.views import View

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
MOVED, WAVES = 0.1, 6  # root mean square of the field, in distances of the view; sine waves in it
DROPPED = 0.3  # share of a copy's points
APART = 40.0  # side of the cube in which places lie, in distances of a view, for 10 of them
CAMERA = camera_from(np.eye(3))  # views are looked near by pose alone


@dataclass(frozen=True, eq=False)
class Place:
    """A model at a place: points (n, 3), and its views with the points that they see."""

    points3d: Array
    views: tuple[View, ...]

    def moved(self, scale: float, turn: Array, shift: Array) -> "Place":
        """The place with every point p at scale * turn p + shift."""
        views = []
        for view in self.views:
            rotation = view.rotation @ turn.T
            views.append(replace(view, rotation=rotation, translation=scale * view.translation - rotation @ shift))
        return Place(scale * self.points3d @ turn.T + shift, tuple(views))

    def only(self, chosen: NDArray[np.bool_], name: str = "") -> "Place":
        """Some points, and all views with those of them that they see; `name` begins the names of the views."""
        number = np.cumsum(chosen, dtype=np.int32) - 1
        views = tuple(
            replace(view, name=name + view.name, points=number[view.points[chosen[view.points]]]) for view in self.views
        )
        return Place(self.points3d[chosen], views)

    @property
    def distance(self) -> float:
        """From a view to the points that it sees: the median of the views' medians."""
        far = [
            np.median(np.linalg.norm(self.points3d[v.points] - v.centre, axis=1)) for v in self.views if len(v.points)
        ]
        return float(np.median(far))


@dataclass(frozen=True, eq=False)
class CityPhoto:
    """A photo that was left out: all its keypoints (m, 2), normalised; poses: the true one, and of a repeated place the
    one there. distance: of the median point that it sees."""

    name: str
    points2d: Array
    focal: float
    poses: tuple[Pose, ...]
    distance: float


def place_of(scene: Reconstruction, left_out: Sequence[ImagePoints] = ()) -> Place:
    """A model without some views."""
    names = {image.name for image in left_out}
    return Place(
        scene.points3d,
        tuple(
            View(
                f"{scene.name}/{image.name}", CAMERA, image.rotation, image.translation, image.observed.astype(np.int32)
            )
            for image in scene.images
            if image.name not in names
        ),
    )


def changed(place: Place, rng: np.random.Generator, name: str) -> Place:
    """Another place of the same kind: points moved and dropped, or mirrored with all views."""
    unit, points = place.distance, place.points3d
    field = np.zeros_like(points)
    for _ in range(WAVES):
        along = rng.standard_normal(3)
        along *= 2 * np.pi / (unit * rng.uniform(0.7, 2.5) * np.linalg.norm(along))
        field += np.sin(points @ along + rng.uniform(0, 2 * np.pi))[:, None] * rng.standard_normal(3)
    field *= MOVED * unit / np.sqrt(WAVES * 3 / 2)
    mirror = np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0])  # of the scene and, so that views stay views, of the image
    views = tuple(
        replace(view, rotation=mirror @ view.rotation @ mirror, translation=mirror @ view.translation)
        for view in place.views
    )
    return Place((points + field) @ mirror, views).only(rng.random(len(points)) > DROPPED, name)


def anywhere(rng: np.random.Generator, places: int, unit: float) -> tuple[float, Array, Array]:
    """A similarity: to scene units of 0.5 to 2 distances of a view, any rotation, a place in the city."""
    scale = float(np.exp(rng.uniform(-1, 1) * np.log(2))) / unit
    side = APART * (places / 10) ** (1 / 3)
    return scale, Rotation.random(rng=rng).as_matrix(), rng.uniform(0, side, 3)


def photos_of(scene: Reconstruction, limit: int) -> list[ImagePoints]:
    """At most `limit` photos and a fourth of all, spread evenly over those that see enough of what others see."""
    tracks = np.bincount(np.concatenate([image.observed for image in scene.images]), minlength=len(scene.points3d))
    usable = [image for image in scene.images if (tracks[image.observed] >= 3).sum() >= 50]
    count = min(limit, len(scene.images) // 4)
    return [usable[k] for k in sorted({int((k + 0.5) * len(usable) / count) for k in range(count)})]


def city(
    scenes: Sequence[Reconstruction], photos: dict[str, int], views: int, seed: int, *, twice: float | None = None
) -> tuple[SceneMap, list[CityPhoto]]:
    """The map of all scenes, with changed copies up to a number of views, and the photos that were left out of it.

    photos: of each scene at most so many; points that then fewer than two views see are not in the map. twice: every
    place is there twice instead, of the second one this share of the points gone.
    """
    rng = np.random.default_rng(seed)
    left_out = {scene.name: photos_of(scene, photos.get(scene.name, 0)) for scene in scenes}
    first = [_seen_twice(place_of(scene, left_out[scene.name])) for scene in scenes]
    places, found = [], []
    for place, scene in zip(first, scenes, strict=True):
        move = anywhere(rng, len(scenes), place.distance)
        moves = [move] if twice is None else [move, anywhere(rng, len(scenes), place.distance)]
        places.append(place.moved(*move))
        if twice is not None:
            places.append(place.only(rng.random(len(place.points3d)) >= twice, "again/").moved(*moves[1]))
        for image in left_out[scene.name]:
            poses = tuple((image.rotation @ q.T, s * image.translation - image.rotation @ q.T @ c) for s, q, c in moves)
            keypoints = np.concatenate([image.points2d, image.clutter2d]).astype(np.float64)
            far = np.linalg.norm(scene.points3d[image.seen] @ image.rotation.T + image.translation, axis=-1)
            name, unit = f"{scene.name}/{image.name}", moves[0][0] * float(np.median(far))
            found.append(CityPhoto(name, rng.permutation(keypoints), image.camera.focal, poses, unit))
    if twice is None:
        places += _copies(first, views - sum(len(place.views) for place in places), views, rng)
    return merged(places), found


def _copies(first: Sequence[Place], more: int, views: int, rng: np.random.Generator) -> Iterator[Place]:
    """Changed copies of the places, one after the other, up to so many more views."""
    number = 0
    while more > 0:
        place = changed(first[number % len(first)], rng, f"copy {number // len(first) + 1}/")
        place = replace(place, views=place.views[:more])
        yield place.moved(*anywhere(rng, len(first) * max(views // 500, 1), place.distance))
        more, number = more - len(place.views), number + 1


def _seen_twice(place: Place) -> Place:
    tracks = np.bincount(np.concatenate([view.points for view in place.views]), minlength=len(place.points3d))
    return place.only(tracks >= 2)


def merged(places: Sequence[Place]) -> SceneMap:
    """One map of all places, its ids in their order."""
    starts = np.cumsum([0] + [len(place.points3d) for place in places])
    views = tuple(
        replace(view, points=view.points + np.int32(start))
        for place, start in zip(places, starts, strict=False)
        for view in place.views
    )
    points = np.concatenate([place.points3d for place in places])
    return SceneMap(points, np.arange(len(points)), np.zeros(len(points), np.int32), views).seen_by(1)
