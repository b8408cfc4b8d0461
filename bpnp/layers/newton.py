"""Newton's method with Levenberg's damping on the aggregated PnP objective, for all samples of a batch at once."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import retract
from bpnp.layers.objective import Derivatives, derivatives

EQUAL = 1e-13  # values of the objective (weights sum to one) that agree to this differ by rounding only


def newton(
    q: Float[Tensor, "b 3 n"],
    points: Float[Tensor, "b 3 n"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Int[Tensor, " b"]]:
    """Pose near the start at which the gradient's norm is at most `tolerance`, and the iterations of each sample.

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
        rotation = torch.where(accept[:, None, None], new_rotation, rotation)
        translation = torch.where(accept[:, None], new_translation, translation)
        current = _choose(accept, trial, current)
        raised = (10 * damping).clamp_min(1e-3)
        lowered = torch.where(damping > 1e-6, damping / 10, 0)
        damping = torch.where(active, torch.where(accept, lowered, raised), damping)
    return rotation, translation, iterations


def _choose(accept: Tensor, trial: Derivatives, current: Derivatives) -> Derivatives:
    return Derivatives(
        torch.where(accept, trial.value, current.value),
        torch.where(accept[:, None], trial.gradient, current.gradient),
        torch.where(accept[:, None, None], trial.hessian, current.hessian),
    )
