"""From an assignment to poses: RANSAC, weighted PnP, rounds of matching, refinement; and the search as a solver.

Rounds and refinement rate a match (i, j) by d_ij = r_ij^2 / (2 s^2). Here r_ij is the chord between bearing i and the
direction of R p_j + t, and s the standard deviation of the residuals in radians. d_ij is -log of a normal density, up
to a constant.
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
from bpnp.robust.proposals import pose_hypotheses
from bpnp.runtime import Deadline, default_float_errors
from bpnp.search.problem import Problem
from bpnp.search.propose.given import anneal_given
from bpnp.search.search import fixing_no_pose, search_poses
from bpnp.search.search_frame import Scene, degenerate
from bpnp.search.settings import DEFAULT, SearchSettings
from bpnp.search.verdict.decide import Case, SearchResult, decide
from bpnp.types import Batch, Pose, Prediction, SolveStats


class StageClock:
    """Stopwatch of the estimates of a batch, started at construction."""

    def __init__(self) -> None:
        self.start, self.seconds = time.perf_counter(), dict[str, float]()

    def record(self, estimate: str) -> None:
        """Record the time of an estimate."""
        self.seconds[estimate] = time.perf_counter() - self.start

    def add_times(self, prediction: Prediction) -> Prediction:
        """Return the prediction with its `seconds`; poses that were not recorded get the current time."""
        for estimate in prediction.poses.keys() - self.seconds.keys():
            self.record(estimate)
        return replace(prediction, seconds={name: self.seconds[name] for name in prediction.poses})


class Search(nn.Module):
    """`search_poses` as a solver. The prediction has the pose "search" and no assignment.

    Args:
        seed: Random seed of the initial poses, default 0.
        time_limit: Time limit for each problem in seconds, default 5. None for no limit.
        settings: Constants of the search.
    """

    estimates = ("search",)

    def __init__(self, *, seed: int = 0, time_limit: float | None = 5.0, settings: SearchSettings = DEFAULT) -> None:
        super().__init__()
        check_positive(time_limit=math.inf if time_limit is None else time_limit)
        self.seed, self.time_limit, self.settings = seed, time_limit, settings

    @default_float_errors
    def forward(self, batch: Batch) -> Prediction:
        """Return the pose "search" of each problem.

        Args:
            batch: Problems.
        """
        results = (
            (problem, search_poses(problem, seed=self.seed, deadline=self._deadline(), settings=self.settings))
            for problem in problems_of(batch)
        )
        return Prediction(poses={"search": best_poses(results, batch.points3d)})

    def _deadline(self) -> Deadline:
        return Deadline.after(self.time_limit)


@default_float_errors
def refine(batch: Batch, rotation: Float[Tensor, "b s 3 3"], translation: Float[Tensor, "b s 3"]) -> Pose:
    """Anneal poses (`anneal_given`) and return the best one of each sample.

    Iterations count the initial poses; converged is true where there is a pose, since annealing always ends.

    Args:
        batch: Problems.
        rotation: Initial rotations (b, s, 3, 3), NaN for a missing one.
        translation: Initial translations (b, s, 3).
    """
    samples = zip(problems_of(batch), rotation, translation, strict=True)
    results = ((problem, _refine(problem, *problem.from_user(_host(r), _host(t)))) for problem, r, t in samples)
    pose = best_poses(results, batch.points3d)
    return replace(pose, stats=replace(pose.stats, converged=pose.rotation.isfinite().all(-1).all(-1)))


def _refine(problem: Problem, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> SearchResult:
    """Return the annealed poses of one problem, the best one first."""
    if degenerate(problem.bearings) or degenerate(problem.points3d):
        return decide(fixing_no_pose(problem, "too few points, or all on one line"))
    poses = anneal_given(Scene(problem, 0, DEFAULT), rotation, translation)
    return decide(Case.of(poses, problem, iterations=int(np.isfinite(rotation).all((-2, -1)).sum())))


def problems_of(batch: Batch) -> list[Problem]:
    """Return the real points of each sample, on the host.

    A result then depends neither on the other samples nor on padding.
    """
    rays = bearings(batch.points2d)
    return [
        Problem.of(_host(rays[i, batch.mask2d[i]]), _host(batch.points3d[i, batch.mask3d[i]]))
        for i in range(len(batch))
    ]


def best_poses(results: Iterable[tuple[Problem, SearchResult]], like: Tensor) -> Pose:
    """Return the best pose of each problem, without a gradient; NaN where there is none.

    In the stats, `iterations` counts batches of initial poses, `residual` is the scale of the residuals in radians, and
    `converged` is True for the verdict "confident".

    Args:
        results: Each problem and its result.
        like: Tensor with the device and the dtype of the pose.
    """
    solved = list(results)
    poses = [problem.to_user(*result.best) for problem, result in solved]
    rotation = torch.from_numpy(np.array([pose[0] for pose in poses]).reshape(-1, 3, 3)).to(like)
    translation = torch.from_numpy(np.array([pose[1] for pose in poses]).reshape(-1, 3)).to(like)
    stats = SolveStats(
        torch.tensor([result.iterations for _, result in solved], device=like.device, dtype=torch.int64),
        like.new_tensor([result.residual for _, result in solved]),
        torch.tensor([result.verdict == "confident" for _, result in solved], device=like.device, dtype=torch.bool),
    )
    return Pose(rotation, translation, stats)


def _host(values: Tensor) -> NDArray[np.float64]:
    return values.detach().double().cpu().numpy()


REFINED = "refined"  # name of the third pose
FIRST_WIDTH = 5.0  # s of the first round, relative to the last
FEATURE_WEIGHT = 0.03  # weight of the feature distances in a round; the pose separates matches better than features
FARTHEST = 12.0  # largest d, nats: that of points five widths apart
TRUST = 0.7  # weight of the assignment in `log_support`; the rest is uniform
ALONE = 0.2  # fraction of image points without a correspondence in `log_support`
WIDTH = 0.01  # s of `log_support`, radians: RANSAC's default threshold


def ransac_pose(ransac: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch) -> Pose:
    """Estimate an initial pose from the most probable matches; no gradient reaches the assignment.

    Args:
        ransac: Module with the arguments of `bpnp.layers.RansacPnP`.
        assignment: P (b, m, n).
        batch: Problems.
    """
    return Pose(*ransac(assignment.detach(), batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))


def pnp_pose(pnp: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch, start: Pose) -> Pose:
    """Compute the pose that best explains the whole assignment, differentiable in the assignment.

    Args:
        pnp: Module with the arguments of `bpnp.layers.WeightedPnP`.
        assignment: P (b, m, n).
        batch: Problems.
        start: Initial pose.
    """
    rays = bearings(batch.points2d)
    return Pose(*pnp(assignment, rays, batch.points3d, start.rotation, start.translation))


def residual_energy(
    batch: Batch, rotation: Float[Tensor, "b 3 3"], translation: Float[Tensor, "b 3"], width: float
) -> Float[Tensor, "b m n"]:
    """Return d_ij = r_ij^2 / (2 s^2), (b, m, n), in the dtype of the pose; NaN without a pose.

    Args:
        batch: Problems.
        rotation: R (b, 3, 3).
        translation: t (b, 3), scene units.
        width: s, radians.
    """
    rays, points3d = bearings(batch.points2d).to(rotation), batch.points3d.to(rotation)
    return chords(rays, points3d, rotation, translation).square() / (2 * width**2)


def round_widths(rounds: int, ransac: nn.Module) -> list[float]:
    """Return s of each round in radians, decreasing geometrically to the `threshold` of `ransac`.

    Args:
        rounds: Number of rounds.
        ransac: RANSAC module.

    Raises:
        ValueError: `rounds` is negative, or `ransac` has no `threshold`.
    """
    check_within(0, math.inf, rounds=rounds)
    if rounds == 0:
        return []
    last = getattr(ransac, "threshold", None)
    if last is None:
        raise ValueError(
            f"`rounds` needs the `threshold` of `ransac`, which {type(ransac).__name__} lacks; use rounds 0"
        )
    return [float(width) for width in np.geomspace(last, FIRST_WIDTH * last, rounds)[::-1]]  # one round has the last


def match_again(
    prediction: Prediction,
    cost: Float[Tensor, "b m n"],
    batch: Batch,
    *,
    transport: nn.Module,
    pnp: nn.Module,
    widths: Sequence[float],
) -> Prediction:
    """Replace the pose "pnp" by the result of rounds of transport and weighted PnP.

    The first round matches the points under the pose "ransac", each later one under the pose of the round before. The
    assignment of the last round becomes `rematched`; `assignment` stays.

    Args:
        prediction: Prediction with the pose "ransac".
        cost: Cost of the network's own assignment (b, m, n).
        batch: Problems.
        transport: Transport with `entropy`, its mu.
        pnp: Weighted PnP.
        widths: s of each round, radians; an empty list leaves the prediction unchanged.
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
    """Combine feature distances and residuals under a pose: w M_ij + mu min(d_ij, L).

    The entropic transport of this cost assigns in proportion to exp(-w M_ij / mu) times a normal density of the
    residual with a floor. No gradient reaches the pose. A sample without a pose keeps its M.

    Args:
        cost: Feature distances M (b, m, n).
        batch: Problems.
        pose: Poses.
        width: s, radians.
        mu: Entropy weight of the transport.
    """
    rotation, translation = pose.rotation.detach().to(cost), pose.translation.detach().to(cost)
    energy = residual_energy(batch, rotation, translation, width).clamp(max=FARTHEST)
    return torch.where(pose.found[:, None, None], FEATURE_WEIGHT * cost + mu * energy, cost)


