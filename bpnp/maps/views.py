"""Views of a map: the points that they see and from where, and a ranking of the views for a photo by point density.

Places with texture have keypoints in photos and points in the map. The local contrast of the point density is computed
as a small image for the photo and for each view. Its width is that of the points, whatever the focal length. The
photo's image is shifted and scaled; the score of a view is the largest correlation. All views together are one matrix
product. If the photo's focal length is known, views whose points are much wider or narrower come last.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bpnp.arrays import Array
from bpnp.cameras import Camera

DENSITY_CELLS = 32  # cells along a side of a density image [cells; not tuned]
REACH_FRACTION = 0.9  # fraction of the points within one unit, the reach of the points [fraction; not tuned]
HALF_WIDTH = 1.3  # half width of the density image [reaches; not tuned]
NARROW_SIGMA = 1.0  # standard deviation of the narrow smoothing of the contrast [cells; not tuned]
WIDE_SIGMA = 4.0  # standard deviation of the wide smoothing of the contrast [cells; not tuned]
SHIFTS = (-9, -6, -3, 0, 3, 6, 9)  # shifts of the photo along either axis [cells; not tuned]
SCALES = (0.7, 0.84, 1.0, 1.2, 1.4)  # scale factors of the photo [factors; not tuned]
# Largest ratio of the reaches of a view and of a photo with a known focal length.
MOST_REACH_RATIO = 1.6  # [ratio; not tuned]
# Least fraction of a view's points that no better view sees, for it to count as another place.
OTHER_PLACE = 0.5  # [fraction; not tuned]
# Margin of the cone from which a point is seen, beyond the directions of its track. A local feature is rarely detected
# far outside these. In photos of five models, 95 % of the detected points are seen from at most 22 degrees beyond. Of
# the points that project into these photos and are not detected, 21 to 85 % would be seen from more than 30 degrees
# beyond.
VIEW_MARGIN_DEG = 25.0  # [degrees; measured, photos of five models]


@dataclass(frozen=True, eq=False)
class View:
    """A registered image of the map; camera = rotation p + translation (COLMAP's cam_from_world)."""

    name: str
    camera: Camera
    rotation: Array  # (3, 3) rotation matrix
    translation: Array  # (3,) translation, scene units
    points: NDArray[np.int32]  # (k,) indices in `SceneMap.points3d` of the points that it sees, ascending

    @property
    def centre(self) -> Array:
        """Camera centre in the scene, -R^T t."""
        return -self.rotation.T @ self.translation


class Cones(NamedTuple):
    """Cones of directions from which points are visible."""

    axes: Array  # (n, 3) unit vectors
    cosines: Array  # (n,) cosines of the half angles


def viewing_cones(points3d: Array, views: Iterable[tuple[Array, NDArray[np.integer]]]) -> Cones:
    """Return the visibility cones of n points; each view is its camera centre (3,) and the visible points' indices.

    The axis is the mean direction to the cameras. The cone holds all of them with a margin of `VIEW_MARGIN_DEG`. A
    point that no view sees has a cone of all directions.

    >>> import numpy as np
    >>> from bpnp.maps.views import viewing_cones
    >>> cones = viewing_cones(np.zeros((1, 3)), [(np.array([0.0, 0, 2]), np.array([0]))])
    >>> (cones.axes + 0.0).tolist(), round(float(np.degrees(np.arccos(cones.cosines[0]))))
    ([[0.0, 0.0, 1.0]], 25)
    """
    tracks = list(views)
    sums, least = np.zeros_like(points3d), np.ones(len(points3d))
    for centre, seen in tracks:
        sums[seen] += _directions(points3d[seen], centre)
    axes = _directions(sums, np.zeros(3)) * -1
    for centre, seen in tracks:
        cosine = (_directions(points3d[seen], centre) * axes[seen]).sum(-1)
        least[seen] = np.minimum(least[seen], cosine)
    half = np.degrees(np.arccos(np.clip(least, -1, 1))) + VIEW_MARGIN_DEG
    cosines = np.cos(np.radians(np.minimum(half, 180.0)))
    unseen = np.asarray(~sums.any(-1))
    return Cones(np.where(unseen[:, None], [0.0, 0, 1], axes), np.where(unseen, -1.0, cosines))


def _directions(points: Array, centre: Array) -> Array:
    """Return unit vectors (n, 3) from points to a centre; zero for a point at the centre."""
    towards = centre - points
    return np.asarray(towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-300))


