"""Newton's method with Levenberg's damping on the aggregated PnP objective, for all samples of a batch at once."""

import torch
from jaxtyping import Int
from torch import Tensor

from bpnp.geometry import retract
from bpnp.layers.objective import Columns, Derivatives, Rotations, Translations, derivatives

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
        rotation, translation = _where(accept, new_rotation, rotation), _where(accept, new_translation, translation)
        current = Derivatives(*(_where(accept, *pair) for pair in zip(trial, current, strict=True)))
        raised = (10 * damping).clamp_min(1e-3)
        lowered = torch.where(damping > 1e-6, damping / 10, 0)
        damping = torch.where(active, torch.where(accept, lowered, raised), damping)
    return rotation, translation, iterations


def _where(accept: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """`new` for the samples that accept it."""
    return torch.where(accept.view(-1, *(1 for _ in old.shape[1:])), new, old)
