"""A pair of point sets as the search sees it: normalised, shuffled, and summed up in weighted clusters."""

import math
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from bpnp.geometry import MIN_POINTS
from bpnp.search.starts import Array, GravityPrior, Prior, angular_spread, solid_angle

SAMPLED = 8  # points a cluster, from which its centre is found
ITERATIONS = 5
FAR = 20.0  # median distances from the median
FLAT = 1e-6  # second singular value over the first, below which points lie on a line


class Scene:
    """One pair, centred and scaled to unit extent, each side in a random order, and its clusters.

    The few points of a reconstruction that lie orders of magnitude away decide neither centre nor extent (`near3d` are
    the others).

    device: where starts are aligned to clusters, in torch; None for compiled loops on the host.
    """

    def __init__(
        self,
        bearings: NDArray[np.float64],
        points3d: NDArray[np.float64],
        seed: int,
        device: torch.device | None = None,
    ) -> None:
        self.device = device
        self.rng = np.random.default_rng(seed)
        is_near = _is_near(points3d)
        near = points3d[is_near]
        self.centre = near.mean(0)
        self.size = max(float(np.sqrt(((near - self.centre) ** 2).sum(-1).mean())), 1e-30)
        self.bearings = self.rng.permutation(bearings).astype(np.float32)
        order = self.rng.permutation(len(points3d))
        self.points3d = ((points3d - self.centre) / self.size)[order].astype(np.float32)
        self.near3d = self.points3d[is_near[order]]
        self.spread, self.solid_angle = angular_spread(self.bearings), solid_angle(self.bearings)

    def outlier_density(self, share: float) -> np.float32:
        """o / s^2, o = 2 pi s^2 w / ((1 - w) A): the density of outliers against that of a kernel (Myronenko, Song)."""
        return np.float32(2 * math.pi * share / ((1 - share) * self.solid_angle))

    def enter_prior(self, prior: Prior) -> Prior:
        """The prior in this frame."""
        if isinstance(prior, GravityPrior) or prior.translation is None:
            return prior
        moved = torch.as_tensor(self.enter(np.asarray(prior.rotation, float), np.asarray(prior.translation, float))[1])
        return prior._replace(translation=moved, translation_sigma=prior.translation_sigma / self.size)

    def enter(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> tuple[Array, Array]:
        """Poses of the scene in this frame."""
        moved = (translation + rotation @ self.centre) / self.size
        return rotation.astype(np.float32), moved.astype(np.float32)

    def leave(self, rotation: Array, translation: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Poses of this frame in scene coordinates, in float64, their rotations orthogonal to its precision."""
        turn = Rotation.from_matrix(rotation.astype(np.float64)).as_matrix()
        return turn, translation.astype(np.float64) * self.size - turn @ self.centre

    def clusters(self, count: int) -> tuple[Array, Array, Array, Array]:
        """Bearings (3, k), their weights, points (3, l) and theirs."""
        f, a = _clusters(self.bearings, count, self.rng)
        p, b = _clusters(self.points3d, count, self.rng)
        f = f / np.linalg.norm(f, axis=-1, keepdims=True)
        return np.ascontiguousarray(f.T), a, np.ascontiguousarray(p.T), b


def degenerate(points: NDArray[np.float64]) -> bool:
    """Whether there are fewer than 4 points, or all of them lie in one place or on one line."""
    if len(points) < MIN_POINTS:
        return True
    values = np.linalg.svd(points - points.mean(0), compute_uv=False)
    extent = max(float(np.abs(points).max()), float(values[0]))
    return bool(values[0] <= 1e-9 * extent or values[1] <= FLAT * values[0])


def _is_near(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points are within FAR median distances of the median."""
    distance = np.linalg.norm(points - np.median(points, 0), axis=-1)
    return np.asarray(distance <= FAR * max(float(np.median(distance)), 1e-30))


def _clusters(points: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    if len(points) <= count:
        return points, np.ones(len(points), np.float32)
    sample = (
        points if len(points) <= SAMPLED * count else points[rng.choice(len(points), SAMPLED * count, replace=False)]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of empty clusters, which are left out below
        centres, label = kmeans2(
            sample, sample[rng.choice(len(sample), count, replace=False)], iter=ITERATIONS, minit="matrix"
        )
    weight = np.bincount(label, minlength=count).astype(np.float32) * np.float32(len(points) / len(sample))
    return centres[weight > 0].astype(np.float32), weight[weight > 0]
