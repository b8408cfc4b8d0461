"""SoftPOSIT as a solver of batches, from the paper's initial poses or from many random ones."""

from dataclasses import replace
from typing import Literal

from torch import Tensor

from bpnp.models.baselines.agreement import agreement
from bpnp.models.baselines.initial_poses import mean_pose, near_truth, random_poses
from bpnp.models.baselines.single_pairs import PairSolver, SinglePair, no_pose, one_pose, over
from bpnp.models.baselines.softposit.algorithm import softposit
from bpnp.types import Pose

Start = Literal["mean", "near_truth", "random"]
CHUNK = 2**22  # pairs of points, times initial poses, that are annealed together


class SoftPOSIT(PairSolver):
    """SoftPOSIT (David et al., IJCV 2004), a local solver: its result depends on its initial pose.

    Of several poses that under which most points have a partner is returned, an accepted one before one that is not.
    `residual` of the pose is the root mean square distance of the matched points in pixels.

    Args:
        start: mean, a fixed pose (the paper's start for ModelNet40: its mean pose); near_truth, the true pose disturbed
            (the paper's start for MegaDepth: not comparable with solvers that start blind); random, uniform rotations.
        mean_euler_deg: Euler angles x, y, z of the fixed pose, degrees.
        mean_translation: its translation, scene units.
        perturbation_deg: largest turn of the true pose.
        perturbation: its largest shift, scene units.
        starts: number of random starts.
        noise_px: standard deviation of the image points, pixels.
        focal: pixels per unit of the normalised image, for the constants of the annealing.
        beta_start: first weight of squared distances, 1/pixel^2.
        max_steps: most annealing steps; null for all.
        threshold: distance of partners in the normalised image, to choose between starts.
        seed: of the random starts and disturbances.
        time_limit: seconds per pair, after which the best pose so far is returned unconverged; null for none.
    """

    estimates = ("softposit",)

    def __init__(
        self,
        *,
        start: Start = "mean",
        mean_euler_deg: tuple[float, float, float] = (22.5, 22.5, 22.5),
        mean_translation: tuple[float, float, float] = (0.0, 0.0, 4.5),
        perturbation_deg: float = 10.0,
        perturbation: float = 0.5,
        starts: int = 64,
        noise_px: float = 2.0,
        focal: float = 800.0,
        beta_start: float = 4e-4,
        max_steps: int | None = None,
        threshold: float = 0.01,
        seed: int = 0,
        time_limit: float | None = 30.0,
    ) -> None:
        super().__init__(time_limit)
        if start not in ("mean", "near_truth", "random"):
            raise ValueError(f"expected `start` mean, near_truth or random, got {start!r}")
        self.start, self.starts, self.seed, self.threshold = start, starts, seed, threshold
        self.mean = mean_euler_deg, mean_translation
        self.perturbation = perturbation_deg, perturbation
        self.annealing = {"noise_px": noise_px, "focal": focal, "beta_start": beta_start, "max_steps": max_steps}

    def solve(self, pair: SinglePair, deadline: float) -> Pose:
        rotation, translation = self._initial_poses(pair)
        together = max(1, CHUNK // (len(pair.points2d) * len(pair.points3d)))
        best, most, finished = no_pose(pair.points3d), -1, True
        for turned, shift in zip(rotation.split(together), translation.split(together), strict=True):
            if over(deadline):
                finished = False
                break
            found = softposit(pair.points2d, pair.points3d, turned, shift, deadline=deadline, **self.annealing)  # type: ignore[arg-type]
            finished = finished and found.finished
            counts = agreement(
                pair.points2d, pair.points3d, found.rotation, found.translation, threshold=self.threshold
            )
            score = counts.points + found.accepted * (len(pair.points2d) + len(pair.points3d) + 1)
            i = int(score.argmax())
            if int(score[i]) > most:
                most, residual = int(score[i]), float(found.residual[i])
                best = one_pose(
                    found.rotation[i], found.translation[i], found.steps, residual, bool(found.accepted[i])
                )  # fmt: skip
        converged = best.stats.converged & finished
        return replace(best, stats=replace(best.stats, converged=converged))

    def _initial_poses(self, pair: SinglePair) -> tuple[Tensor, Tensor]:
        if self.start == "mean":
            return mean_pose(pair, *self.mean)
        if self.start == "near_truth":
            return near_truth(pair, *self.perturbation, self.seed)
        return random_poses(pair, self.starts, self.seed)
