"""The weighted blind PnP layer (paper Eq. 7): from a start to the pose that best explains a soft assignment."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.checks import checked_shapes
from bpnp.geometry import hat, is_finite
from bpnp.layers.implicit import refuse_second_derivative
from bpnp.layers.objective import (
    Columns,
    Derivatives,
    Rotations,
    Translations,
    aggregate,
    derivatives,
    newton,
    pose_gradient,
)
from bpnp.precision import full_precision
from bpnp.types import SolveStats

FARTHEST = 1e4  # scene radii; beyond this distance all bearings coincide: the solver has diverged
WELL_POSED = 1e-9  # smallest Hessian eigenvalue, as a part of the trace, at which the pose has a derivative


@checked_shapes
@full_precision
def weighted_pnp(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 50,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """argmin over (R, t) of sum_ij P_ij (1 - f_i . g(R p_j + t)), g(y) = y / |y|, near a start (paper Eq. 7).

    assignment: P, zero at padded points; its total does not matter.
    bearings: unit vectors f_i (`bpnp.geometry.bearings` of image points).
    points3d: p_j in scene units.
    rotation, translation: the start, camera = R p + t; no gradient flows to it. A sample whose start is
        NaN has no pose.
    tolerance: largest norm of the objective's gradient per unit of weight, in radians and scene radii.
    max_iterations: of damped Newton steps, O(n) each, for each sample. The paper has L-BFGS, for the same optimum.

    Returns rotation, translation and stats per sample (residual: the norm that is compared with the tolerance). The
    solver runs in float64; the results have the dtype of the assignment. Gradients flow to assignment, bearings and
    points3d by the implicit function theorem with the true Hessian (Lemma 1). `converged` is False, and the gradient
    zero, where the start is missing, the tolerance was not met, the camera is farther than 10^4 scene radii or the
    Hessian is not positive definite: leave such samples out of a loss. There is no second derivative.
    Raises ValueError for shapes that do not fit, an empty axis or integers.

    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> start = torch.eye(3)[None], torch.tensor([[0.1, 0.2, 4.5]])
    >>> R, t, stats = weighted_pnp(torch.eye(4)[None] / 4, bearings, points3d, *start)
    >>> bool(stats.converged), (t - torch.tensor([0, 0, 4])).abs().max().item() < 1e-5
    (True, True)
    """
    import roma  # as in `bpnp.geometry.retract`

    q = aggregate(assignment, bearings).double()
    # The optimum does not depend on a factor of the weights |q_j|; here they sum to one.
    q = q / _lengths(q.detach()).sum(-1, keepdim=True).clamp_min(torch.finfo(q.dtype).tiny)
    points, centre, scale = _normalised(points3d.double().mT.contiguous(), _lengths(q.detach()))
    with torch.no_grad():
        found = is_finite(rotation, translation)
        # The rotation nearest to a rounded one; any pose for samples that have none.
        r = torch.where(found[:, None, None], rotation.double(), torch.eye(3).to(q))
        r = roma.special_procrustes(r)
        t = (torch.where(found[:, None], translation.double(), 1) + _turned(r, centre)) / scale
        r, t, iterations = newton(q, points, r, t, tolerance=tolerance, max_iterations=max_iterations)
        residual, well_posed, factor = _judge(derivatives(q, points, r, t))
        converged = found & (residual <= tolerance) & well_posed & (t.norm(dim=-1) < FARTHEST)

    # One more Newton step y - H^-1 F(y, x), H held fixed, has the derivative -H^-1 dF/dx of the optimum y(x).
    optimality = pose_gradient(q, points, r, t)
    step = -torch.cholesky_solve(optimality.unsqueeze(-1), factor).squeeze(-1)
    step = torch.where(converged[:, None], step - step.detach(), 0)
    if step.requires_grad:
        step.register_hook(refuse_second_derivative)
    # The step is zero: exp([w]x) R = R + [w]x R is exact, in the derivative too.
    moved_r = r + hat(step[:, :3]) @ r
    moved_t = (t + step[:, 3:]) * scale - _turned(moved_r, centre)
    moved_r = torch.where(found[:, None, None], moved_r, torch.nan).to(assignment.dtype)
    moved_t = torch.where(found[:, None], moved_t, torch.nan).to(assignment.dtype)
    return moved_r, moved_t, SolveStats(iterations, torch.where(found, residual, torch.inf), converged)


def _lengths(columns: Columns) -> Float[Tensor, "b 1 n"]:
    return columns.square().sum(-2, keepdim=True).sqrt()


def _turned(rotation: Rotations, vector: Translations) -> Translations:
    return (rotation @ vector.unsqueeze(-1)).squeeze(-1)


def _normalised(points: Columns, weight: Float[Tensor, "b 1 n"]) -> tuple[Columns, Translations, Float[Tensor, "b 1"]]:
    """Points p' with weighted mean zero and mean square one, centre and scale in p = scale p' + centre.

    The Hessian is well scaled in these coordinates.
    """
    fixed = points.detach()
    centre = (weight * fixed).sum(-1)
    scale = (weight * (fixed - centre.unsqueeze(-1)).square()).sum((-2, -1)).sqrt().unsqueeze(-1)
    scale = torch.where(scale > 0, scale, 1)
    return (points - centre.unsqueeze(-1)) / scale.unsqueeze(-1), centre, scale


def _judge(end: Derivatives) -> tuple[Float[Tensor, " b"], Bool[Tensor, " b"], Float[Tensor, "b 6 6"]]:
    """Norm of the gradient, which samples are well-posed minima, and the Cholesky factor of their Hessians (the
    identity for the others)."""
    eye = torch.eye(6).to(end.hessian)
    trace = end.hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    # A Cholesky factor of H - c I exists if and only if every eigenvalue of H exceeds c.
    margin = (WELL_POSED * trace)[:, None, None] * eye
    _, info = torch.linalg.cholesky_ex(torch.nan_to_num(end.hessian) - margin)
    well_posed = (info == 0) & (trace > 0) & end.hessian.isfinite().all((-2, -1))
    factor, _ = torch.linalg.cholesky_ex(torch.where(well_posed[:, None, None], end.hessian, eye))
    return end.gradient.norm(dim=-1), well_posed, factor


class WeightedPnP(nn.Module):
    """`weighted_pnp` with its options as a module.

    Args:
        tolerance: norm of the gradient per unit of weight at which a sample stops, radians and scene radii.
        max_iterations: Newton steps, at most.

    >>> layer = WeightedPnP(max_iterations=20)
    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> _, _, stats = layer(torch.eye(4)[None] / 4, bearings, points3d, torch.eye(3)[None], torch.tensor([[0.0, 0, 5]]))
    >>> stats.converged
    tensor([True])
    """

    def __init__(self, *, tolerance: float = 1e-9, max_iterations: int = 50) -> None:
        super().__init__()
        self.tolerance, self.max_iterations = tolerance, max_iterations

    def forward(
        self, assignment: Tensor, bearings: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        return weighted_pnp(
            assignment,
            bearings,
            points3d,
            rotation,
            translation,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )
