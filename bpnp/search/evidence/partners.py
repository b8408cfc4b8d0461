"""Which scene points may be the partners of image points under a pose, and the focal length that fits it best."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bpnp.search.evidence.settings import OtherFocal
from bpnp.search.point_sets import PointSets, faces

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
FARTHEST = 4.0  # scales from an image point within which scene points may be its partner
FEW_NEIGHBOURS, NEIGHBOURS = 8, 64  # of an image point that are looked up: of most, and where more are near
DENSE = 4096  # possible matches up to which all distances are computed
OUTLIERS = 0.3  # share of the image points without a partner that the assignment expects
FEW_PARTNERS = 2  # scene points that may be the partner of each, where the focal length is fitted
MOST_ZOOM, SAME_ZOOM = 0.2, 0.01  # step of the logarithm, at most; change that is none
MOST_ROUNDS = 4
FITTED_WIDTHS = (4.0, 2.0, 2.0, 1.0, 1.0)  # of the residuals, for steps of a pose with its focal length


def facing(sets: PointSets, camera: Array, rotation: Array) -> Labels:
    """Places of the scene points (n, 3), in the camera's frame, that it may see."""
    used = np.einsum("ki,ki->k", camera, camera) > 0
    if sets.normals3d is not None:
        used &= faces(sets.normals3d, sets.cosines3d, camera, rotation)
    return np.flatnonzero(used)


def across(seen: Array) -> Array:
    """Projections (k, 3, 3) to the planes that directions (k, 3) are perpendicular to."""
    return np.asarray(np.eye(3) - seen[:, :, None] * seen[:, None, :])


def partners(
    sets: PointSets, seen: Array, places: Labels, chosen: Labels, scale: float, most: int = NEIGHBOURS
) -> tuple[Any, Any, Array, Array]:
    """Possible matches (k,) of a chosen image point and a scene point near it, and the density (k,) of each; and the
    density (m,) of the image points, with that of having no partner.

    seen: (n, 3) directions of the scene points at `places`. Points of different labels are no match. most: neighbours
    of an image point that are looked up.
    """
    bearings, reach = sets.bearings[chosen], FARTHEST * scale
    if len(bearings) * len(seen) <= DENSE:
        squared = ((bearings[:, None] - seen) ** 2).sum(-1)
        i, j = np.nonzero(squared < reach**2)
        squared = squared[i, j]
    else:
        tree, counts = cKDTree(seen), range(1, min(most, len(seen)) + 1)
        for count in (counts[:FEW_NEIGHBOURS][-1], counts[-1]):  # few are enough unless all of them are near
            distance, nearest = tree.query(bearings, counts[:count], distance_upper_bound=reach)
            if count == len(counts) or not np.isfinite(distance[:, -1]).any():
                break
        i, nth = np.nonzero(np.isfinite(distance))
        j, squared = nearest[i, nth].astype(np.int64), distance[i, nth] ** 2
    candidates = np.full(len(bearings), len(seen))
    odds = np.ones(len(i))
    if sets.odds2d is not None and sets.classes3d is not None:
        odds = (sets.odds2d[chosen[i]] * sets.classes3d[places[j]]).sum(-1)
    elif sets.labels2d is not None and sets.labels3d is not None:
        label, others = sets.labels2d[chosen], sets.labels3d[places]
        agree = (label[i] == others[j]) | (label[i] < 0) | (others[j] < 0)
        i, j, squared, odds = i[agree], j[agree], squared[agree], odds[agree]
        of_label = np.bincount(others + 1, minlength=int(label.max(initial=0)) + 2)
        candidates = np.where(label < 0, len(seen), of_label[label + 1] + of_label[0])
    density = odds * np.exp(squared * (-0.5 / scale**2)) * (1 - OUTLIERS) / (candidates[i] * 2 * math.pi * scale**2)
    every = np.bincount(i, density, len(bearings)) + OUTLIERS / sets.image.solid_angle
    return i, j, np.asarray(density, np.float64), np.asarray(every, np.float64)


