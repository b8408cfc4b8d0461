"""SoftPOSIT as a solver of batches, from the paper's initial poses or from many random ones."""

from typing import Literal

from torch import Tensor

from bpnp.models.baselines.agreement import agreement
from bpnp.models.baselines.initial_poses import mean_pose, near_truth, random_poses
from bpnp.models.baselines.single_pairs import Answer, PairSolver, SinglePair, over
from bpnp.models.baselines.softposit.algorithm import softposit

Start = Literal["mean", "near_truth", "random"]
CHUNK = 2**22  # pairs of points, times initial poses, that are annealed together
THRESHOLD = 0.01  # distance of partners in the normalised image, to choose between starts


class SoftPOSIT(PairSolver):
    """SoftPOSIT (David et al., IJCV 2004), a local solver: its result depends on its initial pose.

    Of several poses that under which most points have a partner is returned, an accepted one before one that is not.
    `residual` of the pose is the root mean square distance of the matched points in pixels.

    Args:
        start: mean, a fixed pose (the paper's start for ModelNet40: its mean pose); near_truth, the true pose disturbed
            (the paper's start for MegaDepth: not comparable with solvers that start blind); random, uniform rotations.
        starts: number of random starts.
        max_steps: most annealing steps; null for all.
        seed: of the random starts and disturbances.
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("softposit",)

    def __init__(
        self,
        *,
        start: Start = "mean",
        starts: int = 64,
        max_steps: int | None = None,
        seed: int = 0,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        if start not in ("mean", "near_truth", "random"):
            raise ValueError(f"expected `start` mean, near_truth or random, got {start!r}")
        self.start, self.starts, self.seed, self.max_steps = start, starts, seed, max_steps

    def solve(self, pair: SinglePair, deadline: float) -> Answer:
        rotation, translation = self._initial_poses(pair)
        together = max(1, CHUNK // (len(pair.points2d) * len(pair.points3d)))
        best, most, finished = Answer(), -1, True
        for turned, shift in zip(rotation.split(together), translation.split(together), strict=True):
            if over(deadline):
                finished = False
                break
            points = pair.points2d, pair.points3d
            found = softposit(*points, turned, shift, max_steps=self.max_steps, deadline=deadline)
            finished = finished and found.finished
            counts = agreement(*points, found.rotation, found.translation, threshold=THRESHOLD)
            score = counts.points + found.accepted * (len(pair.points2d) + len(pair.points3d) + 1)
            i = int(score.argmax())
            if int(score[i]) > most:
                most, pose = int(score[i]), (found.rotation[i], found.translation[i])
                best = Answer(pose, found.steps, float(found.residual[i]), bool(found.accepted[i]))
        return best._replace(converged=best.converged and finished)

    def _initial_poses(self, pair: SinglePair) -> tuple[Tensor, Tensor]:
        if self.start == "mean":
            return mean_pose(pair)
        if self.start == "near_truth":
            return near_truth(pair, self.seed)
        return random_poses(pair, self.starts, self.seed)
