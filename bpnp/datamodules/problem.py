"""A problem, one set of image points and one of scene points, as a source gives it; and how problems become a batch."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.checks import as_tensor, check_match3d, check_points
from bpnp.types import Batch


@dataclass(frozen=True)
class Problem:
    """One image's points and the scene's points; see `bpnp.types` for the conventions.

    points2d (m, 2) normalised, points3d (n, 3), rotation (3, 3), translation (3,), focal pixels per unit of normalised
    coordinates. The first `matched` points of both sides are the matches, in the same order; the others have no
    partner. origin (3,): what was subtracted from the scene's coordinates, for scenes so far from theirs that float32
    would lose digits; None for nothing.
    """

    name: str
    points2d: NDArray[np.float32]
    points3d: NDArray[np.float32]
    matched: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    focal: float
    origin: NDArray[np.float64] | None = None

    @classmethod
    def from_matches(
        cls,
        name: str,
        points2d: NDArray[np.floating],
        points3d: NDArray[np.floating],
        rotation: NDArray[np.floating],
        translation: NDArray[np.floating],
        match3d: NDArray[np.integer],
        focal: float,
        origin: NDArray[np.float64] | None = None,
    ) -> "Problem":
        """The problem of two sets in any order; match3d (n,) is the 2D point of each 3D point, -1 for none.

        Raises ValueError that names the problem: shapes that do not fit, NaN or infinity, or a match3d that holds no
        integers, an index that is no 2D point, or one 2D point twice.
        """
        which = repr(name)
        set2d = check_points("points2d", which, as_tensor("points2d", points2d), 2).numpy()
        set3d = check_points("points3d", which, as_tensor("points3d", points3d), 3).numpy()
        match = check_match3d(which, as_tensor("match3d", match3d), len(set2d), len(set3d)).numpy()
        origins = () if origin is None else (origin,)
        if not all(np.isfinite(values).all() for values in (rotation, translation, focal, *origins)):
            raise ValueError(f"expected a finite pose, focal and origin, got NaN or infinity in problem {which}")
        matched3d = np.flatnonzero(match >= 0)
        matched2d = match[matched3d]
        if len(np.unique(matched2d)) < len(matched2d):
            raise ValueError(f"expected at most one 3D point for each 2D point, got two in `match3d` of {which}")
        return cls(
            name,
            set2d[np.concatenate([matched2d, np.setdiff1d(np.arange(len(set2d)), matched2d)])].astype(np.float32),
            set3d[np.concatenate([matched3d, np.flatnonzero(match < 0)])].astype(np.float32),
            len(matched3d),
            np.asarray(rotation, np.float64),
            np.asarray(translation, np.float64),
            focal,
            origin,
        )


class Counts(NamedTuple):
    """Matches, 2D points and 3D points of each problem of a source (k,)."""

    matched: NDArray[np.int64]
    points2d: NDArray[np.int64]
    points3d: NDArray[np.int64]


@runtime_checkable
class ProblemSource(Protocol):
    """An indexed set of problems, before their augmentation."""

    @property
    def counts(self) -> Counts:
        """Points of each problem."""

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Problems as `stack_problems` makes them: each a function of its index, the epoch and the source's seed."""


def stack_problems(problems: Sequence[Problem], index: Int[Tensor, " b"]) -> Batch:
    """Pad and mask problems: 3D point j of the batch was seen as 2D point j, or (match3d -1) not at all.

    Points are float32, poses float64.
    """
    places = [np.arange(len(problem.points3d)) for problem in problems]
    batch = Batch.from_arrays(
        [problem.points2d for problem in problems],
        [problem.points3d for problem in problems],
        match3d=[np.where(j < problem.matched, j, -1) for j, problem in zip(places, problems, strict=True)],
        focal=[problem.focal for problem in problems],
        index=index.tolist(),
        ids=[problem.name for problem in problems],
    )
    poses = [(problem.rotation, problem.translation, problem.origin) for problem in problems]
    rotation, translation, origin = (
        torch.tensor(np.array([np.zeros(3) if value is None else value for value in values]))
        for values in zip(*poses, strict=True)
    )
    return replace(batch, rotation=rotation, translation=translation, origin=origin)
