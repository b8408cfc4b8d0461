"""Monte Carlo pose loss (EPro-PnP, Chen et al., CVPR 2022): the likelihood of the true pose under the assignment.

The assignment P is taken as a density of poses, p(R, t) = exp(-E(R, t)) / Z, with the energy of the paper's PnP layer
(Eq. 8), E = kappa sum_ij P_ij (1 - f_i . g(R p_j + t)) and kappa = min(m, n) / s^2: the log-likelihood of min(m, n)
matches with normal errors of s radians. The density is over SO(3), with the measure of the rotation vector at the
identity, and over translations up to a distance from the true one; further poses have no mass. The integral Z is
estimated by adaptive multiple importance sampling (Cornuet et al. 2012).
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.checks import check_positive, check_within
from bpnp.geometry import bearings, retract, transform
from bpnp.layers.pnp import Objective
from bpnp.models.nets import subtract_mean
from bpnp.training.losses import true_pose
from bpnp.types import Batch, Prediction

FREEDOM = 3  # degrees of freedom of the proposals' t-distribution [convention, as in the paper]
KEPT = 0.1  # part of a proposal's scale that is added to the next one's, which few steps may determine [not tuned]


class Samples(NamedTuple):
    """Poses that were drawn, and the logarithm of the density that they were drawn from."""

    rotation: Float[Tensor, "b s 3 3"]
    translation: Float[Tensor, "b s 3"]
    log_density: Float[Tensor, "b s"]


class Proposal(NamedTuple):
    """Multivariate t-distribution of the steps (w, s) from a pose to (exp([w]x) R, t + s)."""

    mean: Float[Tensor, "b 6"]
    root: Float[Tensor, "b 6 6"]  # Cholesky factor of the scale matrix

    def draw(self, numbers: Float[Tensor, "b s k"]) -> Float[Tensor, "b s 6"]:
        """Return steps made of six normal numbers, and of `FREEDOM` more for the length."""
        length = (numbers[..., 6:].square().mean(-1, keepdim=True)).sqrt()
        return self.mean.unsqueeze(1) + numbers[..., :6] / length @ self.root.mT

    def log_density(self, step: Float[Tensor, "b s 6"]) -> Float[Tensor, "b s"]:
        """Return the logarithm of the density of steps."""
        white = torch.linalg.solve_triangular(self.root, (step - self.mean.unsqueeze(1)).mT, upper=False).mT
        size = step.shape[-1]
        constant = math.lgamma((FREEDOM + size) / 2) - math.lgamma(FREEDOM / 2) - size / 2 * math.log(FREEDOM * math.pi)
        volume = self.root.diagonal(dim1=1, dim2=2).log().sum(1, keepdim=True)
        return constant - volume - (FREEDOM + size) / 2 * torch.log1p(white.square().sum(-1) / FREEDOM)

    def fitted(self, weights: Float[Tensor, "b s"], step: Float[Tensor, "b s 6"]) -> "Proposal":
        """Return the proposal of the weighted steps' mean and covariance, and of a part of this one's scale."""
        mean = (weights.unsqueeze(-1) * step).sum(1)
        around = step - mean.unsqueeze(1)
        scale = (weights.unsqueeze(-1) * around).mT @ around + KEPT * self.root @ self.root.mT
        return Proposal(mean, torch.linalg.cholesky(scale))


class MonteCarloPoseLoss(nn.Module):
    """Negative log-likelihood of the true pose, in nats, under the density of poses that the assignment stands for.

    The samples come from proposals at the true pose and at the pose "pnp", and from others that are fitted to the
    samples so far. The gradient reaches the assignment alone: it raises the true pose above the poses that the
    assignment allows, whether the pose of the layer is one of them or not.

    Differences from the paper: matches are weighted by the assignment, the residuals are angles without a robust
    kernel, the width is fixed in place of learned weights, rotations are drawn by their rotation vector, and there is
    no regularisation of the pose's derivative.

    Args:
        width: Standard deviation s of the matches, radians. Default 0.05.
        samples: Number of poses of each proposal. Default 64.
        rounds: Number of proposals, at least 2. Default 4.
        reach: Largest distance of a translation from the true one, in distances of the scene's centroid. Default 1.
        seed: Seed of the samples, the same for each problem. Default 0.

    >>> import torch
    >>> from bpnp import Batch, BPnPNet
    >>> from bpnp.training import MonteCarloPoseLoss
    >>> truth = torch.eye(3), torch.tensor([0.0, 0.0, 5.0])
    >>> batch = Batch.from_arrays(torch.rand(20, 2), torch.rand(20, 3), *truth)
    >>> list(MonteCarloPoseLoss()(BPnPNet()(batch), batch))
    ['monte_carlo']
    """

    def __init__(
        self, *, width: float = 0.05, samples: int = 64, rounds: int = 4, reach: float = 1.0, seed: int = 0
    ) -> None:
        super().__init__()
        check_positive(width=width, reach=reach)
        check_within(8, math.inf, samples=samples)
        check_within(2, math.inf, rounds=rounds)
        self.width, self.samples, self.rounds, self.reach, self.seed = width, samples, rounds, reach, seed

    def forward(self, prediction: Prediction, batch: Batch) -> dict[str, Float[Tensor, " b"]]:
        """Return "monte_carlo"; NaN where the pose did not converge.

        Args:
            prediction: Prediction with an assignment and the pose "pnp".
            batch: Problems with their true poses.

        Returns:
            The term (b,), by name.

        Raises:
            ValueError: The prediction has no assignment, or the batch no true poses.
        """
        if prediction.assignment is None:
            raise ValueError("the solver returns no assignment, of which the loss makes a density of poses")
        pose, solved = prediction.poses["pnp"], prediction.poses["pnp"].stats.converged
        true = true_pose(batch)
        kappa = torch.minimum(batch.count2d, batch.count3d).double() / self.width**2
        weighted = weighted_bearings(prediction.assignment, batch) * kappa[:, None, None]
        # A rotation about the centroid hardly moves the scene, so that the steps of a proposal are less correlated.
        points = subtract_mean(batch.points3d.double(), batch.mask3d)
        centre = (batch.points3d - points)[:, 0]
        rotation, translation = true[0].double(), (_rotate(true[0], centre) + true[1]).double()
        with torch.no_grad():
            # The true pose stands for a missing one, whose value is not used.
            start = torch.where(solved[:, None, None], pose.rotation, rotation).double()
            shift = torch.where(solved[:, None], _rotate(start, centre) + pose.translation, translation).double()
            limit = self.reach * translation.norm(dim=-1)
            samples = self.draw(weighted, points, rotation, translation, start, shift, limit)
        value = negative_log_likelihood(weighted, points, rotation, translation, samples)
        return {"monte_carlo": value.where(solved, torch.nan)}

    def draw(
        self,
        weighted: Float[Tensor, "b n 3"],
        points: Float[Tensor, "b n 3"],
        rotation: Float[Tensor, "b 3 3"],
        translation: Float[Tensor, "b 3"],
        other_rotation: Float[Tensor, "b 3 3"],
        other_translation: Float[Tensor, "b 3"],
        limit: Float[Tensor, " b"],
    ) -> Samples:
        """Draw poses from proposals: normal approximations at two poses, then those fitted to the poses so far.

        The density is that of the mixture of all proposals.

        Args:
            weighted: kappa q_j (b, n, 3).
            points: p_j about their centroid (b, n, 3).
            rotation: Rotation of the first proposal (b, 3, 3), from which the steps start.
            translation: Translation of the first proposal (b, 3), about which translations count.
            other_rotation: Rotation of the second proposal (b, 3, 3).
            other_translation: Translation of the second proposal (b, 3).
            limit: Largest distance of a translation that counts (b,).

        Returns:
            The poses; the density is infinite for a translation beyond the limit.
        """
        import roma  # here, not at the top: it imports all of torch's compiler

        b = len(points)
        generator = torch.Generator().manual_seed(self.seed)
        turn = roma.rotmat_to_rotvec(other_rotation @ rotation.mT)
        apart = torch.cat([turn, other_translation - translation], -1)
        roots = [
            normal_approximation(weighted, points, *pose, limit)
            for pose in ((rotation, translation), (other_rotation, other_translation))
        ]
        proposals = [Proposal(torch.zeros_like(apart), roots[0]), Proposal(apart, roots[1])]
        steps: list[Tensor] = []
        for k in range(self.rounds):
            numbers = torch.randn(self.samples, 6 + FREEDOM, generator=generator, dtype=torch.float64).to(points)
            steps.append(proposals[k].draw(numbers.expand(b, -1, -1)))
            if k + 1 < len(roots):
                continue
            drawn = torch.cat(steps, 1)
            at = (pose.unsqueeze(1).expand(b, drawn.shape[1], *pose.shape[1:]) for pose in (rotation, translation))
            turned, moved = retract(drawn, *at)
            mixture = torch.logsumexp(torch.stack([each.log_density(drawn) for each in proposals]), 0)
            density = mixture - math.log(len(proposals)) - log_measure(drawn[..., :3])
            near = (moved - translation.unsqueeze(1)).norm(dim=-1) < limit.unsqueeze(1)
            density = torch.where(near & (drawn[..., :3].norm(dim=-1) < math.pi), density, torch.inf)
            weights = torch.softmax(log_weight(weighted, points, turned, moved) - density, 1)
            proposals.append(proposals[0].fitted(weights, drawn))
        return Samples(turned, moved, density)


def weighted_bearings(assignment: Float[Tensor, "b m n"], batch: Batch) -> Float[Tensor, "b n 3"]:
    """Return q_j = sum_i P_ij f_i for P that sums to one; those of padded scene points are zero."""
    real = batch.mask2d.unsqueeze(2) & batch.mask3d.unsqueeze(1)
    mass = torch.where(real, assignment, 0).double()
    return (mass / mass.sum((1, 2), keepdim=True)).mT @ bearings(batch.points2d).double()


def negative_log_likelihood(
    weighted: Float[Tensor, "b n 3"],
    points: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    samples: Samples,
) -> Float[Tensor, " b"]:
    """Return E + log Z of a pose, with Z the mean over the samples of exp(-E) over their density."""
    here = log_weight(weighted, points, rotation.unsqueeze(1), translation.unsqueeze(1)).squeeze(1)
    drawn = log_weight(weighted, points, samples.rotation, samples.translation) - samples.log_density
    return torch.logsumexp(drawn, 1) - math.log(drawn.shape[1]) - here


def log_weight(
    weighted: Float[Tensor, "b n 3"],
    points: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b s 3 3"],
    translation: Float[Tensor, "b s 3"],
) -> Float[Tensor, "b s"]:
    """Return sum_j q_j . g(R p_j + t), which is -E but for a constant that no pose changes."""
    camera = transform(rotation, translation, points.unsqueeze(1).expand(-1, rotation.shape[1], -1, -1))
    return (nn.functional.normalize(camera, dim=-1) * weighted.unsqueeze(1)).sum((-2, -1))


def normal_approximation(
    weighted: Float[Tensor, "b n 3"],
    points: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    limit: Float[Tensor, " b"],
) -> Float[Tensor, "b 6 6"]:
    """Return the Cholesky factor of the inverse Hessian of E at a pose, with a normal prior of 1 radian and the limit.

    Negative eigenvalues of the Hessian, in units of the prior, count as zero.
    """
    hessian = Objective(weighted.mT, points.mT).derivatives(rotation, translation).hessian
    # From steps in the frame of the scene to those in that of the camera, in units of the prior.
    turn = torch.block_diag(*[torch.ones(3, 3)] * 2).to(points) * rotation.repeat(1, 2, 2)
    unit = torch.ones(len(points), 6).to(points)
    unit[:, 3:] = limit.unsqueeze(1)
    turn = unit.unsqueeze(2) * turn
    values, vectors = torch.linalg.eigh(turn @ hessian @ turn.mT)
    scale = (vectors / (1 + values.clamp_min(0)).unsqueeze(1)) @ vectors.mT
    return torch.linalg.cholesky(unit.unsqueeze(2) * scale * unit.unsqueeze(1))


def log_measure(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the logarithm of 2 (1 - cos a) / a^2 with a = |w|: the volume of rotations of a volume of vectors w."""
    angle = vector.norm(dim=-1).clamp_min(1e-6)
    return 2 * (2 * torch.sin(angle / 2) / angle).abs().log()


def _rotate(rotation: Float[Tensor, "b 3 3"], vector: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
    return (rotation.to(vector) @ vector.unsqueeze(-1)).squeeze(-1)
