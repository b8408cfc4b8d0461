"""Refinement of a network's poses by annealing, checked by the assignment."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor, nn

from bpnp.checks import check_within
from bpnp.geometry import bearings, choose
from bpnp.layers.ransac.proposals import pose_hypotheses
from bpnp.models.batch_search import best_poses, on_host, problems_of
from bpnp.models.pose_stages import residual_energy
from bpnp.runtime import default_float_errors
from bpnp.search.find import fixing_no_pose
from bpnp.search.problem import Problem
from bpnp.search.propose.given import anneal_given
from bpnp.search.search_frame import SearchFrame, degenerate
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict.decide import Case, SearchResult, decide
from bpnp.types import Batch, Pose, Prediction, SolveStats

REFINED = "refined"  # name of the third pose
TRUST = 0.7  # weight of the assignment in `log_support`; the rest is uniform
ALONE = 0.2  # fraction of image points without a correspondence in `log_support`
WIDTH = 0.01  # s of `log_support`, radians: RANSAC's default threshold


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


@default_float_errors
def refine(batch: Batch, rotation: Float[Tensor, "b s 3 3"], translation: Float[Tensor, "b s 3"]) -> Pose:
    """Anneal poses (`anneal_given`), NaN for a missing one, and return the best one of each sample.

    Iterations count the initial poses; converged is true where there is a pose, since annealing always ends.
    """
    samples = zip(problems_of(batch), rotation, translation, strict=True)
    results = ((problem, _refine(problem, *problem.from_user(on_host(r), on_host(t)))) for problem, r, t in samples)
    pose = best_poses(results, batch.points3d)
    return replace(pose, stats=replace(pose.stats, converged=pose.rotation.isfinite().all(-1).all(-1)))


def _refine(problem: Problem, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> SearchResult:
    """Return the annealed poses of one problem, the best one first."""
    if degenerate(problem.bearings) or degenerate(problem.points3d):
        return decide(fixing_no_pose(problem, "too few points, or all on one line"))
    poses = anneal_given(SearchFrame(problem, 0, DEFAULT), rotation, translation)
    return decide(Case.of(poses, problem, iterations=int(np.isfinite(rotation).all((-2, -1)).sum())))


def log_support(prediction: Prediction, batch: Batch, pose: Pose) -> Float[Tensor, " b"]:
    """Return the log-likelihood ratio of the bearings, nats: explained by pose and assignment, or not.

    L = sum_i log(o + (1 - o) sum_j Q_ij A exp(-d_ij) / (2 pi s^2)), with A = 2 pi times the variance of the bearings, o
    = `ALONE`, and Q_ij = P(j | i) mixed with a uniform distribution (`TRUST`). Above zero the bearings are likelier
    under the pose and the assignment; -inf without a pose.
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


@contextmanager
def refinement_enabled(solver: nn.Module, enabled: bool) -> Iterator[None]:
    """Switch every `Refinement` of a solver off until the block ends, unless `enabled`."""
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
