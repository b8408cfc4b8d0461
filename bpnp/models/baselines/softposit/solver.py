"""SoftPOSIT as a solver of batches, from the paper's starts or from many random ones."""

from typing import Literal

from torch import Tensor

from bpnp.models.baselines.agreement import agreement
from bpnp.models.baselines.single_pairs import Clock, Found, PairSolver, SinglePair, no_pose
from bpnp.models.baselines.softposit.algorithm import Annealed, softposit
from bpnp.models.baselines.starts import anywhere, mean_pose, near_truth

Start = Literal["mean", "near_truth", "random"]
CELLS = 2**22  # pairs of points of all starts that are annealed together


class SoftPOSIT(PairSolver):
    """SoftPOSIT (David et al., IJCV 2004): local, so that its start decides.

    Of several starts the pose with the most points near a partner wins, an accepted one before one that is not.
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

    def solve(self, pair: SinglePair, clock: Clock) -> Found:
        rotation, translation = self._begin(pair)
        together = max(1, CELLS // (len(pair.points2d) * len(pair.points3d)))
        best, best_score = no_pose(pair.points3d), -1.0
        finished = True
        for turned, shift in zip(rotation.split(together), translation.split(together), strict=True):
            if clock.over():
                finished = False
                break
            annealed = softposit(pair.points2d, pair.points3d, turned, shift, clock=clock, **self.annealing)  # type: ignore[arg-type]
            finished = finished and annealed.finished
            score = self._score(pair, annealed)
            i = int(score.argmax())
            if float(score[i]) > best_score:
                best_score, best = float(score[i]), _found(annealed, i)
        return best if finished else _unconverged(best)

    def _begin(self, pair: SinglePair) -> tuple[Tensor, Tensor]:
        if self.start == "mean":
            return mean_pose(pair, *self.mean)
        if self.start == "near_truth":
            return near_truth(pair, *self.perturbation, self.seed)
        return anywhere(pair, self.starts, self.seed)

    def _score(self, pair: SinglePair, annealed: Annealed) -> Tensor:
        near = agreement(
            pair.points2d, pair.points3d, annealed.rotation, annealed.translation, threshold=self.threshold
        )  # fmt: skip
        everything = len(pair.points2d) + len(pair.points3d)
        return near.near2d + near.near3d + annealed.accepted.double() * (everything + 1)


def _found(annealed: Annealed, i: int) -> Found:
    residual = float(annealed.residual[i])
    return Found(
        annealed.rotation[i], annealed.translation[i], annealed.steps, residual, bool(annealed.accepted[i])
    )  # fmt: skip


def _unconverged(found: Found) -> Found:
    return Found(found.rotation, found.translation, found.iterations, found.residual, False)
