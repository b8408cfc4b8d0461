"""The search as a solver among the others: a `Batch` in, a `Prediction` out."""

from torch import nn

from bpnp.geometry import bearings
from bpnp.search.many import search
from bpnp.types import Batch, Pose, Prediction


class Search(nn.Module):
    """`search` as a solver: a `Batch` in, a `Prediction` with the pose "search" out. Nothing to train.

    Args:
        seed: of the starts.
        time_limit: seconds a pair; none for no limit.
        max_batches: batches of starts a pair, at most.
    """

    estimates = ("search",)

    def __init__(self, *, seed: int = 0, time_limit: float | None = None, max_batches: int = 32) -> None:
        super().__init__()
        self.seed, self.time_limit, self.max_batches = seed, time_limit, max_batches

    def forward(self, batch: Batch, *, poses: bool = True) -> Prediction:
        """Prediction with the estimate "search" and no assignment."""
        if not poses:
            return Prediction()
        pose = Pose(
            *search(
                bearings(batch.points2d), batch.points3d, mask2d=batch.mask2d, mask3d=batch.mask3d,
                seed=self.seed, time_limit=self.time_limit, max_batches=self.max_batches,
            )
        )  # fmt: skip
        return Prediction(poses={"search": pose})
