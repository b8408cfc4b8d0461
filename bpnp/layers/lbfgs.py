"""The paper's solver of the weighted PnP: L-BFGS with a strong Wolfe line search on the dense objective."""

from functools import partial

import roma
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bpnp.layers.objective import Rotations, Translations, dense_objective


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
    """Pose near the start at which the gradient's norm per unit of weight is at most `tolerance`, and iterations.

    One sample at a time, so that no pose depends on its neighbours' line searches. The pose is an angle-axis vector
    and a translation; the weight of a sample is sum_j |sum_i P_ij f_i|.
    """
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
    pose.grad = None
    with torch.enable_grad():
        rotation, translation = roma.rotvec_to_rotmat(pose[None, :3]), pose[None, 3:]
        value = dense_objective(assignment[None], bearings[None], points[None], rotation, translation).sum()
        value.backward()
    return value
