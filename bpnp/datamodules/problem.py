"""Problem, one set of image points and one of scene points; sources of problems; and how problems become a batch."""

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
    """Image points and scene points of one problem; see `bpnp.types` for the conventions.

    The first `matched` points of both sides are the matches, in the same order. The other points have no
    correspondence. `bpnp.search.problem.Problem` is one to search, without true matches and pose.

    Attributes:
        name: Name.
        points2d: Normalised image coordinates (m, 2).
        points3d: Scene points (n, 3), scene units.
        matched: Number of matches.
        rotation: True R (3, 3), camera = R p + t.
        translation: True t (3,), scene units.
        focal: Pixels per unit of normalised coordinates.
        origin: Vector that was subtracted from the scene's coordinates (3,), for coordinates so large that float32
            would lose digits. Default: None, nothing was subtracted.
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
        """Make a problem from two point sets in any order.

        Args:
            name: Name.
            points2d: Normalised image coordinates (m, 2).
            points3d: Scene points (n, 3), scene units.
            rotation: True R (3, 3), camera = R p + t.
            translation: True t (3,), scene units.
            match3d: Index of the 2D point of each 3D point (n,), -1 for none.
            focal: Pixels per unit of normalised coordinates.
            origin: Vector that was subtracted from the scene's coordinates (3,). Default: None, nothing was subtracted.

        Returns:
            The problem, with the matched points first on both sides.

        Raises:
            ValueError: Shapes do not fit, a value is NaN or infinite, or `match3d` holds no integers, an index that is
                no 2D point, or one 2D point twice.
        """
        which = repr(name)
        set2d = check_points("points2d", which, as_tensor("points2d", points2d), 2).numpy()
        set3d = check_points("points3d", which, as_tensor("points3d", points3d), 3).numpy()
        match = check_match3d(which, as_tensor("match3d", match3d), len(set2d), len(set3d)).numpy()
        origins = () if origin is None else (origin,)
        if not all(np.isfinite(values).all() for values in (rotation, translation, focal, *origins)):
            raise ValueError(f"the pose, focal length or origin of problem {which} holds NaN or infinity")
        matched3d = np.flatnonzero(match >= 0)
        matched2d = match[matched3d]
        if len(np.unique(matched2d)) < len(matched2d):
            raise ValueError(f"`match3d` of {which} assigns one 2D point to two 3D points")
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
    """Numbers of points of the problems of a source."""

    matched: NDArray[np.int64]  # matches (k,)
    points2d: NDArray[np.int64]  # 2D points (k,)
    points3d: NDArray[np.int64]  # 3D points (k,)


@runtime_checkable
class ProblemSource(Protocol):
    """Indexed set of problems, before augmentation."""

    @property
    def counts(self) -> Counts:
        """Numbers of points of each problem."""

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Return problems from `stack_problems`, each a function of its index, the epoch and the seed of the source.

        Args:
            index: Indices of the problems (b,).
            epoch: Epoch, for problems that change from epoch to epoch.
        """


def stack_problems(problems: Sequence[Problem], index: Int[Tensor, " b"]) -> Batch:
    """Pad and mask problems. 3D point j of the batch corresponds to 2D point j, or to none (match3d -1).

    Points are float32, poses float64.
    """
    indices = [np.arange(len(problem.points3d)) for problem in problems]
    batch = Batch.from_arrays(
        [problem.points2d for problem in problems],
        [problem.points3d for problem in problems],
        match3d=[np.where(j < problem.matched, j, -1) for j, problem in zip(indices, problems, strict=True)],
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
