"""L-BFGS with a strong Wolfe line search for the weighted PnP layer, the solver of the paper (section 3.3)."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.arrays import Array
from bpnp.geometry import retract

HISTORY = 10  # pairs of steps and gradients that estimate the curvature
EVALUATIONS = 25  # largest number of objective evaluations per iteration
SMALL = 1e-4  # radians; below it the coefficient (x - sin x) / x^3 is its series


def lbfgs(
    q: Float[Tensor, "b 3 n"],
    points: Float[Tensor, "b 3 n"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Int[Tensor, " b"]]:
    """Minimise the aggregated PnP objective with `torch.optim.LBFGS`, sample by sample, and count the iterations.

    The unknowns are an angle-axis vector, relative to the initial pose, and the translation. The weights of a sample in
    q sum to one, and the points have unit size. A sample stops at the gradient norm `tolerance`; rounding of the
    objective ends the line search at about 1e-10.
    """
    problem = [values.cpu().double().contiguous().numpy() for values in (q, points, rotation, translation)]
    found = [
        _minimise(*sample, tolerance=tolerance, max_iterations=max_iterations) for sample in zip(*problem, strict=True)
    ]
    steps = torch.from_numpy(np.array([step for step, _ in found]).reshape(-1, 6)).to(q)
    iterations = torch.tensor([count for _, count in found], dtype=torch.long, device=q.device)
    return *retract(steps, rotation, translation), iterations


def _minimise(
    q: Array, points: Array, rotation: Array, translation: Array, *, tolerance: float, max_iterations: int
) -> tuple[Array, int]:
    """Return the step (w, s) (6,) from the initial pose to the minimum of one sample, and the number of iterations.

    q and the points are (3, n); the gradient norm `tolerance` ends it.
    """
    # The optimiser changes its parameter in place, which a trainer's inference mode forbids.
    with torch.inference_mode(False):
        step = torch.zeros(6, dtype=torch.float64, device="cpu", requires_grad=True)
        optimiser = torch.optim.LBFGS(
            [step],
            max_iter=max_iterations,
            max_eval=EVALUATIONS * max_iterations,
            history_size=HISTORY,
            tolerance_grad=tolerance / 6**0.5,  # of the largest component
            tolerance_change=0.0,
            line_search_fn="strong_wolfe",
        )
        turned, weights = rotation @ points, np.linalg.norm(q, axis=0)

        def objective() -> Tensor:
            value, gradient = _value_and_gradient(step.detach().numpy(), q, turned, translation, weights)
            step.grad = torch.from_numpy(gradient)
            return torch.tensor(value, dtype=torch.float64, device="cpu")

        optimiser.step(objective)
        return step.detach().numpy(), int(optimiser.state[step]["n_iter"])


def _value_and_gradient(step: Array, q: Array, turned: Array, translation: Array, weights: Array) -> tuple[Any, Array]:
    """Return sum_j |q_j| - q_j . g(exp([w]x) R p_j + t + s), and its gradient in the step (w, s), (6,).

    The constant sum |q_j| keeps the digits of the value where the residuals are small. With the rotated points x_j = R
    p_j, `turned` (3, n), and the derivative h_j of a term in its camera point, the gradient is (J(w)^T sum x_j cross
    h_j, sum h_j), where J(w) is the left Jacobian of SO(3): exp([w + d]x) = exp([J(w) d]x) exp([w]x) to first order in
    d. The weights are |q_j| (n,).
    """
    rotation, jacobian = _exponential(step[:3])
    x = rotation @ turned
    y = x + (translation + step[3:])[:, None]
    inverse = 1 / np.sqrt((y * y).sum(0))
    u = inverse * y
    along = (q * u).sum(0)
    h = inverse * (along * u - q)
    outer = x @ h.T
    twist = np.array([outer[1, 2] - outer[2, 1], outer[2, 0] - outer[0, 2], outer[0, 1] - outer[1, 0]])
    return (weights - along).sum(), np.concatenate([jacobian.T @ twist, h.sum(1)])


def _exponential(w: Array) -> tuple[Array, Array]:
    """Return exp([w]x) and the left Jacobian of SO(3) at w, both (3, 3), for an angle-axis vector (3,)."""
    angle = np.linalg.norm(w)
    first = np.sinc(angle / np.pi)  # sin(angle) / angle
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos(angle)) / angle^2
    third = (1 - first) / angle**2 if angle > SMALL else 1 / 6 - angle**2 / 120
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    square = cross @ cross
    return np.eye(3) + first * cross + second * square, np.eye(3) + second * cross + third * square
