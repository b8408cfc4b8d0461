"""The weighted blind PnP layer (paper Eq. 7): the pose that best explains a soft assignment, from a given start.

Newton on the aggregated objective by default; L-BFGS on the dense objective as in the paper. Both end at the same
optimum, and the gradient does not know which of them found it.
"""

from functools import partial
from typing import Literal, NamedTuple

import roma
import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.geometry import hat, is_finite, retract
from bpnp.layers.implicit import at_optimum
from bpnp.layers.objective import Derivatives, aggregate, dense_objective, derivatives, pose_gradient
from bpnp.layers.pacing import steps, unfinished
from bpnp.precision import full_precision
from bpnp.types import SolveStats

Method = Literal["newton", "lbfgs"]
FAR = 1e4  # scene radii; a pose beyond has run away to where every point is seen in one direction
LINE_SEARCH_TOLERANCE = 1e-7  # a line search on values in float64 resolves no gradient much smaller than this
WELL_POSED = 1e-9  # smallest Hessian eigenvalue, per trace, for which a derivative is given
STEPS_ON_GPU = 12


@full_precision
def weighted_pnp(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    method: Method = "newton",
    tolerance: float = 1e-9,
    max_iterations: int = 50,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """argmin over (R, t) of sum_ij P_ij (1 - f_i . g(R p_j + t)), near the start (`rotation`, `translation`).

    assignment: P, zero at padded points. bearings: unit f_i. points3d: p_j, any unit. rotation, translation: the start,
        which receives no gradient; a sample whose start is NaN has no pose.
    method: "newton", damped, per sample, O(n) an iteration; "lbfgs", strong Wolfe on the dense objective, per sample.
    tolerance: largest norm of the objective's gradient per unit of weight, in radians and scene radii; 1e-7 at least
        for "lbfgs", whose line search cannot see less.
    max_iterations: of the solver; on cuda at most 12, all of which are taken (a stop would make the host wait).

    Returns rotation, translation and stats per sample. Iterations run in float64. Gradients flow to assignment,
    bearings and points3d by the implicit function theorem with the true Hessian (Lemma 1). `converged` is False, and
    the gradient zero, where the start is missing, the tolerance was not met, the pose ran away or the Hessian is not
    positive definite: leave such samples out of a loss.
    Raises ValueError for an unknown method.
    """
    if method not in ("newton", "lbfgs"):
        raise ValueError(f"expected `method` 'newton' or 'lbfgs', got {method!r}")
    dtype = assignment.dtype
    q = aggregate(assignment, bearings).double()
    points, frame = _normalise(points3d.double(), q.detach())
    start_found = is_finite(rotation, translation)
    start_r = torch.where(start_found[:, None, None], rotation.double(), torch.eye(3, device=q.device).double())
    start_r = roma.special_procrustes(start_r.detach())  # steps keep what a rounded start lacks to a rotation
    start_t = torch.where(start_found[:, None], translation.double(), torch.ones_like(frame.centre))
    with torch.no_grad():
        start = _Start(start_r, frame.enter(start_r, start_t))
        if method == "newton":
            r, t, iterations = _newton(q, points, start, tolerance, max_iterations)
        else:
            tolerance = max(tolerance, LINE_SEARCH_TOLERANCE)
            r, t, iterations = _lbfgs(assignment.double(), bearings.double(), points, start, tolerance, max_iterations)
        stats, hessian_factor = _judge(q, points, r, t, start_found, iterations, tolerance)

    def solve_adjoint(gradient: Tensor) -> Tensor:
        adjoint = torch.cholesky_solve(gradient.unsqueeze(-1), hessian_factor).squeeze(-1)
        return torch.where(stats.converged[:, None], adjoint, 0)

    step = at_optimum(
        torch.zeros_like(r[:, 0].repeat(1, 2)), lambda _, q, p: pose_gradient(q, p, r, t), solve_adjoint, q, points
    )
    # exp([w]x) R to first order: exact in value and derivative, for the step is zero.
    moved_r = r + hat(step[:, :3]) @ r
    moved_t = frame.leave(moved_r, t + step[:, 3:])
    moved_r = torch.where(start_found[:, None, None], moved_r, torch.nan)
    moved_t = torch.where(start_found[:, None], moved_t, torch.nan)
    return moved_r.to(dtype), moved_t.to(dtype), stats


class _Start(NamedTuple):
    rotation: Tensor
    translation: Tensor


class _Frame(NamedTuple):
    """Scene coordinates p = scale * p' + centre in which the points have unit size; keeps the Hessian well scaled."""

    centre: Tensor
    scale: Tensor

    def enter(self, rotation: Tensor, translation: Tensor) -> Tensor:
        return (translation + (rotation @ self.centre.unsqueeze(-1)).squeeze(-1)) / self.scale

    def leave(self, rotation: Tensor, translation: Tensor) -> Tensor:
        return translation * self.scale - (rotation @ self.centre.unsqueeze(-1)).squeeze(-1)


def _normalise(points3d: Tensor, q: Tensor) -> tuple[Tensor, _Frame]:
    weight = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    weight = weight / weight.sum(-2, keepdim=True).clamp_min(torch.finfo(q.dtype).tiny)
    fixed = points3d.detach()
    centre = (weight * fixed).sum(-2)
    scale = (weight * (fixed - centre.unsqueeze(-2)) ** 2).sum((-2, -1)).sqrt().unsqueeze(-1)
    scale = torch.where(scale > 0, scale, 1)
    return (points3d - centre.unsqueeze(-2)) / scale.unsqueeze(-2), _Frame(centre, scale)


def _newton(
    q: Tensor, points: Tensor, start: _Start, tolerance: float, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton with Levenberg's damping, each sample with its own step and stop. Damping is zero until a step fails."""
    r, t = start
    weight = torch.linalg.vector_norm(q, dim=-1).sum(-1).clamp_min(torch.finfo(q.dtype).tiny)
    current = derivatives(q, points, r, t)
    damping = torch.zeros_like(weight)
    iterations = torch.zeros(len(q), dtype=torch.long, device=q.device)
    eye = torch.eye(6, dtype=q.dtype, device=q.device)
    for _ in range(steps(max_iterations, q.device, STEPS_ON_GPU)):
        active = current.gradient.norm(dim=-1) > tolerance * weight
        if not unfinished(active):
            break
        iterations += active
        factor, info = torch.linalg.cholesky_ex(current.hessian + damping[:, None, None] * eye)
        step = -torch.cholesky_solve(current.gradient.unsqueeze(-1), factor).squeeze(-1)
        usable = active & (info == 0) & step.isfinite().all(-1)
        new_r, new_t = retract(torch.where(usable.unsqueeze(-1), step, 0), r, t)
        trial = derivatives(q, points, new_r, new_t)
        # Near the optimum the values agree to rounding; there the smaller gradient decides.
        flat = (trial.value - current.value).abs() <= 1e-13 * weight
        lower = (trial.value < current.value) | (flat & (trial.gradient.norm(dim=-1) < current.gradient.norm(dim=-1)))
        accept = usable & lower
        r = torch.where(accept[:, None, None], new_r, r)
        t = torch.where(accept[:, None], new_t, t)
        current = _choose(accept, trial, current)
        raised = torch.maximum(10 * damping, 1e-3 * weight)
        lowered = torch.where(damping > 1e-6 * weight, damping / 10, 0)
        damping = torch.where(active, torch.where(accept, lowered, raised), damping)
    return r, t, iterations


def _choose(accept: Tensor, trial: Derivatives, current: Derivatives) -> Derivatives:
    return Derivatives(
        torch.where(accept, trial.value, current.value),
        torch.where(accept[:, None], trial.gradient, current.gradient),
        torch.where(accept[:, None, None], trial.hessian, current.hessian),
    )


def _lbfgs(
    assignment: Tensor, bearings: Tensor, points: Tensor, start: _Start, tolerance: float, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's solver, one sample at a time, so that no pose depends on its neighbours' line searches."""
    rotations, translations, iterations = [], [], []
    for p, f, x, r0, t0 in zip(assignment, bearings, points, *start, strict=True):
        pose = torch.cat([roma.rotmat_to_rotvec(r0), t0]).requires_grad_()
        optimiser = torch.optim.LBFGS(
            [pose],
            max_iter=max_iterations,
            tolerance_grad=0.01 * tolerance * float(torch.linalg.vector_norm(p.mT @ f, dim=-1).sum()),
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )

        optimiser.step(partial(_evaluate, pose, p, f, x))
        iterations.append(optimiser.state[pose]["n_iter"])
        rotations.append(roma.rotvec_to_rotmat(pose[:3].detach()))
        translations.append(pose[3:].detach())
    return torch.stack(rotations), torch.stack(translations), torch.tensor(iterations, device=points.device)


def _evaluate(pose: Tensor, assignment: Tensor, bearings: Tensor, points: Tensor) -> Tensor:
    """Value of Eq. 7 at an angle-axis vector and translation, whose gradient is left in `pose.grad`."""
    pose.grad = None
    with torch.enable_grad():
        rotation, translation = roma.rotvec_to_rotmat(pose[None, :3]), pose[None, 3:]
        value = dense_objective(assignment[None], bearings[None], points[None], rotation, translation).sum()
        value.backward()
    return value


def _judge(
    q: Tensor, points: Tensor, r: Tensor, t: Tensor, found: Tensor, iterations: Tensor, tolerance: float
) -> tuple[SolveStats, Tensor]:
    """Whether each sample is a well-posed minimum, and the Cholesky factor of its Hessian (the identity if not)."""
    end = derivatives(q, points, r, t)
    weight = torch.linalg.vector_norm(q, dim=-1).sum(-1).clamp_min(torch.finfo(q.dtype).tiny)
    residual = end.gradient.norm(dim=-1) / weight
    eye = torch.eye(6, dtype=q.dtype, device=q.device)
    trace = end.hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    # A Cholesky factor of H - c I exists when every eigenvalue exceeds c; eigenvalues would make the host wait.
    margin = (WELL_POSED * trace)[:, None, None] * eye
    _, info = torch.linalg.cholesky_ex(torch.nan_to_num(end.hessian) - margin)
    definite = (info == 0) & (trace > 0) & end.hessian.isfinite().all((-2, -1))
    converged = found & (residual <= tolerance) & definite & (t.norm(dim=-1) < FAR)
    factor, _ = torch.linalg.cholesky_ex(torch.where(converged[:, None, None], end.hessian, eye))
    residual = torch.where(found, residual, torch.inf)
    return SolveStats(iterations, residual, converged), factor


class WeightedPnP(nn.Module):
    """`weighted_pnp` with its options as a module.

    Args:
        method: newton, or lbfgs as in the paper.
        tolerance: norm of the gradient per unit of weight at which a sample stops, radians and scene radii.
        max_iterations: of the solver, at most.
    """

    def __init__(self, *, method: Method = "newton", tolerance: float = 1e-9, max_iterations: int = 50) -> None:
        super().__init__()
        self.method = method
        self.tolerance = tolerance
        self.max_iterations = max_iterations

    def forward(
        self,
        assignment: Float[Tensor, "b m n"],
        bearings: Float[Tensor, "b m 3"],
        points3d: Float[Tensor, "b n 3"],
        rotation: Float[Tensor, "b 3 3"],
        translation: Float[Tensor, "b 3"],
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        return weighted_pnp(
            assignment,
            bearings,
            points3d,
            rotation,
            translation,
            method=self.method,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )
