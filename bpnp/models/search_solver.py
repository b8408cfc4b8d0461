"""The search and the refinement over the samples of a batch, and the search as a solver."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.geometry import bearings
from bpnp.loops.parallel import Deadline
from bpnp.search.point_sets import PointSets
from bpnp.search.refine import refine_poses
from bpnp.search.search import search_poses
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict import SearchResult
from bpnp.types import Batch, Pose, Prediction, SolveStats


class Search(nn.Module):
    """`search_poses` as a solver: a `Batch` in, a `Prediction` with the pose "search" and no assignment out.

    Args:
        seed: of the starts.
        time_limit: seconds a problem, of which one that no pose explains may take all; none for no limit.
        settings: of the search.
    """

    estimates = ("search",)

    def __init__(self, *, seed: int = 0, time_limit: float | None = 5.0, settings: SearchSettings = DEFAULT) -> None:
        super().__init__()
        if time_limit is not None and not time_limit > 0:
            raise ValueError(f"expected a positive `time_limit` in seconds, got {time_limit}")
        self.seed, self.time_limit, self.settings = seed, time_limit, settings

    def forward(self, batch: Batch) -> Prediction:
        results = (
            search_poses(sets, seed=self.seed, deadline=Deadline.after(self.time_limit), settings=self.settings)
            for sets in point_sets(batch)
        )
        return Prediction(poses={"search": best_poses(results, batch.points3d)})


def refine(batch: Batch, rotation: Float[Tensor, "b s 3 3"], translation: Float[Tensor, "b s 3"]) -> Pose:
    """`refine_poses` from the s starts of each sample, NaN for one that is missing; iterations are starts annealed."""
    samples = zip(point_sets(batch), rotation, translation, strict=True)
    return best_poses((refine_poses(sets, _host(r), _host(t)) for sets, r, t in samples), batch.points3d)


def point_sets(batch: Batch) -> list[PointSets]:
    """The real points of each sample, on the host: its result depends neither on the other samples nor on padding."""
    rays = bearings(batch.points2d)
    return [
        PointSets(_host(rays[i, batch.mask2d[i]]), _host(batch.points3d[i, batch.mask3d[i]])) for i in range(len(batch))
    ]


def best_poses(results: Iterable[SearchResult], like: Tensor) -> Pose:
    """The best pose of each result, on the device of `like` and of its dtype, without a gradient; NaN where none is.

    In the stats, iterations are batches of starts, residual is the scale of the residuals in radians, and converged
    says that the verdict is "confident".
    """
    results = list(results)
    rotation = torch.tensor(np.array([result.best[0] for result in results]).reshape(-1, 3, 3)).to(like)
    translation = torch.tensor(np.array([result.best[1] for result in results]).reshape(-1, 3)).to(like)
    stats = SolveStats(
        torch.tensor([result.batches for result in results], device=like.device, dtype=torch.int64),
        torch.tensor([result.residual for result in results]).to(like),
        torch.tensor([result.verdict == "confident" for result in results], device=like.device, dtype=torch.bool),
    )
    return Pose(rotation, translation, stats)


def _host(values: Tensor) -> NDArray[np.float64]:
    return values.detach().double().cpu().numpy()