class Pictures(NamedTuple):
    """Density images of views or of a photo."""

    contrasts: NDArray[np.float32]  # (k, cells^2) contrast of the point density, unit length
    reaches: Array  # (k,) half widths of the area of the points, normalised image coordinates


def pictures_of_views(points3d: Array, views: Sequence[View]) -> Pictures:
    """Return the density images of the points that each view sees."""
    contrasts, reaches = np.zeros((len(views), DENSITY_CELLS**2), np.float32), np.zeros(len(views))
    for k, view in enumerate(views):
        camera = points3d[view.points] @ view.rotation.T + view.translation
        camera = camera[camera[:, 2] > 0]
        points2d = camera[:, :2] / camera[:, 2:]
        reaches[k] = reach(points2d)
        contrasts[k] = contrast(points2d, reaches[k])
    return Pictures(contrasts, reaches)


def pictures_of_photo(points2d: Array) -> Pictures:
    """Return the density images of a photo's normalised keypoints (m, 2), shifted and scaled, and their reach (1,)."""
    side, most, found, unit = DENSITY_CELLS, max(SHIFTS), [], reach(points2d)
    for scale in SCALES:
        wide = np.pad(contrast(points2d, unit / scale).reshape(side, side), most)
        for down, right in product(SHIFTS, SHIFTS):
            found.append(wide[most + down :, most + right :][:side, :side].ravel())
    return Pictures(np.stack(found), np.array([unit]))


def reach(points2d: Array) -> float:
    """Return the half side of the square about the image centre that holds most of the points (k, 2)."""
    return max(float(np.quantile(np.abs(points2d).max(-1), REACH_FRACTION)), 1e-12) if len(points2d) else 1.0


def contrast(points2d: Array, unit: float) -> NDArray[np.float32]:
    """Return the density contrast (cells^2,) of points (k, 2), of unit length; 0 without points.

    It is the narrowly smoothed density less the widely smoothed one, in an image of `HALF_WIDTH` units to each side.
    """
    edges = np.linspace(-HALF_WIDTH, HALF_WIDTH, DENSITY_CELLS + 1) * unit
    counts, _, _ = np.histogram2d(points2d[:, 1], points2d[:, 0], bins=(edges, edges))
    density = np.sqrt(gaussian_filter(counts, NARROW_SIGMA, mode="constant"))
    picture = (density - gaussian_filter(density, WIDE_SIGMA, mode="constant")).ravel()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-12), np.float32)


def scores_of_views(points2d: Array, views: Pictures, *, known_focal: bool = True) -> NDArray[np.float32]:
    """Return the largest correlation (views,) of each view's density image with a photo of normalised keypoints (m, 2).

    If the photo's focal length is known, the score of a view whose points are much wider or narrower is reduced by 2.
    """
    photo = pictures_of_photo(points2d[np.isfinite(points2d).all(-1)])
    scores = (views.contrasts @ photo.contrasts.T).max(-1)
    unlike = np.abs(np.log(views.reaches / photo.reaches)) > np.log(MOST_REACH_RATIO)
    return np.asarray(scores - 2 * (unlike & known_focal), np.float32)


def places_first(views: Sequence[View], scores: NDArray[np.float32], count: int) -> Iterator[int]:
    """Yield the indices of the views, best first; views of a place that a better view shows come last."""
    unseen, later = np.ones(count, bool), []
    for k in np.argsort(-scores, kind="stable").tolist():
        points = views[k].points
        if len(points) and unseen[points].mean() >= OTHER_PLACE:
            unseen[points] = False
            yield k
        else:
            later.append(k)
    yield from later
