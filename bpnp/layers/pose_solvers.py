"""The solvers of the weighted PnP: Newton's method for a whole batch, and the paper's L-BFGS, sample by sample."""

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import choose, retract
from bpnp.layers.objective import Columns, Derivatives, Rotations, Translations, dense_objective, derivatives

EQUAL = 1e-13  # values of the objective (weights sum to one) that agree to this differ by rounding only


def newton(
    q: Columns,
    points: Columns,
    rotation: Rotations,
    translation: Translations,
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Rotations, Translations, Int[Tensor, " b"]]:
    """Newton's method with Levenberg's damping on the aggregated objective, for all samples of a batch at once.

    Returns the pose near the start at which the gradient's norm is at most `tolerance`, and the iterations per sample.
    q, points: weighted bearings and points of unit size, the weights of a sample summing to one. Each sample has its
    own damping, zero until a step fails, and its own stop.
    """
    current = derivatives(q, points, rotation, translation)
    damping = torch.zeros_like(current.value)
    iterations = torch.zeros(len(q), dtype=torch.long, device=q.device)
    eye = torch.eye(6, dtype=q.dtype, device=q.device)
    for _ in range(max_iterations):
        active = current.gradient.norm(dim=-1) > tolerance
        if not bool(active.any()):
            break
        iterations += active
        factor, info = torch.linalg.cholesky_ex(current.hessian + damping[:, None, None] * eye)
        step = -torch.cholesky_solve(current.gradient.unsqueeze(-1), factor).squeeze(-1)
        usable = active & (info == 0) & step.isfinite().all(-1)
        new_rotation, new_translation = retract(torch.where(usable[:, None], step, 0), rotation, translation)
        trial = derivatives(q, points, new_rotation, new_translation)
        # Near the optimum the values agree to rounding; there the smaller gradient decides.
        flat = (trial.value - current.value).abs() <= EQUAL
        lower = (trial.value < current.value) | (flat & (trial.gradient.norm(dim=-1) < current.gradient.norm(dim=-1)))
        accept = usable & lower
        rotation, translation = choose(accept, new_rotation, rotation), choose(accept, new_translation, translation)
        current = Derivatives(*(choose(accept, *both) for both in zip(trial, current, strict=True)))
        raised = (10 * damping).clamp_min(1e-3)
        lowered = torch.where(damping > 1e-6, damping / 10, 0)
        damping = torch.where(active, torch.where(accept, lowered, raised), damping)
    return rotation, translation, iterations


def lbfgs(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Rotations,
    translation: Translations,
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Rotations, Translations, Int[Tensor, " b"]]:
    """L-BFGS with a strong Wolfe line search on the dense objective, as `newton` with a tolerance per unit of weight.

    One sample at a time, so that no pose depends on its neighbours' line searches. The pose is an angle-axis vector
    and a translation; the weight of a sample is sum_j |sum_i P_ij f_i|.
    """
    import roma  # as in `bpnp.geometry.retract`

    rotations, translations, iterations = [], [], []
    for p, f, x, r0, t0 in zip(assignment, bearings, points3d, rotation, translation, strict=True):
        pose = torch.cat([roma.rotmat_to_rotvec(r0), t0]).requires_grad_()
        weight = float(torch.linalg.vector_norm(p.mT @ f, dim=-1).sum())
        optimiser = torch.optim.LBFGS(
            [pose],
            max_iter=max_iterations,
            tolerance_grad=0.01 * tolerance * weight,  # it bounds the largest entry; in other units than `tolerance`
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )
        optimiser.step(partial(_evaluate, pose, p, f, x))
        iterations.append(optimiser.state[pose]["n_iter"])
        rotations.append(roma.rotvec_to_rotmat(pose[:3].detach()))
        translations.append(pose[3:].detach())
    return torch.stack(rotations), torch.stack(translations), torch.tensor(iterations, device=points3d.device)


def _evaluate(pose: Tensor, assignment: Tensor, bearings: Tensor, points: Tensor) -> Tensor:
    """Value of Eq. 7 at an angle-axis vector and translation; its gradient is left in `pose.grad`."""
    import roma  # as above

    pose.grad = None
    with torch.enable_grad():
        rotation, translation = roma.rotvec_to_rotmat(pose[None, :3]), pose[None, 3:]
        value = dense_objective(assignment[None], bearings[None], points[None], rotation, translation).sum()
        value.backward()
    return value
