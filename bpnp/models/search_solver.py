"""The search and the refinement over the samples of a batch, as functions of tensors and as modules."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.geometry import bearings as bearings_of
from bpnp.search.annealing import Deadline
from bpnp.search.many import search_poses
from bpnp.search.point_sets import PointSets
from bpnp.search.refine import refine_poses
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.starts import Prior
from bpnp.search.verdict import SearchResult
from bpnp.types import Batch, Pose, Prediction, SolveStats

Array = NDArray[np.float64]
Found = tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]


def search(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    prior: Prior | None = None,
    clutter: float | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    settings: SearchSettings = DEFAULT,
) -> Found:
    """`search_poses` for each sample: rotation, translation and stats of the best pose.

    time_limit: seconds a sample. In the stats, iterations are batches of starts, residual is the scale of the residuals
    in radians, and converged says that the verdict is "confident". A sample without a pose holds NaN. Not
    differentiable; runs on the host's cores. A sample's result depends neither on the others nor on padding.
    Raises ValueError for `time_limit` or `clutter` out of range.
    """
    if time_limit is not None and not time_limit > 0:
        raise ValueError(f"expected a positive `time_limit` in seconds, got {time_limit}")

    def one(_: int, f: Array, p: Array) -> SearchResult:
        return search_poses(
            PointSets(f, p, prior=prior), clutter=clutter, seed=seed, deadline=Deadline.after(time_limit),
            settings=settings,
        )  # fmt: skip

    return _each(one, bearings, points3d, mask2d, mask3d)


def refine(
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b s 3 3"],
    translation: Float[Tensor, "b s 3"],
    *,
    mask2d: Bool[Tensor, "b m"] | None = None,
    mask3d: Bool[Tensor, "b n"] | None = None,
    outliers: float | None = None,
    seed: int = 0,
    settings: SearchSettings = DEFAULT,
) -> Found:
    """`refine_poses` from the s starts of each sample, NaN for one that is missing: as `search`.

    In the stats, iterations are the starts that were annealed.
    """

    def one(i: int, f: Array, p: Array) -> SearchResult:
        starts = _host(rotation[i]), _host(translation[i])
        return refine_poses(PointSets(f, p), *starts, outliers=outliers, seed=seed, settings=settings)

    return _each(one, bearings, points3d, mask2d, mask3d)


def _each(
    solve: Callable[[int, Array, Array], SearchResult],
    bearings: Tensor,
    points3d: Tensor,
    mask2d: Tensor | None,
    mask3d: Tensor | None,
) -> Found:
    """The best pose of each sample's real points."""
    found = []
    for i in range(len(bearings)):
        f = bearings[i] if mask2d is None else bearings[i][mask2d[i]]
        p = points3d[i] if mask3d is None else points3d[i][mask3d[i]]
        found.append(solve(i, _host(f), _host(p)))
    device = points3d.device
    rotation = np.stack([result.best[0] for result in found]) if found else np.empty((0, 3, 3))
    translation = np.stack([result.best[1] for result in found]) if found else np.empty((0, 3))
    stats = SolveStats(
        torch.tensor([result.batches for result in found], device=device, dtype=torch.int64),
        torch.tensor([result.residual for result in found]).to(points3d),
        torch.tensor([result.verdict == "confident" for result in found], device=device, dtype=torch.bool),
    )
    return torch.as_tensor(rotation).to(points3d), torch.as_tensor(translation).to(points3d), stats


def _host(values: Tensor) -> Array:
    return values.detach().double().cpu().numpy()


class Search(nn.Module):
    """`search` as a solver: a `Batch` in, a `Prediction` with the pose "search" out. Nothing to train.

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
        """Prediction with the estimate "search" and no assignment."""
        pose = Pose(
            *search(
                bearings_of(batch.points2d), batch.points3d, mask2d=batch.mask2d, mask3d=batch.mask3d,
                seed=self.seed, time_limit=self.time_limit, settings=self.settings,
            )
        )  # fmt: skip
        return Prediction(poses={"search": pose})


class Refine(nn.Module):
    """`refine` with its options as a module; see `refine_poses`."""

    def __init__(
        self, *, outliers: float | None = None, seed: int = 0, settings: SearchSettings = DEFAULT
    ) -> None:  # fmt: skip
        super().__init__()
        self.outliers, self.seed, self.settings = outliers, seed, settings

    def forward(
        self,
        bearings: Float[Tensor, "b m 3"],
        points3d: Float[Tensor, "b n 3"],
        rotation: Float[Tensor, "b s 3 3"],
        translation: Float[Tensor, "b s 3"],
        mask2d: Bool[Tensor, "b m"] | None = None,
        mask3d: Bool[Tensor, "b n"] | None = None,
    ) -> Found:
        return refine(
            bearings, points3d, rotation, translation, mask2d=mask2d, mask3d=mask3d, outliers=self.outliers,
            seed=self.seed, settings=self.settings,
        )  # fmt: skip
