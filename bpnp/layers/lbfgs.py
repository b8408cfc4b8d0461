"""L-BFGS with a strong Wolfe line search for the weighted PnP layer, the solver of the paper (section 3.3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import retract

HISTORY = 10  # pairs of steps and gradients that estimate the curvature
EVALUATIONS = 25  # largest number of objective evaluations per iteration


def lbfgs(
    q: Float[Tensor, "b 3 n"],
    points: Float[Tensor, "b 3 n"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Int[Tensor, " b"]]:
    """Minimise the aggregated PnP objective with `torch.optim.LBFGS`, sample by sample.

    The unknowns are an angle-axis vector, relative to the initial pose, and the translation.

    Args:
        q: Weighted bearings (b, 3, n), the weights of a sample summing to one.
        points: Scene points of unit size (b, 3, n).
        rotation: Initial R (b, 3, 3).
        translation: Initial t (b, 3).
        tolerance: Gradient norm at which a sample stops. Rounding of the objective ends the line search at about 1e-10.
        max_iterations: Largest number of iterations of a sample.

    Returns:
        Rotation (b, 3, 3), translation (b, 3) and the iterations of each sample (b,).
    """
    # The optimiser needs gradients, which a trainer's inference mode forbids, also for tensors made within it.
    with torch.inference_mode(False):
        problem = q.clone(), points.clone(), rotation.clone(), translation.clone()
        steps = torch.zeros(len(q), 6, dtype=q.dtype, device=q.device)
        iterations = torch.zeros(len(q), dtype=torch.long, device=q.device)
        for i, sample in enumerate(zip(*problem, strict=True)):
            steps[i], iterations[i] = _minimise(*sample, tolerance=tolerance, max_iterations=max_iterations)
    rotation, translation = retract(steps, rotation, translation)
    return rotation, translation, iterations


def _minimise(
    q: Float[Tensor, "3 n"],
    points: Float[Tensor, "3 n"],
    rotation: Float[Tensor, "3 3"],
    translation: Float[Tensor, "3"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "6"], int]:
    """Minimise the objective of one sample.

    Returns:
        The step (w, s) from the initial pose to the minimum (6,), and the number of iterations.
    """
    step = torch.zeros(6, dtype=q.dtype, device=q.device, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [step],
        max_iter=max_iterations,
        max_eval=EVALUATIONS * max_iterations,
        history_size=HISTORY,
        tolerance_grad=tolerance / 6**0.5,  # of the largest component
        tolerance_change=0.0,
        line_search_fn="strong_wolfe",
    )
    weights = q.norm(dim=0)

    def objective() -> Tensor:
        optimiser.zero_grad()
        with torch.enable_grad():
            r, t = retract(step, rotation, translation)
            y = r @ points + t[:, None]
            # Adding the constant sum |q| keeps the digits of the value where the residuals are small.
            value = (weights - (q * torch.nn.functional.normalize(y, dim=0)).sum(0)).sum()
            value.backward()
        return value.detach()

    optimiser.step(objective)
    return step.detach(), int(optimiser.state[step]["n_iter"])
