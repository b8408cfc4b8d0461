"""SoftPOSIT: alternating soft assignment and scaled-orthographic pose (David, DeMenthon et al., IJCV 2004)."""

import math
from typing import Any, Literal, NamedTuple

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bpnp.geometry import random_rotations, retract
from bpnp.models.baselines.single_problem import (
    Answer,
    SingleProblem,
    SingleSolver,
    agreement,
    weak_perspective_distance,
)
from bpnp.runtime import Deadline

Start = Literal["mean", "near_truth", "random"]
CHUNK = 2**22  # largest product of image points, scene points and initial poses annealed together
THRESHOLD = 0.01  # distance of matching points in the normalised image, to choose between results
FOCAL = 800.0  # pixels per unit of the normalised image; the other constants are in pixels
NOISE = 2.0  # standard deviation of the image points, pixels
ALPHA = 9.21 * NOISE**2 + 1  # squared pixels; 9.21 is the 99 % quantile of chi^2 with two degrees of freedom
BETA_START, BETA_FINAL, BETA_RATE = 4e-4, 0.5, 1.05  # weight of squared distances, 1/pixel^2; factor of a step
STEPS = 1 + int(math.log(BETA_FINAL / BETA_START) / math.log(BETA_RATE))
ENOUGH_STEPS = 20
SCALINGS, TOLERANCE = 60, 1e-3  # soft assignment: largest number of scalings, and total error of the row sums
WELL_POSED = 1e-10  # smallest eigenvalue of the points' second moments, per trace