def explained(sets: PointSets, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
    """Mean log-likelihood of the bearings under a pose with residuals of `scale`, radians, in nats as the annealing has
    it: in units in which a kernel is 1 / s^2 where it is largest; and the share of min(m, n) points with a partner."""
    camera, chosen = sets.points3d @ rotation.T + translation, sets.image.chosen
    places = facing(sets, camera, rotation)
    if not len(places):
        return -math.inf, 0.0
    seen = camera[places] / np.linalg.norm(camera[places], axis=-1, keepdims=True)
    i, _, density, every = partners(sets, seen, places, chosen, scale)
    matched = float((density / every[i]).sum()) * len(sets.bearings) / len(chosen)
    return float(np.log(2 * math.pi * every).mean()), min(matched / min(len(sets.bearings), len(sets.points3d)), 1.0)


def by_focal_length(seen: Array) -> Array:
    """Derivatives (k, 3, 1) of directions (k, 3) by the logarithm of the focal length."""
    return np.asarray(across(seen) @ (seen * (1, 1, 0))[..., None])


class Zoomed(NamedTuple):
    """A pose with a focal length, `zoom` over the given one, and products (7, 7) and gradient (7,) of a Gauss-Newton
    step of turn, shift and log zoom."""

    rotation: Array
    middle: Array
    zoom: float
    products: Array
    gradient: Array


def _zoomed(
    sets: PointSets, chosen: Labels, scale: float, rotation: Array, middle: Array, zoom: float
) -> Zoomed | None:
    """middle: (3,) of the scene, seen from the camera. None without a match."""
    turned = (sets.points3d - sets.middle) @ rotation.T
    places = facing(sets, turned + middle, rotation)
    turned, stretch = turned[places], np.array([zoom, zoom, 1.0])
    seen = (turned + middle) * stretch
    length = np.sqrt(np.einsum("ki,ki->k", seen, seen))
    seen /= length[:, None]
    i, j, density, every = partners(sets, seen, places, chosen, scale, FEW_PARTNERS)
    if not len(i):
        return None
    probability = density / every[i]
    weights = np.bincount(j, probability, len(seen))
    used = np.flatnonzero(weights)
    seen_as = np.stack([np.bincount(j, probability * axis, len(seen)) for axis in sets.bearings[chosen[i]].T], -1)
    p, u, weights = turned[used], seen[used], weights[used]
    by_shift = across(u) * (stretch / length[used, None, None])
    by_zoom = by_shift[:, :, :2] @ (p + middle)[:, :2, None]
    jacobian = np.concatenate([np.cross(p[:, None], by_shift, axisb=2, axisc=2), by_shift, by_zoom], -1)
    products = np.tensordot(jacobian * weights[:, None, None], jacobian, ((0, 1), (0, 1)))
    gradient = np.tensordot(jacobian, seen_as[used] - weights[:, None] * u, ((0, 1), (0, 1)))
    return Zoomed(rotation, middle, zoom, products, gradient)


def with_focal_length(sets: PointSets, rotation: Array, middle: Array, scale: float) -> Zoomed | None:
    """A pose with residuals of `scale`, and the focal length that fits it best, after Gauss-Newton steps of both until
    the focal length stays, by some of the image points, and the last ones by all; None if nothing matches.

    middle: (3,) of the scene, seen from the camera.
    """
    chosen = sets.image.chosen
    some = chosen[:: max(len(chosen) // OtherFocal.bearings, 1)]
    step = _zoomed(sets, some, FITTED_WIDTHS[0] * scale, rotation, middle, 1.0)
    for _ in range(MOST_ROUNDS):
        before = 0.0 if step is None else math.log(step.zoom)
        for width in FITTED_WIDTHS:
            step = None if step is None else _stepped(sets, some, width * scale, step)
        if step is None or abs(math.log(step.zoom) - before) < SAME_ZOOM:
            break
    for _ in range(2 if len(some) < len(chosen) else 0):  # the first one is of the matches of some still
        step = None if step is None else _stepped(sets, chosen, scale, step)
    return step


def _stepped(sets: PointSets, chosen: Labels, scale: float, at: Zoomed) -> Zoomed | None:
    """After a Gauss-Newton step of pose and focal length, with the matches of some scale."""
    products, gradient = at.products, at.gradient
    if sets.focal is not None and math.isfinite(sets.focal.sigma):
        products, gradient = products.copy(), gradient.copy()
        products[-1, -1] += (scale / sets.focal.sigma) ** 2
        gradient[-1] -= (scale / sets.focal.sigma) ** 2 * (sets.focal.offset + math.log(at.zoom))
    damped = products + np.diag(1e-6 * np.diag(products) + 1e-15)
    step = np.linalg.solve(damped, gradient)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    zoom = at.zoom * math.exp(float(np.clip(step[6], -MOST_ZOOM, MOST_ZOOM)))
    return _zoomed(sets, chosen, scale, turn @ at.rotation, at.middle + step[3:6], zoom)
