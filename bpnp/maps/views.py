"""The views of a map: which points they see and from where; and which of them a photo may be near, by the density of
their points, before any pose is tried.

Where a place has texture, photos have keypoints and the map has points. Of a photo and of each view the contrast of
the density of its points is drawn as a small picture, as wide as the points reach, whatever the focal length; the
photo's is moved and scaled, and the view's rank is that of the largest correlation. All views together are one product
of matrices. Where the photo's focal length is known, views of much wider or narrower points come last.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bpnp.cameras import Camera

Array = NDArray[np.float64]
# A local feature is found again from some way beside the cameras that saw it, and hardly from farther: of the points
# that photos of five models see, 95 % are seen from 22 degrees or less beyond the directions of the track, where of the
# points that project into these photos and are not seen 21 to 85 % would be seen from more than 30 degrees beyond.
MARGIN_DEG = 25.0  # beyond the directions of the track


@dataclass(frozen=True, eq=False)
class View:
    """A registered image of the map; camera = rotation p + translation (COLMAP's cam_from_world).

    points: (k,) places in `SceneMap.points3d` of the points that it sees, ascending.
    """

    name: str
    camera: Camera
    rotation: Array
    translation: Array
    points: NDArray[np.int32]

    @property
    def centre(self) -> Array:
        """Centre of the camera in the scene, -R^T t."""
        return -self.rotation.T @ self.translation


class Cones(NamedTuple):
    """axes: (n, 3) unit vectors. cosines: (n,) of the angle about the axis from within which a point is seen."""

    axes: Array
    cosines: Array


def viewing_cones(points3d: Array, views: Iterable[tuple[Array, NDArray[np.integer]]]) -> Cones:
    """The cones of n points from views: the centre of the camera, and the places of the points that it sees.

    The axis is the mean direction to the cameras; the cone holds all of them and MARGIN_DEG more. A point that no view
    sees has a cone of all directions.

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
    half = np.degrees(np.arccos(np.clip(least, -1, 1))) + MARGIN_DEG
    cosines = np.cos(np.radians(np.minimum(half, 180.0)))
    unseen = np.asarray(~sums.any(-1))
    return Cones(np.where(unseen[:, None], [0.0, 0, 1], axes), np.where(unseen, -1.0, cosines))


def _directions(points: Array, centre: Array) -> Array:
    """Unit vectors (n, 3) from points to a centre; zero for one that lies there."""
    towards = centre - points
    return np.asarray(towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-300))


class Pictures(NamedTuple):
    """contrasts: (k, cells^2). reaches: (k,) half widths of what the points take up, normalised image coordinates."""

    contrasts: NDArray[np.float32]
    reaches: Array


@dataclass(frozen=True)
class RankSettings:
    """Constants of the rank.

    cells: along a side of a picture. half: its half width, in units within which the share `within` of the points lies.
    fine, wide: standard deviations of the smoothings whose difference is the contrast, cells. shifts: cells by which
    the photo is moved along either axis; scales: by which it is scaled. ratio: largest one of what the points of a
    photo of known focal length and those of a view take up. apart: share of a view's points that no better one sees,
    from which it is another place.
    """

    cells: int = 32
    within: float = 0.9
    half: float = 1.3
    fine: float = 1.0
    wide: float = 4.0
    shifts: tuple[int, ...] = (-9, -6, -3, 0, 3, 6, 9)
    scales: tuple[float, ...] = (0.7, 0.84, 1.0, 1.2, 1.4)
    ratio: float = 1.6
    apart: float = 0.5


RANK = RankSettings()
STEP = 1.25  # factor from one focal length that a photo may have to the next
RUNG = 4  # views that are tried with one before the next one


def pictures_of_views(points3d: Array, views: Sequence[View], rule: RankSettings = RANK) -> Pictures:
    """Contrast of the points that each view sees."""
    contrasts, reaches = np.zeros((len(views), rule.cells**2), np.float32), np.zeros(len(views))
    for k, view in enumerate(views):
        camera = points3d[view.points] @ view.rotation.T + view.translation
        camera = camera[camera[:, 2] > 0]
        points2d = camera[:, :2] / camera[:, 2:]
        reaches[k] = reach(points2d, rule)
        contrasts[k] = contrast(points2d, reaches[k], rule)
    return Pictures(contrasts, reaches)


def pictures_of_photo(points2d: Array, rule: RankSettings = RANK) -> Pictures:
    """Contrast of a photo's normalised keypoints (m, 2), moved and scaled; (1,) what they take up as they are."""
    side, most, found, unit = rule.cells, max(rule.shifts), [], reach(points2d, rule)
    for scale in rule.scales:
        wide = np.pad(contrast(points2d, unit / scale, rule).reshape(side, side), most)
        for down, right in product(rule.shifts, rule.shifts):
            found.append(wide[most + down :, most + right :][:side, :side].ravel())
    return Pictures(np.stack(found), np.array([unit]))


def reach(points2d: Array, rule: RankSettings = RANK) -> float:
    """Half the side of the square about the image's centre that most of the points (k, 2) lie in."""
    return max(float(np.quantile(np.abs(points2d).max(-1), rule.within)), 1e-12) if len(points2d) else 1.0


def contrast(points2d: Array, unit: float, rule: RankSettings = RANK) -> NDArray[np.float32]:
    """(cells^2,) of points (k, 2), in a picture of `rule.half` units to each side: density smoothed a little less that
    smoothed widely, of length one; 0 for none."""
    edges = np.linspace(-rule.half, rule.half, rule.cells + 1) * unit
    counts, _, _ = np.histogram2d(points2d[:, 1], points2d[:, 0], bins=(edges, edges))
    density = np.sqrt(gaussian_filter(counts, rule.fine, mode="constant"))
    picture = (density - gaussian_filter(density, rule.wide, mode="constant")).ravel()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-12), np.float32)


def scores_of_views(
    points2d: Array, views: Pictures, rule: RankSettings = RANK, *, known_focal: bool = True
) -> NDArray[np.float32]:
    """(views,) largest correlation of each view's picture with a photo of normalised keypoints (m, 2); less 2 for a
    view whose points take up much more or less, if the photo's focal length is known."""
    photo = pictures_of_photo(points2d[np.isfinite(points2d).all(-1)], rule)
    scores = (views.contrasts @ photo.contrasts.T).max(-1)
    unlike = np.abs(np.log(views.reaches / photo.reaches)) > np.log(rule.ratio)
    return np.asarray(scores - 2 * (unlike & known_focal), np.float32)


def places_first(
    views: Sequence[View], scores: NDArray[np.float32], count: int, rule: RankSettings = RANK
) -> Iterator[int]:
    """Numbers of the views, best first, those of a place that a better one shows after all other places.

    count: of the map's points.
    """
    unseen, later = np.ones(count, bool), []
    for k in np.argsort(-scores, kind="stable").tolist():
        points = views[k].points
        if len(points) and unseen[points].mean() >= rule.apart:
            unseen[points] = False
            yield k
        else:
            later.append(k)
    yield from later