def log_support(prediction: Prediction, batch: Batch, pose: Pose) -> Float[Tensor, " b"]:
    """Return the log-likelihood ratio of the bearings: explained by pose and assignment, or without correspondence.

    L = sum_i log(o + (1 - o) sum_j Q_ij A exp(-d_ij) / (2 pi s^2)), with A = 2 pi times the variance of the bearings,
    o = `ALONE`, and Q_ij = P(j | i) mixed with a uniform distribution (`TRUST`).

    Args:
        prediction: Prediction with an assignment.
        batch: Problems.
        pose: Poses to rate.

    Returns:
        L (b,), nats. Above zero the bearings are likelier under the pose and the assignment; -inf without a pose.
    """
    assignment = prediction.assignment
    assert assignment is not None
    mass = assignment.sum(2) if prediction.unmatched2d is None else assignment.sum(2) + prediction.unmatched2d
    conditional = assignment / mass.clamp_min(torch.finfo(assignment.dtype).tiny).unsqueeze(2)
    real = batch.mask2d.unsqueeze(2) & batch.mask3d.unsqueeze(1)
    probability = (TRUST * conditional + (1 - TRUST) / batch.count3d[:, None, None]) * real
    rays = bearings(batch.points2d) * batch.mask2d.unsqueeze(2)
    mean = rays.sum(1) / batch.count2d.unsqueeze(1)
    variance = rays.square().sum((1, 2)) / batch.count2d - mean.square().sum(1)
    energy = residual_energy(batch, pose.rotation, pose.translation, WIDTH)
    density = torch.exp(-energy) * (variance / WIDTH**2)[:, None, None]
    each = torch.log(ALONE + (1 - ALONE) * (probability * density).sum(2)) * batch.mask2d
    return torch.where(pose.found, each.sum(1), -math.inf)


