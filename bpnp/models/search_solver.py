"""The search and the refinement over the samples of a batch, and the search as a solver."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.compilation import Deadline
from bpnp.geometry import bearings as bearings_of
from bpnp.search.many import search_poses
from bpnp.search.point_sets import PointSets
from bpnp.search.refine import refine_poses
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import Prior
from bpnp.search.verdict import SearchResult
from bpnp.types import Batch, Pose, Prediction, SolveStats

Found = tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]


def search(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    prior: Prior | None = None,
    time_limit: float | None = None,
    **options: Any,
) -> Found:
    """`search_poses` with its other `options` for each sample: rotation, translation and stats of the best pose.

    time_limit: seconds a sample. In the stats, iterations are batches of starts, residual is the scale of the residuals
    in radians, and converged says that the verdict is "confident". A sample without a pose holds NaN. Not
    differentiable; runs on the host's cores. A sample's result depends neither on the others nor on padding.
    Raises ValueError for `time_limit` or `clutter` out of range.
    """
    if time_limit is not None and not time_limit > 0:
        raise ValueError(f"expected a positive `time_limit` in seconds, got {time_limit}")
    results = (
        search_poses(PointSets(f, p, prior=prior), deadline=Deadline.after(time_limit), **options)
        for f, p in _samples(bearings, points3d, mask2d, mask3d)
    )
    return _best(results, points3d)


def refine(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b s 3 3"],
    translation: Float[Tensor, "b s 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
) -> Found:
    """`refine_poses` from the s starts of each sample, NaN for one that is missing: as `search`.

    In the stats, iterations are the starts that were annealed.
    """
    samples = zip(_samples(bearings, points3d, mask2d, mask3d), rotation, translation, strict=True)
    return _best((refine_poses(PointSets(f, p), _host(r), _host(t)) for (f, p), r, t in samples), points3d)


def _samples(
    bearings: Tensor, points3d: Tensor, mask2d: Tensor | None, mask3d: Tensor | None
) -> Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The real points of each sample."""
    for i, (f, p) in enumerate(zip(bearings, points3d, strict=True)):
        yield _host(f if mask2d is None else f[mask2d[i]]), _host(p if mask3d is None else p[mask3d[i]])


def _best(results: Iterable[SearchResult], like: Tensor) -> Found:
    """The best pose of each result, on the device of `like` and of its dtype."""
    found = list(results)
    rotation = torch.tensor(np.array([result.best[0] for result in found]).reshape(-1, 3, 3)).to(like)
    translation = torch.tensor(np.array([result.best[1] for result in found]).reshape(-1, 3)).to(like)
    stats = SolveStats(
        torch.tensor([result.batches for result in found], device=like.device, dtype=torch.int64),
        torch.tensor([result.residual for result in found]).to(like),
        torch.tensor([result.verdict == "confident" for result in found], device=like.device, dtype=torch.bool),
    )
    return rotation, translation, stats


def _host(values: Tensor) -> NDArray[np.float64]:
    return values.detach().double().cpu().numpy()


class Search(nn.Module):
    """`search` as a solver: a `Batch` in, a `Prediction` with the pose "search" and no assignment out.

    Args:
        seed: of the starts.
        time_limit: seconds a pair; none for no limit.
        settings: of the search.
    """

    estimates = ("search",)

    def __init__(
        self, *, seed: int = 0, time_limit: float | None = None, settings: SearchSettings = DEFAULT
    ) -> None:  # fmt: skip
        super().__init__()
        self.seed, self.time_limit, self.settings = seed, time_limit, settings

    def forward(self, batch: Batch) -> Prediction:
        rotation, translation, stats = search(
            bearings_of(batch.points2d), batch.points3d, mask2d=batch.mask2d, mask3d=batch.mask3d, seed=self.seed,
            time_limit=self.time_limit, settings=self.settings,
        )  # fmt: skip
        return Prediction(poses={"search": Pose(rotation, translation, stats)})
