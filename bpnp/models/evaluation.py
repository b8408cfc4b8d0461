"""From an assignment to poses; points matched again under a pose; refinement; the search as a solver.

Rounds and refinement judge a match (i, j) by d_ij = r_ij^2 / (2 s^2), where r_ij is the chord between bearing i and the
direction of R p_j + t and s the standard deviation of the residuals in radians: -log of a normal density but for a
constant.
"""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.checks import check_positive, check_within
from bpnp.geometry import bearings, choose, chords
from bpnp.loops.parallel import Deadline
from bpnp.robust.proposals import pose_hypotheses
from bpnp.search.point_sets import PointSets
from bpnp.search.search import refine_poses, search_poses
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict import SearchResult
from bpnp.types import Batch, Pose, Prediction, SolveStats


class Clock:
    """Stopwatch of the estimates of a batch, from its construction on."""

    def __init__(self) -> None:
        self.start, self.seconds = time.perf_counter(), dict[str, float]()

    def record(self, estimate: str) -> None:
        """Note that a pose is found."""
        self.seconds[estimate] = time.perf_counter() - self.start

    def timed(self, prediction: Prediction) -> Prediction:
        """Return the prediction with its seconds; a pose that was not recorded is found now."""
        for estimate in prediction.poses.keys() - self.seconds.keys():
            self.record(estimate)
        return replace(prediction, seconds={name: self.seconds[name] for name in prediction.poses})


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
        check_positive(time_limit=math.inf if time_limit is None else time_limit)
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


REFINED = "refined"  # name of the third pose
FIRST_WIDTH = 5.0  # s of the first round, in widths of the last
FEATURE_WEIGHT = 0.03  # of the feature distances in a round, where the pose tells true matches from others better
FARTHEST = 12.0  # nats; d of points five widths apart, beyond which all are alike
TRUST = 0.7  # weight of the assignment in `log_support`; the rest is uniform
ALONE = 0.2  # share of the image points without a partner
WIDTH = 0.01  # s of `log_support`, radians: RANSAC's default threshold


def ransac_pose(ransac: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch) -> Pose:
    """A robust first pose from the most probable matches; no gradient reaches the assignment.

    ransac: a module with the arguments of `bpnp.layers.RansacPnP`.
    """
    return Pose(*ransac(assignment.detach(), batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))


def pnp_pose(pnp: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch, start: Pose) -> Pose:
    """The pose that best explains the whole assignment, from a start; differentiable in the assignment.

    pnp: a module with the arguments of `bpnp.layers.WeightedPnP`.
    """
    rays = bearings(batch.points2d)
    return Pose(*pnp(assignment, rays, batch.points3d, start.rotation, start.translation))


def residual_energy(
    batch: Batch, rotation: Float[Tensor, "b 3 3"], translation: Float[Tensor, "b 3"], width: float
) -> Float[Tensor, "b m n"]:
    """d_ij = r_ij^2 / (2 s^2) with s = `width`, in the dtype of the pose; NaN without a pose."""
    rays, points3d = bearings(batch.points2d).to(rotation), batch.points3d.to(rotation)
    return chords(rays, points3d, rotation, translation).square() / (2 * width**2)


def round_widths(rounds: int, ransac: nn.Module) -> list[float]:
    """s of each round in radians, falling by the same factor to the `threshold` of `ransac`."""
    check_within(0, math.inf, rounds=rounds)
    if rounds == 0:
        return []
    last = getattr(ransac, "threshold", None)
    if last is None:
        raise ValueError(f"expected a `ransac` with a `threshold`, got {type(ransac).__name__}; try `rounds` 0")
    return [float(width) for width in np.geomspace(FIRST_WIDTH * last, last, rounds)]


def match_again(
    prediction: Prediction,
    cost: Float[Tensor, "b m n"],
    batch: Batch,
    *,
    transport: nn.Module,
    pnp: nn.Module,
    widths: Sequence[float],
) -> Prediction:
    """The prediction with the pose "pnp" after rounds of transport and weighted PnP, the first round under "ransac".

    cost: of the network's own assignment, which stays `assignment`; that of the last round is `rematched`.
    transport: with `entropy`, its mu. widths: s of each round; none leaves the prediction as it is.
    """
    pose, assignment = prediction.poses["ransac"], None
    for width in widths:
        under_pose = cost_under_pose(cost, batch, pose, width=width, mu=transport.entropy)  # type: ignore[arg-type]
        assignment, _ = transport(under_pose, batch.mask2d, batch.mask3d)
        pose = pnp_pose(pnp, assignment, batch, pose)
    if assignment is None:
        return prediction
    return replace(prediction, poses=prediction.poses | {"pnp": pose}, rematched=assignment)


