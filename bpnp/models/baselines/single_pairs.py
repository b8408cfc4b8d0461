"""What the baselines share: each pair of a batch is solved by itself, in float64, within a limit of time."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.geometry import MIN_POINTS
from bpnp.types import Batch, Pose, Prediction, SolveStats


@dataclass(frozen=True)
class SinglePair:
    """The real points of one pair, on the batch's device, and its true pose where it is known."""

    points2d: Float[Tensor, "m 2"]
    points3d: Float[Tensor, "n 3"]
    index: int
    rotation: Float[Tensor, "3 3"] | None = None
    translation: Float[Tensor, "3"] | None = None


@dataclass(frozen=True)
class Found:
    """A pose camera = R p + t with the numbers of its `SolveStats`; NaN for no pose."""

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    iterations: int
    residual: float
    converged: bool


class Clock:
    """A limit of time; None for none, so that nothing depends on the machine's speed."""

    def __init__(self, seconds: float | None) -> None:
        self.end = math.inf if seconds is None else time.monotonic() + seconds

    def over(self) -> bool:
        return time.monotonic() >= self.end


class PairSolver(nn.Module):
    """A solver of single pairs: subclasses implement `solve` and name their one estimate.

    A pair's pose depends neither on the other pairs nor on padding. A side with fewer than 4 points has no pose.
    """

    estimates: tuple[str, ...]

    def __init__(self, time_limit: float | None) -> None:
        super().__init__()
        if time_limit is not None and not time_limit > 0:
            raise ValueError(f"expected `time_limit` > 0 seconds, got {time_limit}; try 30, or none for no limit")
        self.time_limit = time_limit

    def forward(self, batch: Batch) -> Prediction:
        # The trainer's inference mode would forbid a local optimiser's gradients.
        with torch.inference_mode(False), torch.no_grad():
            found = [self._solve(pair) for pair in _pairs(batch)]
            return Prediction(poses={self.estimates[0]: _collect(found, batch)})

    def solve(self, pair: SinglePair, clock: Clock) -> Found:
        raise NotImplementedError

    def _solve(self, pair: SinglePair) -> Found:
        if min(len(pair.points2d), len(pair.points3d)) < MIN_POINTS:
            return no_pose(pair.points3d)
        return self.solve(pair, Clock(self.time_limit))


def no_pose(like: Tensor, iterations: int = 0) -> Found:
    return Found(like.new_full((3, 3), math.nan), like.new_full((3,), math.nan), iterations, math.inf, False)


def generator_for(seed: int, index: int) -> torch.Generator:
    """Random numbers of one pair, whatever batch it is in."""
    mixed = torch.Generator().manual_seed(seed)
    first = int(torch.randint(2**31, (1,), generator=mixed))
    return torch.Generator().manual_seed(first * 1_000_003 + index)


def _pairs(batch: Batch) -> Iterator[SinglePair]:
    for i, index in enumerate(batch.index.tolist()):
        yield SinglePair(
            batch.points2d[i][batch.mask2d[i]].double().clone(),
            batch.points3d[i][batch.mask3d[i]].double().clone(),
            index,
            None if batch.rotation is None else batch.rotation[i].double().clone(),
            None if batch.translation is None else batch.translation[i].double().clone(),
        )


def _collect(found: list[Found], batch: Batch) -> Pose:
    device = batch.points3d.device
    stats = SolveStats(
        torch.tensor([each.iterations for each in found], device=device),
        torch.tensor([each.residual for each in found], dtype=batch.points3d.dtype, device=device),
        torch.tensor([each.converged for each in found], device=device),
    )
    rotation = torch.stack([each.rotation for each in found]).to(batch.points3d)
    translation = torch.stack([each.translation for each in found]).to(batch.points3d)
    return Pose(rotation, translation, stats)