class SoftPOSIT(SingleSolver):
    """SoftPOSIT (David et al., IJCV 2004), a local solver whose result depends on its initial pose.

    `residual` of the pose is the root mean square distance of the matched points in pixels. `converged` is the
    acceptance test of the authors' program: a residual below half the acceptance radius. It holds for wrong poses too.

    Differences from the paper:

    - Distances are in pixels of a camera with a focal length of 800, as the authors' constants are, and the scene is
      rotated about its centroid.
    - Annealing always ends at the last temperature. The authors' program ends at the first accepted pose, and their
      search from random initial poses at the first accepted result. Here all initial poses are annealed, and the result
      with the most inliers is returned, accepted results first.
    - Where the matched points span no volume, the last pose is returned, not accepted.

    Args:
        start: Initial pose. "mean", the default: Euler angles of 22.5 degrees and translation (0, 0, 4.5), the mean of
            the paper's test on ModelNet40. The paper starts there too; not comparable with blind solvers on that test.
            "near_truth": the true pose with a perturbation (the paper's for MegaDepth; not comparable with blind
            solvers). "random": uniform rotations.
        starts: Number of random initial poses, default 64; used with "random" only.
        max_steps: Largest number of annealing steps; None for all.
        seed: Seed of the initial poses.
        time_limit: Seconds for each problem; then the best pose so far is returned, not converged. None for no limit.
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
            raise ValueError(f"`start` is {start!r}; it is one of mean, near_truth, random")
        self.start, self.starts, self.seed, self.max_steps = start, starts, seed, max_steps

    def solve(self, problem: SingleProblem, deadline: Deadline) -> Answer:
        """Return the best pose of all initial poses; arguments as for `SingleSolver.solve`."""
        points = problem.points2d, problem.points3d
        m, n = map(len, points)
        best, most, finished = Answer(), -1, True
        parts = (values.split(max(1, CHUNK // (m * n))) for values in self._starts(problem))
        for rotation, translation in zip(*parts, strict=True):
            found = softposit(*points, rotation, translation, self.max_steps, deadline)
            finished = found.finished
            counts = agreement(*points, found.rotation, found.translation, threshold=THRESHOLD)
            score = counts.sum(0) + found.accepted * (m + n + 1)
            i = int(score.argmax())
            if int(score[i]) > most:
                most, pose = int(score[i]), (found.rotation[i], found.translation[i])
                best = Answer(pose, found.steps, float(found.residual[i]), bool(found.accepted[i]))
            if not finished:
                break
        return best._replace(converged=best.converged and finished)

    def _starts(self, problem: SingleProblem) -> tuple[Float[Tensor, "s 3 3"], Float[Tensor, "s 3"]]:
        like = problem.points3d
        if self.start == "mean":  # Rz Ry Rx of 22.5 degrees each
            rotation = roma.euler_to_rotmat("xyz", like.new_full((3,), 22.5, dtype=torch.float64), degrees=True)
            return rotation.unsqueeze(0).to(like), like.new_tensor([[0.0, 0.0, 4.5]])
        generator = torch.Generator().manual_seed(problem.seed(self.seed))
        if self.start == "random":
            # The scene's centre on the viewing ray of the image's, at the weak-perspective distance.
            rotation = random_rotations(self.starts, generator).to(like)
            ray = torch.nn.functional.pad(problem.points2d.mean(0), (0, 1), value=1.0)
            return rotation, weak_perspective_distance(problem.points2d, like) * ray - rotation @ like.mean(0)
        if problem.rotation is None or problem.translation is None:
            raise ValueError("`start` near_truth needs the true poses, which the batch lacks; use start 'random'")
        # Rotate by up to 10 degrees about a random axis and move by up to 0.5 in a random direction, uniformly.
        drawn: dict[str, Any] = {"generator": generator, "dtype": torch.float64, "device": "cpu"}
        directions = torch.nn.functional.normalize(torch.randn(2, 3, **drawn), dim=-1)
        amounts = (2 * torch.rand(2, **drawn) - 1) * torch.tensor([math.radians(10), 0.5], device="cpu")
        step = amounts.unsqueeze(-1) * directions
        rotation, translation = retract(step.flatten().to(like), problem.rotation, problem.translation)
        return rotation.unsqueeze(0), translation.unsqueeze(0)


class Annealed(NamedTuple):
    """Pose from each initial pose."""

    rotation: Float[Tensor, "s 3 3"]
    translation: Float[Tensor, "s 3"]
    residual: Float[Tensor, " s"]  # root mean square distance of the matched points, pixels
    accepted: Bool[Tensor, " s"]  # true for an acceptable result
    steps: int
    finished: bool  # false if the deadline passed


def softposit(
    points2d: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor, max_steps: int | None, deadline: Deadline
) -> Annealed:
    """Anneal every initial pose (s, 3, 3), (s, 3) of one problem.

    With S_k = (X_k, 1), Q1 = (R1, Tx)/Tz, Q2 = (R2, Ty)/Tz and w_k = 1 + R3 . X_k / Tz, the distance of image point j
    and scene point k is d^2_jk = FOCAL^2 [(Q1 . S_k - w_k x_j)^2 + (Q2 . S_k - w_k y_j)^2]. A step soft-assigns by
    exp(-beta (d^2 - ALPHA)) with slack, fits Q1 and Q2 to the assignment, makes their rows orthonormal, and multiplies
    beta by BETA_RATE.

    A result is accepted if its residual is below sqrt(ALPHA)/2 after 20 steps or more. Where the matched points span no
    volume, the last pose is returned, not accepted. Without a largest number of steps, all are taken.
    """
    image = points2d.double()
    centre = points3d.double().mean(0)
    scene = torch.nn.functional.pad(points3d.double() - centre, (0, 1), value=1.0)  # (n, 4)
    turned = rotation.double()
    shift = translation.double() + turned @ centre
    moments2d = torch.stack([torch.ones_like(image[:, 0]), *image.unbind(-1), image.square().sum(-1)], -1).float()
    broken = torch.zeros(len(turned), dtype=torch.bool, device=image.device)
    residual = image.new_full((len(turned),), math.inf)
    beta, step = BETA_START, 0
    limit = STEPS if max_steps is None else min(STEPS, max_steps)
    while step < limit and not deadline.passed():
        # Q1 . S_k and Q2 . S_k (s, 2, n), and w_k (s, n)
        scaled = torch.cat([turned, shift.unsqueeze(-1)], -1) @ scene.mT / shift[:, 2, None, None]
        rows, depth = scaled[:, :2], scaled[:, 2]
        kernel = _kernel(image, rows, depth, beta)
        u, v = slack_scalings(kernel, 1 / (max(len(image), len(scene)) + 1))
        matched = (v.unsqueeze(-1) * (kernel.mT @ (u.unsqueeze(-1) * moments2d))).double()  # (s, n, 4)
        residual = torch.where(broken, torch.inf, _residual(matched, rows, depth))
        moved_r, moved_t, solved = _fit(matched, scene, depth)
        broken = broken | ~solved
        turned = torch.where(broken[:, None, None], turned, moved_r)
        shift = torch.where(broken[:, None], shift, moved_t)
        beta, step = beta * BETA_RATE, step + 1
    accepted = (residual < math.sqrt(ALPHA) / 2) & (step >= ENOUGH_STEPS) & ~broken
    return Annealed(turned, shift - turned @ centre, residual, accepted, step, step == limit)


def slack_scalings(kernel: Float[Tensor, "s m n"], slack: float) -> tuple[Tensor, Tensor]:
    """Compute u and v such that u_j K_jk v_k, with slack entries, sums to one over every real row and column.

    All slack entries start as `slack` and are scaled only with their own row or column, unlike the dustbins of the
    Sinkhorn layer. Where K_jk is the largest of its row and of its column and above the slack, both slacks keep their
    initial ratio to it, so that a good match is not lost to them. The iteration stops when the row sums are off by less
    than TOLERANCE.
    """
    best3d, best2d = kernel.max(2), kernel.max(1)
    rows = torch.arange(kernel.shape[1], device=kernel.device)
    kept2d = (best2d.indices.gather(1, best3d.indices) == rows) & (best3d.values > slack)
    columns = torch.arange(kernel.shape[2], device=kernel.device)
    kept3d = (best3d.indices.gather(1, best2d.indices) == columns) & (best2d.values > slack)
    u, v = torch.ones_like(best3d.values), torch.ones_like(best2d.values)
    total = (kernel @ v.unsqueeze(-1)).squeeze(-1) + slack
    for _ in range(SCALINGS):
        u = 1 / total
        factor = torch.where(kept3d, u.gather(1, best2d.indices), 1)
        v = 1 / ((kernel.mT @ u.unsqueeze(-1)).squeeze(-1) + slack * factor)
        total = (kernel @ v.unsqueeze(-1)).squeeze(-1) + slack * torch.where(kept2d, v.gather(1, best3d.indices), 1)
        if bool(((u * total - 1).abs().sum(-1) < TOLERANCE).all()):
            break
    return u, v


def _kernel(image: Tensor, rows: Tensor, depth: Tensor, beta: float) -> Tensor:
    """Return gamma exp(-beta (d^2 - ALPHA)) (s, m, n) with gamma = 1/(max(m, n) + 1), in float32."""
    x, y = (FOCAL * image).float().unsqueeze(-1).unbind(1)
    along_x, along_y = (FOCAL * rows).float().unsqueeze(2).unbind(1)
    w = depth.float().unsqueeze(1)
    squared = torch.addcmul(along_x, x, w, value=-1).square_()
    squared += torch.addcmul(along_y, x.new_ones(()) * y, w, value=-1).square_()
    gamma = 1 / (max(image.shape[0], depth.shape[1]) + 1)
    return squared.mul_(-beta).add_(beta * ALPHA + math.log(gamma)).exp_()


def _residual(matched: Tensor, rows: Tensor, depth: Tensor) -> Tensor:
    """Return sqrt(sum_jk m_jk d^2_jk / n) from the moments sum_j m_jk (1, x_j, y_j, x_j^2 + y_j^2)."""
    mass, x, y, squared = matched.unbind(-1)
    a, b = rows.unbind(1)
    total = (a.square() + b.square()) * mass - 2 * depth * (a * x + b * y) + depth.square() * squared
    return FOCAL * total.clamp_min(0).mean(-1).sqrt()


def _fit(matched: Tensor, scene: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit the poses (s,) whose first two rows match the assignment best by least squares; return which are fixed."""
    mass, targets = matched[..., 0], depth.unsqueeze(-1) * matched[..., 1:3]
    moments = (scene.mT * mass.unsqueeze(1)) @ scene  # L = sum_k m_k S_k S_k^T
    # Equilibrate the matrix, so that its eigenvalues do not depend on the unit of the scene.
    scale = moments.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    balanced = scale.unsqueeze(-1) * moments * scale.unsqueeze(-2)
    factor, info = torch.linalg.cholesky_ex(balanced)
    solved = (info == 0) & (factor.diagonal(dim1=-2, dim2=-1).amin(-1).square() > WELL_POSED)
    q = scale.unsqueeze(-1) * torch.cholesky_solve(scale.unsqueeze(-1) * (scene.mT @ targets), factor)  # (s, 4, 2)
    solved = solved & q.isfinite().all((-2, -1))
    q = torch.where(solved[:, None, None], q, torch.eye(4, 2, dtype=q.dtype, device=q.device))
    left, sizes, right = torch.linalg.svd(q[:, :3], full_matrices=False)
    first, second = (left @ right).unbind(-1)
    rotation = torch.stack([first, second, torch.linalg.cross(first, second)], -2)
    distance = 2 / sizes.sum(-1)
    translation = torch.stack([q[:, 3, 0] * distance, q[:, 3, 1] * distance, distance], -1)
    return rotation, translation, solved & distance.isfinite()