def cost_under_pose(
    cost: Float[Tensor, "b m n"], batch: Batch, pose: Pose, *, width: float, mu: float | Tensor
) -> Float[Tensor, "b m n"]:
    """w M_ij + mu min(d_ij, L): distances M of the features and residuals under a pose judge a match together.

    The entropic transport of this cost assigns in proportion to exp(-w M_ij / mu) times a normal density of the
    residual with a floor. No gradient reaches the pose; a sample without one keeps its M.
    """
    rotation, translation = pose.rotation.detach().to(cost), pose.translation.detach().to(cost)
    energy = residual_energy(batch, rotation, translation, width).clamp(max=FARTHEST)
    return torch.where(pose.found[:, None, None], FEATURE_WEIGHT * cost + mu * energy, cost)


def log_support(prediction: Prediction, batch: Batch, pose: Pose) -> Float[Tensor, " b"]:
    """Log-likelihood ratio of the bearings: under the pose and the assignment, against bearings without a partner.

    L = sum_i log(o + (1 - o) sum_j Q_ij A exp(-d_ij) / (2 pi s^2)) with A = 2 pi times the variance of the bearings, o
    = `ALONE` and Q_ij = P(j | i) mixed with a uniform distribution (`TRUST`). In nats: above zero the bearings are
    likelier under the pose and the assignment; -inf without a pose.
    """
    assignment = prediction.assignment
    assert assignment is not None
    mass = assignment.sum(2) if prediction.unmatched2d is None else assignment.sum(2) + prediction.unmatched2d
    conditional = assignment / mass.clamp_min(torch.finfo(assignment.dtype).tiny).unsqueeze(2)
    real = batch.mask2d.unsqueeze(2) & batch.mask3d.unsqueeze(1)
    partner = (TRUST * conditional + (1 - TRUST) / batch.count3d[:, None, None]) * real
    rays = bearings(batch.points2d) * batch.mask2d.unsqueeze(2)
    mean = rays.sum(1) / batch.count2d.unsqueeze(1)
    variance = rays.square().sum((1, 2)) / batch.count2d - mean.square().sum(1)
    energy = residual_energy(batch, pose.rotation, pose.translation, WIDTH)
    density = torch.exp(-energy) * (variance / WIDTH**2)[:, None, None]
    each = torch.log(ALONE + (1 - ALONE) * (partner * density).sum(2)) * batch.mask2d
    return torch.where(pose.found, each.sum(1), -math.inf)


class Refinement(nn.Module):
    """The pose "refined": annealed without the assignment from the network's poses and from poses that it proposes.

    Where the assignment is against the result (`log_support` < 0), the pose annealed from the network's poses alone
    takes its place if the assignment is for that.

    Args:
        hypotheses: poses that the assignment proposes as starts, at most; 0 for none.
        enabled: False leaves predictions as they are.
    """

    def __init__(self, *, hypotheses: int = 192, enabled: bool = True) -> None:
        super().__init__()
        check_within(0, math.inf, hypotheses=hypotheses)
        self.hypotheses, self.enabled = hypotheses, enabled

    def forward(self, prediction: Prediction, batch: Batch) -> Prediction:
        if not self.enabled:
            return prediction
        poses = prediction.poses.values()
        rotation = torch.stack([pose.rotation for pose in poses], 1)
        translation = torch.stack([pose.translation for pose in poses], 1)
        proposed = rotation[:, :0], translation[:, :0]
        if self.hypotheses:
            assert prediction.assignment is not None
            proposed = pose_hypotheses(
                prediction.assignment, batch.points2d, batch.points3d, batch.mask2d, batch.mask3d, count=self.hypotheses
            )
        proposed = proposed[0].to(rotation), proposed[1].to(translation)
        refined = refine(batch, torch.cat([rotation, proposed[0]], 1), torch.cat([translation, proposed[1]], 1))
        doubtful = log_support(prediction, batch, refined) < 0
        if self.hypotheses and bool(doubtful.any()):
            again = refine(batch, rotation, torch.where(doubtful[:, None, None], translation, torch.nan))
            refined = _choose_pose(doubtful & (log_support(prediction, batch, again) > 0), again, refined)
        return replace(prediction, poses=prediction.poses | {REFINED: refined})


@contextmanager
def refinement_enabled(solver: nn.Module, enabled: bool) -> Iterator[None]:
    """Within the block every `Refinement` of a solver is off unless `enabled`; afterwards each is as it was."""
    refinements = [module for module in solver.modules() if isinstance(module, Refinement)]
    before = [module.enabled for module in refinements]
    try:
        for module in refinements:
            module.enabled &= enabled
        yield
    finally:
        for module, was in zip(refinements, before, strict=True):
            module.enabled = was


def _choose_pose(chosen: Bool[Tensor, " b"], first: Pose, second: Pose) -> Pose:
    """The first pose of the chosen samples, the second of the others."""
    fields = ((pose.rotation, pose.translation, *vars(pose.stats).values()) for pose in (first, second))
    rotation, translation, *stats = (choose(chosen, *both) for both in zip(*fields, strict=True))
    return Pose(rotation, translation, SolveStats(*stats))
