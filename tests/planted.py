"""Planted problems: point sets whose pose and correspondences are known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from bpnp.geometry import bearings, project, random_rotations, retract, transform
from bpnp.types import Batch, Pose, Prediction, SolveStats


@dataclass(frozen=True)
class Planted:
    """b pairs of m 2D and n 3D points; `match3d` (b, n) is the 2D point of each 3D point, -1 for none."""

    points2d: Tensor
    points3d: Tensor
    rotation: Tensor
    translation: Tensor
    match3d: Tensor

    @property
    def pose(self) -> tuple[Tensor, Tensor]:
        return self.rotation, self.translation

    @property
    def bearings(self) -> Tensor:
        return bearings(self.points2d)

    def permutation(self) -> Tensor:
        """The true assignment, (b, m, n), sum one."""
        index = torch.arange(self.points2d.shape[1]).unsqueeze(-1)
        correct = (index == self.match3d.unsqueeze(1)).to(self.points2d.dtype)
        return correct / correct.sum((-2, -1), keepdim=True)

    def diffuse(self, scale: float) -> Tensor:
        """exp(-|x - project(R p + t)|^2 / 2 scale^2) over all pairs, sum one."""
        seen = project(transform(self.rotation, self.translation, self.points3d))
        weights = torch.exp(-((self.points2d.unsqueeze(2) - seen.unsqueeze(1)) ** 2).sum(-1) / (2 * scale**2))
        return weights / weights.sum((-2, -1), keepdim=True)

    def near(self, amount: float, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """A pose `amount` radians off the true one, and about as many scene units."""
        generator = torch.Generator().manual_seed(seed)
        turn, shift = (_normal(generator, len(self.rotation), 3).to(self.rotation.dtype) for _ in range(2))
        turn = torch.nn.functional.normalize(turn, dim=-1)
        return retract(amount * torch.cat([turn, shift], -1), self.rotation, self.translation)

    def batch(self) -> Batch:
        return Batch.from_arrays(self.points2d, self.points3d, self.rotation, self.translation, self.match3d)


def posed(rotation: Tensor, translation: Tensor, converged: list[bool] | None = None) -> Pose:
    """A pose (b, 3, 3), (b, 3) as a solver gives it, after one iteration and by default converged everywhere."""
    b = len(rotation)
    found = torch.ones(b, dtype=torch.bool) if converged is None else torch.tensor(converged)
    return Pose(rotation, translation, SolveStats(torch.ones(b, dtype=torch.long), torch.zeros(b), found))


class Answering(torch.nn.Module):
    """A network that always has the same pose, in the axes of `frame`, and keeps the batches that it was given."""

    def __init__(self, rotation: Any, translation: Any, frame: str = "any") -> None:
        super().__init__()
        self.frame, self.batches = frame, list[Batch]()
        self.pose = posed(torch.as_tensor(rotation)[None], torch.as_tensor(translation)[None])

    def forward(self, batch: Batch) -> Prediction:
        self.batches.append(batch)
        return Prediction(poses={"fixed": self.pose})


def padded(scenes: Sequence[Planted | Batch]) -> Batch:
    """The first pair of each, of different sizes, padded to the largest."""
    fields = ("points2d", "points3d", "rotation", "translation", "match3d")
    return Batch.from_arrays(*([getattr(scene, name)[0] for scene in scenes] for name in fields))


def plant(
    size: int,
    points: int,
    *,
    seed: int = 0,
    noise: float = 0.0,
    outliers2d: int = 0,
    outliers3d: int = 0,
    dtype: torch.dtype = torch.float64,
) -> Planted:
    """`size` scenes of `points` normally distributed points, 4 to 6 units in front of a camera of any rotation.

    The image points are shuffled and disturbed by normal `noise`; the outliers of each side have no match.
    """
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(size, generator)
    points3d = 0.7 * _normal(generator, size, points + outliers3d, 3).clamp(-2, 2)
    translation = torch.rand(size, 3, generator=generator, dtype=torch.float64) - 0.5
    translation[:, 2] += 5
    camera = transform(rotation, translation, points3d[:, :points])
    clutter = 0.2 * _normal(generator, size, outliers2d, 2)
    points2d = torch.cat([project(camera) + noise * _normal(generator, size, points, 2), clutter], 1)
    order = torch.rand(size, points2d.shape[1], generator=generator).argsort(-1)
    points2d = points2d.gather(1, order.unsqueeze(-1).expand_as(points2d))
    match3d = torch.full((size, points + outliers3d), -1)
    match3d[:, :points] = order.argsort(-1)[:, :points]
    return Planted(points2d.to(dtype), points3d.to(dtype), rotation.to(dtype), translation.to(dtype), match3d)


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def directions(points: Any) -> Any:
    """Unit vectors along points (..., 3)."""
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def seen(points: Any, rotation: Any, translation: Any) -> NDArray[np.float64]:
    """Normalised image coordinates (n, 2) of points (n, 3)."""
    camera = points @ rotation.T + translation
    return np.asarray(camera[:, :2] / camera[:, 2:])


def view_with_outliers(
    rng: np.random.Generator, true: int, outliers: int, *, noise: float = 1e-3, frame: float = 0.4
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Bearings, points, rotation and translation; the first `true` of both are pairs with noise (radians about), and as
    many outliers of each fill the frame, of this half width and three quarters of it high."""
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.2, 5.0])
    half = frame * np.array([1.0, 0.75])
    plane = rng.uniform(-half, half, (true + 2 * outliers, 2))
    depth = rng.uniform(3.5, 6.5, (len(plane), 1))
    points = (np.column_stack([plane, np.ones(len(plane))]) * depth - translation) @ rotation
    bearings = directions(np.column_stack([plane + noise * rng.standard_normal(plane.shape), np.ones(len(plane))]))
    image, scene = np.r_[:true, true : true + outliers], np.r_[:true, true + outliers : len(points)]
    return bearings[image], points[scene], rotation, translation


def degrees_between(one: Any, other: Any) -> float:
    """Angle between two rotations (3, 3)."""
    return math.degrees(Rotation.from_matrix(one @ other.T).magnitude())
