"""L-BFGS with a strong Wolfe line search for the weighted PnP layer: the solver of the paper (section 3.3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.geometry import retract

HISTORY = 10  # pairs of steps and gradients from which the curvature is estimated
EVALUATIONS = 25  # of the objective per iteration, at most


def lbfgs(
    q: Float[Tensor, "b 3 n"],
    points: Float[Tensor, "b 3 n"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Int[Tensor, " b"]]:
    """Minimise the aggregated PnP objective with `torch.optim.LBFGS`, each sample by itself.

    The unknowns are an angle-axis vector, relative to the start, and the translation.

    Args:
        q: weighted bearings, the weights of a sample summing to one.
        points: scene points of unit size.
        rotation: of the start.
        translation: of the start.
        tolerance: gradient norm at which a sample stops. Rounding of the objective ends the line search at some 1e-10.
        max_iterations: of each sample.

    Returns:
        Rotation, translation and the iterations of each sample.
    """
    # A trainer's inference mode would forbid the optimiser's gradients, of its tensors too.
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
    """Return the step (w, s) from the start to the minimum of one sample, and the iterations."""
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
            # sum |q| is constant; with it the sum has digits left where the residuals are small
            value = (weights - (q * torch.nn.functional.normalize(y, dim=0)).sum(0)).sum()
            value.backward()
        return value.detach()

    optimiser.step(objective)
    return step.detach(), int(optimiser.state[step]["n_iter"])
