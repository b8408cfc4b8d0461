"""The search on a batch: as a solver, and its poses as tensors."""

import math
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.checks import check_positive
from bpnp.geometry import bearings
from bpnp.runtime import Deadline, default_float_errors
from bpnp.search.find import search_poses
from bpnp.search.problem import Problem
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict.decide import SearchResult
from bpnp.types import Batch, Pose, Prediction, SolveStats


class Search(nn.Module):
    """`search_poses` as a solver. The prediction has the pose "search" and no assignment.

    Args:
        seed: Random seed of the initial poses, default 0.
        time_limit: Time limit for each problem in seconds, default 5. None for no limit.
        settings: Constants of the search.
    """

    estimates = ("search",)

    def __init__(self, *, seed: int = 0, time_limit: float | None = 5.0, settings: SearchSettings = DEFAULT) -> None:
        super().__init__()
        check_positive(time_limit=math.inf if time_limit is None else time_limit)
        self.seed, self.time_limit, self.settings = seed, time_limit, settings

    @default_float_errors
    def forward(self, batch: Batch) -> Prediction:
        """Return the pose "search" of each problem.

        Args:
            batch: Problems.
        """
        results = (
            (problem, search_poses(problem, seed=self.seed, deadline=self._deadline(), settings=self.settings))
            for problem in problems_of(batch)
        )
        return Prediction(poses={"search": best_poses(results, batch.points3d)})

    def _deadline(self) -> Deadline:
        return Deadline.after(self.time_limit)


def problems_of(batch: Batch) -> list[Problem]:
    """Return the real points of each sample, on the host.

    A result then depends neither on the other samples nor on padding.
    """
    rays = bearings(batch.points2d)
    return [
        Problem.of(on_host(rays[i, batch.mask2d[i]]), on_host(batch.points3d[i, batch.mask3d[i]]))
        for i in range(len(batch))
    ]


def best_poses(results: Iterable[tuple[Problem, SearchResult]], like: Tensor) -> Pose:
    """Return the best pose of each problem, without a gradient, on the device and in the dtype of `like`; NaN for none.

    In the stats, `iterations` counts batches of initial poses, `residual` is the scale of the residuals in radians, and
    `converged` is True for the verdict "confident".
    """
    solved = list(results)
    poses = [problem.to_user(*result.best) for problem, result in solved]
    rotation = torch.from_numpy(np.array([pose[0] for pose in poses]).reshape(-1, 3, 3)).to(like)
    translation = torch.from_numpy(np.array([pose[1] for pose in poses]).reshape(-1, 3)).to(like)
    stats = SolveStats(
        torch.tensor([result.iterations for _, result in solved], device=like.device, dtype=torch.int64),
        like.new_tensor([result.residual for _, result in solved]),
        torch.tensor([result.verdict == "confident" for _, result in solved], device=like.device, dtype=torch.bool),
    )
    return Pose(rotation, translation, stats)


def on_host(values: Tensor) -> NDArray[np.float64]:
    return values.detach().double().cpu().numpy()
