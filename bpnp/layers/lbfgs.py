"""L-BFGS with a strong Wolfe line search for the weighted PnP layer, the solver of the paper (section 3.3)."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.geometry import retract

Array = NDArray[np.float64]

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
    """Minimise the objective of one sample.

    Args:
        q: Weighted bearings (3, n).
        points: Scene points (3, n).
        rotation: Initial R (3, 3).
        translation: Initial t (3,).
        tolerance: Gradient norm at which to stop.
        max_iterations: Largest number of iterations.

    Returns:
        The step (w, s) from the initial pose to the minimum (6,), and the number of iterations.
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
    """Return sum_j |q_j| - q_j . g(exp([w]x) R p_j + t + s), and its gradient in the step (w, s).

    The constant sum |q_j| keeps the digits of the value where the residuals are small. With the rotated points x_j and
    the derivative h_j of a term in its camera point, the gradient is (J(w)^T sum x_j cross h_j, sum h_j), where J(w) is
    the left Jacobian of SO(3): exp([w + d]x) = exp([J(w) d]x) exp([w]x) to first order in d.

    Args:
        step: (w, s), (6,).
        q: Weighted bearings q_j (3, n).
        turned: R p_j (3, n).
        translation: t (3,).
        weights: |q_j| (n,).
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
