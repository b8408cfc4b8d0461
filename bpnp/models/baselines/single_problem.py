"""Shared parts of the baselines: one problem at a time, in float64, within a time limit; and inlier counts."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from bpnp.checks import check_positive
from bpnp.geometry import project, transform
from bpnp.poses import MIN_POINTS
from bpnp.runtime import Deadline
from bpnp.types import Batch, Pose, Prediction, SolveStats

CHUNK = 2**22  # distances computed at a time, in float32


class SingleProblem(NamedTuple):
    """Real points of one problem, its `Batch.index`, and its true pose if known."""

    points2d: Float[Tensor, "m 2"]  # normalised image coordinates
    points3d: Float[Tensor, "n 3"]  # scene points
    number: int  # `Batch.index` of the problem
    rotation: Float[Tensor, "3 3"] | None  # true R, None if unknown
    translation: Float[Tensor, "3"] | None  # true t, None if unknown

    def seed(self, seed: int) -> int:
        """Return the seed of the problem's random numbers, which does not depend on its batch."""
        mixed = torch.Generator().manual_seed(seed)
        return int(torch.randint(2**31, (1,), generator=mixed)) * 1_000_003 + self.number


class Answer(NamedTuple):
    """Pose of one problem, None if there is none, and the fields of `SolveStats`."""

    pose: tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]] | None = None
    iterations: int = 0
    residual: float = math.inf
    converged: bool = False


class SingleSolver(nn.Module):
    """Base of solvers of one problem at a time. Subclasses implement `solve` and name their one estimate.

    The pose of a problem depends neither on other problems nor on padding. A problem with fewer than 4 points on a side
    has no pose.

    Args:
        time_limit: Seconds for each problem, None for no limit.
    """

    estimates: tuple[str, ...]

    def __init__(self, time_limit: float | None) -> None:
        super().__init__()
        check_positive(time_limit=math.inf if time_limit is None else time_limit)
        self.time_limit = time_limit

    def forward(self, batch: Batch) -> Prediction:
        """Solve the problems of a batch one after the other.

        Args:
            batch: Problems.

        Returns:
            Prediction with the one pose of the solver, NaN where it found none, and no assignment.
        """
        like, answers = batch.points3d, []
        # A local optimiser needs gradients, which the trainer's inference mode forbids.
        with torch.inference_mode(False), torch.no_grad():
            for i, number in enumerate(batch.index.tolist()):
                sides = batch.points2d[i][batch.mask2d[i]], batch.points3d[i][batch.mask3d[i]]
                points2d, points3d = (side.double().clone() for side in sides)
                rotation, translation = (
                    x if x is None else x[i].double().clone() for x in (batch.rotation, batch.translation)
                )
                problem = SingleProblem(points2d, points3d, number, rotation, translation)
                enough = min(len(points2d), len(points3d)) >= MIN_POINTS
                answers.append(self.solve(problem, Deadline.after(self.time_limit)) if enough else Answer())
            missing = like.new_full((3, 3), math.nan), like.new_full((3,), math.nan)
            poses = zip(*(answer.pose or missing for answer in answers), strict=True)
            rotation, translation = (torch.stack([value.to(like) for value in values]) for values in poses)
            columns = zip(*(a[1:] for a in answers), strict=True)
            stats = SolveStats(*(torch.tensor(values, device=like.device) for values in columns))
            return Prediction(poses={self.estimates[0]: Pose(rotation, translation, stats.to(like))})

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        """Return the pose of one problem.

        Args:
            problem: Problem with at least 4 points on each side.
            deadline: Time at which to return the best pose so far.
        """
        raise NotImplementedError


def weak_perspective_distance(points2d: Tensor, points3d: Tensor) -> float:
    """Return the distance at which the scene looks as large as the image: the ratio of their root mean square radii.

    Averaged over rotations, the image shows two of the scene's three axes; hence the factor sqrt(2/3). Image points (m,
    2) are normalised; the distance is in the unit of the scene points (n, 3).
    """
    image, scene = ((points - points.mean(0)).square().sum(-1).mean().sqrt() for points in (points2d, points3d))
    return float(math.sqrt(2 / 3) * scene / image.clamp_min(1e-12))


def agreement(
    points2d: Float[Tensor, "m 2"],
    points3d: Float[Tensor, "n 3"],
    rotation: Float[Tensor, "h 3 3"],
    translation: Float[Tensor, "h 3"],
    *,
    threshold: float,
) -> Int[Tensor, "2 h"]:
    """Count the points of each side that have a point of the other side within `threshold`, for each pose.

    The threshold is a distance in the normalised image. The smaller count bounds the number of one-to-one matches. A 3D
    point behind the camera has no such point, and no point has one under a pose that is NaN. The counts are of image
    points, then of scene points.
    """
    part = max(1, CHUNK // (len(points2d) * len(points3d)))
    x, y = points2d.float().unsqueeze(-1).unbind(1)
    counts = []
    for some_r, some_t in zip(rotation.split(part), translation.split(part), strict=True):
        camera = transform(some_r, some_t, points3d.expand(len(some_r), -1, -1))
        image = torch.where(camera[..., 2:] > 0, project(camera), torch.inf).nan_to_num(torch.inf).float()
        squared = (image[:, None, :, 0] - x).square_()
        squared += (image[:, None, :, 1] - y).square_()
        counts.append(torch.stack([(squared.amin(axis) < threshold**2).sum(-1) for axis in (2, 1)]))
    return torch.cat(counts, 1)
