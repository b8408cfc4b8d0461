"""From an assignment to poses: RANSAC on its best pairs, weighted PnP on all of them, annealing without them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.geometry import bearings
from bpnp.layers.pnp import Method, WeightedPnP
from bpnp.layers.ransac import Backend, RansacPnP
from bpnp.models.search_solver import Refine
from bpnp.models.support import log_support
from bpnp.robust.proposals import pose_hypotheses
from bpnp.types import Batch, Pose, Prediction, SolveStats

Rematch = Callable[[Pose], Prediction]  # the assignment under a pose


class PoseStage(nn.Module):
    """The poses of an assignment: "ransac", "pnp" (differentiable in the assignment) and, in evaluation, "refined".

    Args:
        ransac_backend: poselib (LO-RANSAC, PROSAC order), opencv (the paper's P3P-RANSAC and EPnP), torch (the whole
            batch on its device), or auto (torch on cuda, else poselib).
        ransac_iterations: most hypotheses.
        threshold: inlier threshold of RANSAC, normalised image coordinates.
        pairs_factor: RANSAC sees the pairs_factor * min(m, n) most probable pairs.
        pnp_method: newton, or lbfgs as in the paper.
        pnp_iterations: most iterations of the PnP layer.
        refine: give a third pose in evaluation, "refined", annealed without the assignment from the other two and from
            poses that the assignment proposes; from the other two alone where the assignment is against the result.
        hypotheses: poses that the assignment proposes for it, at most; 0 for none.
    """

    def __init__(
        self,
        *,
        ransac_backend: Backend = "auto",
        ransac_iterations: int = 1000,
        threshold: float = 0.01,
        pairs_factor: float = 1.5,
        pnp_method: Method = "newton",
        pnp_iterations: int = 50,
        refine: bool = True,
        hypotheses: int = 192,
    ) -> None:
        super().__init__()
        if hypotheses < 0:
            raise ValueError(f"expected a number of `hypotheses`, got {hypotheses}; try 0 for none")
        self.ransac = RansacPnP(
            backend=ransac_backend,
            pairs_factor=pairs_factor,
            threshold=threshold,
            max_iterations=ransac_iterations,
        )
        self.pnp = WeightedPnP(method=pnp_method, max_iterations=pnp_iterations)
        self.refine = Refine() if refine else None
        self.hypotheses = hypotheses
        self.estimates: tuple[str, ...] = ("ransac", "pnp", "refined") if refine else ("ransac", "pnp")

    def forward(self, prediction: Prediction, batch: Batch, rounds: Sequence[Rematch] = ()) -> Prediction:
        """The prediction with its poses, and with the assignment of the last round.

        In each round the points are matched again under the last pose, of which RANSAC's is the first, and the PnP
        layer is run on the new assignment. The other poses are those of the assignment as it was.
        """
        assert prediction.assignment is not None
        given = prediction.assignment.detach()
        ransac = Pose(*self.ransac(given, batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))
        pose, last = ransac, prediction
        for rematch in rounds:
            last = rematch(pose)
            pose = self._solve(last, batch, pose)
        pnp = pose if rounds else self._solve(prediction, batch, ransac)
        poses = {"ransac": ransac, "pnp": pnp}
        if self.refine is not None and not self.training:
            poses["refined"] = self._refined(prediction, batch, [ransac, pnp])
        return replace(last, poses=poses)

    def _solve(self, prediction: Prediction, batch: Batch, start: Pose) -> Pose:
        """Weighted PnP."""
        rays = bearings(batch.points2d)
        return Pose(*self.pnp(prediction.assignment, rays, batch.points3d, start.rotation, start.translation))

    def _refined(self, prediction: Prediction, batch: Batch, poses: list[Pose]) -> Pose:
        """Annealed from all starts; from the two estimates alone where the assignment is against the result."""
        assert self.refine is not None
        assert prediction.assignment is not None
        rays, masks = bearings(batch.points2d), (batch.mask2d, batch.mask3d)
        starts = self._starts(prediction.assignment, batch, poses)
        found = Pose(*self.refine(rays, batch.points3d, *starts, *masks))
        if not self.hypotheses:
            return found
        doubtful = self._support(prediction, batch, found) < 0
        if not bool(doubtful.any()):
            return found
        two = [torch.where(_like(doubtful, start[:, :2]), start[:, :2], torch.nan) for start in starts]
        own = Pose(*self.refine(rays, batch.points3d, *two, *masks))
        better = doubtful & (self._support(prediction, batch, own) > 0)
        return _chosen(better, own, found)

    def _support(self, prediction: Prediction, batch: Batch, pose: Pose) -> Float[Tensor, " b"]:
        assert prediction.assignment is not None
        return log_support(
            prediction.assignment, bearings(batch.points2d), batch.points3d, pose.rotation, pose.translation,
            mask2d=batch.mask2d, mask3d=batch.mask3d, unmatched2d=prediction.unmatched2d,
        )  # fmt: skip

    def _starts(
        self, assignment: Float[Tensor, "b m n"], batch: Batch, poses: list[Pose]
    ) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
        """The estimates, and the poses that the assignment proposes."""
        rotation = torch.stack([pose.rotation for pose in poses], 1)
        translation = torch.stack([pose.translation for pose in poses], 1)
        if not self.hypotheses:
            return rotation, translation
        turns, shifts, _ = pose_hypotheses(
            assignment, batch.points2d, batch.points3d, count=self.hypotheses, mask2d=batch.mask2d,
            mask3d=batch.mask3d,
        )  # fmt: skip
        return torch.cat([rotation, turns.to(rotation)], 1), torch.cat([translation, shifts.to(translation)], 1)


def _chosen(chosen: Bool[Tensor, " b"], first: Pose, second: Pose) -> Pose:
    """The first pose of the chosen samples, the second of the others."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(_like(chosen, a), a, b)

    one, other = first.stats, second.stats
    return Pose(
        pick(first.rotation, second.rotation),
        pick(first.translation, second.translation),
        SolveStats(
            pick(one.iterations, other.iterations),
            pick(one.residual, other.residual),
            pick(one.converged, other.converged),
        ),
    )


def _like(chosen: Bool[Tensor, " b"], values: Tensor) -> Tensor:
    return chosen.reshape(-1, *[1] * (values.ndim - 1))