class Refinement(nn.Module):
    """Refinement to the pose "refined", by annealing without the assignment.

    Initial poses are those of the network and hypotheses drawn from the assignment. Where the assignment speaks against
    the result (`log_support` < 0), the best pose from the network's poses alone replaces it if the assignment supports
    that.

    Args:
        hypotheses: Largest number of hypotheses drawn from the assignment as initial poses, default 192; 0 for none.
        enabled: False returns predictions unchanged. Default True.
    """

    def __init__(self, *, hypotheses: int = 192, enabled: bool = True) -> None:
        super().__init__()
        check_within(0, math.inf, hypotheses=hypotheses)
        self.hypotheses, self.enabled = hypotheses, enabled

    def forward(self, prediction: Prediction, batch: Batch) -> Prediction:
        """Return the prediction with the pose "refined".

        Args:
            prediction: Prediction with poses, and with an assignment unless `hypotheses` is 0.
            batch: Problems.
        """
        if not self.enabled:
            return prediction
        poses = prediction.poses.values()
        rotation = torch.stack([pose.rotation for pose in poses], 1)
        translation = torch.stack([pose.translation for pose in poses], 1)
        hypotheses = rotation[:, :0], translation[:, :0]
        if self.hypotheses:
            assert prediction.assignment is not None
            hypotheses = pose_hypotheses(
                prediction.assignment, batch.points2d, batch.points3d, batch.mask2d, batch.mask3d, count=self.hypotheses
            )
        hypotheses = hypotheses[0].to(rotation), hypotheses[1].to(translation)
        refined = refine(batch, torch.cat([rotation, hypotheses[0]], 1), torch.cat([translation, hypotheses[1]], 1))
        if self.hypotheses and bool((unsupported := log_support(prediction, batch, refined) < 0).any()):
            other = refine(batch, rotation, torch.where(unsupported[:, None, None], translation, torch.nan))
            refined = _choose_pose(unsupported & (log_support(prediction, batch, other) > 0), other, refined)
        return replace(prediction, poses=prediction.poses | {REFINED: refined})


@contextmanager
def refinement_enabled(solver: nn.Module, enabled: bool) -> Iterator[None]:
    """Switch every `Refinement` of a solver off until the block ends, unless `enabled`.

    Args:
        solver: Solver.
        enabled: False to switch the refinement off; True changes nothing.
    """
    refinements = [module for module in solver.modules() if isinstance(module, Refinement)]
    before = [module.enabled for module in refinements]
    try:
        for module in refinements:
            module.enabled &= enabled
        yield
    finally:
        for module, value in zip(refinements, before, strict=True):
            module.enabled = value


def _choose_pose(chosen: Bool[Tensor, " b"], first: Pose, second: Pose) -> Pose:
    """Return the first pose for the chosen samples and the second for the others."""
    fields = ((pose.rotation, pose.translation, *vars(pose.stats).values()) for pose in (first, second))
    rotation, translation, *stats = (choose(chosen, *both) for both in zip(*fields, strict=True))
    return Pose(rotation, translation, SolveStats(*stats))
