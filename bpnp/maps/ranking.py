"""Which views of a map a photo may be near: a rank from the density of its points, before any pose is tried.

Where a place has texture, photos have keypoints and the map has points. Of a photo and of each view the contrast of
the density of its points is drawn as a small picture, as wide as the points reach, whatever the focal length; the
photo's is moved and scaled, and the view's rank is that of the largest correlation. All views together are one product
of matrices.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bpnp.maps.views import Array, View

Pictures = NDArray[np.float32]


@dataclass(frozen=True)
class RankSettings:
    """Constants of the rank.

    cells: along a side of a picture. half: its half width, in units within which the share `within` of the points lies.
    fine, wide: standard deviations of the smoothings whose difference is the contrast, cells. shifts: cells by which
    the photo is moved along either axis; scales: by which it is scaled. apart: share of a view's points that no better
    one sees, from which it is another place.
    """

    cells: int = 32
    within: float = 0.9
    half: float = 1.3
    fine: float = 1.0
    wide: float = 4.0
    shifts: tuple[int, ...] = (-9, -6, -3, 0, 3, 6, 9)
    scales: tuple[float, ...] = (0.7, 0.84, 1.0, 1.2, 1.4)
    apart: float = 0.5


RANK = RankSettings()
STEP = 1.25  # factor from one focal length that a photo may have to the next
RUNG = 4  # views that are tried with one before the next one


def pictures_of_views(points3d: Array, views: Sequence[View], rule: RankSettings = RANK) -> Pictures:
    """(views, cells^2) contrast of the points that each view sees."""
    found = np.zeros((len(views), rule.cells**2), np.float32)
    for k, view in enumerate(views):
        camera = points3d[view.points] @ view.rotation.T + view.translation
        camera = camera[camera[:, 2] > 0]
        found[k] = contrast(camera[:, :2] / camera[:, 2:], rule)
    return found


def pictures_of_photo(points2d: Array, rule: RankSettings = RANK) -> Pictures:
    """(moves, cells^2) contrast of a photo's normalised keypoints (m, 2), moved and scaled."""
    side, most, found = rule.cells, max(rule.shifts), []
    for scale in rule.scales:
        wide = np.pad(contrast(points2d, rule, scale).reshape(side, side), most)
        for down, right in product(rule.shifts, rule.shifts):
            found.append(wide[most + down :, most + right :][:side, :side].ravel())
    return np.stack(found)


def contrast(points2d: Array, rule: RankSettings = RANK, scale: float = 1.0) -> Pictures:
    """(cells^2,) of points (k, 2), `scale` times as large: density smoothed a little less that smoothed widely, of
    length one; 0 for none."""
    unit = np.quantile(np.abs(points2d).max(-1), rule.within) if len(points2d) else 1.0
    edges = np.linspace(-rule.half, rule.half, rule.cells + 1) * max(unit, 1e-12) / scale
    counts, _, _ = np.histogram2d(points2d[:, 1], points2d[:, 0], bins=(edges, edges))
    density = np.sqrt(gaussian_filter(counts, rule.fine, mode="constant"))
    picture = (density - gaussian_filter(density, rule.wide, mode="constant")).ravel()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-12), np.float32)


def scores_of_views(points2d: Array, views: Pictures, rule: RankSettings = RANK) -> NDArray[np.float32]:
    """(views,) largest correlation of each view's picture with a photo of normalised keypoints (m, 2)."""
    known = points2d[np.isfinite(points2d).all(-1)]
    return np.asarray((views @ pictures_of_photo(known, rule).T).max(-1))


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
