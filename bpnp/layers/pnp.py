"""The weighted blind PnP layer (paper Eq. 7): from a start to the pose that best explains a soft assignment.

The solver is Newton's method on the aggregated objective, or the paper's L-BFGS on the dense one. Both end at the same
optimum; its gradient (`bpnp.layers.implicit`) does not depend on the solver.
"""

from typing import Literal, NamedTuple

import roma
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.checks import checked_shapes
from bpnp.geometry import hat, is_finite
from bpnp.layers.implicit import at_optimum
from bpnp.layers.lbfgs import lbfgs
from bpnp.layers.newton import newton
from bpnp.layers.objective import aggregate, derivatives, pose_gradient
from bpnp.precision import full_precision
from bpnp.types import SolveStats

Method = Literal["newton", "lbfgs"]
FARTHEST = 1e4  # scene radii; beyond this distance all bearings coincide: the solver has diverged
LINE_SEARCH_TOLERANCE = 1e-7  # smallest gradient that a line search on values in float64 can tell from zero
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
    method: Method = "newton",
    tolerance: float = 1e-9,
    max_iterations: int = 50,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """argmin over (R, t) of sum_ij P_ij (1 - f_i . g(R p_j + t)), g(y) = y / |y|, near a start (paper Eq. 7).

    assignment: P, zero at padded points; its total does not matter.
    bearings: unit vectors f_i (`bpnp.geometry.bearings` of image points).
    points3d: p_j in scene units.
    rotation, translation: the start, camera = R p + t; no gradient flows to it. A sample whose start is
        NaN has no pose.
    method: "newton", damped, O(n) an iteration; "lbfgs", the paper's, O(m n) an evaluation.
    tolerance: largest norm of the objective's gradient per unit of weight, in radians and scene radii; for "lbfgs" at
        least 1e-7.
    max_iterations: of the solver, for each sample.

    Returns rotation, translation and stats per sample (residual: the norm that is compared with the tolerance). The
    solver runs in float64; the results have the dtype of the assignment. Gradients flow to assignment, bearings and
    points3d by the implicit function theorem with the true Hessian (Lemma 1). `converged` is False, and the gradient
    zero, where the start is missing, the tolerance was not met, the camera is farther than 10^4 scene radii or the
    Hessian is not positive definite: leave such samples out of a loss. There is no second derivative.
    Raises ValueError for an unknown method, shapes that do not fit, an empty axis or integers.

    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> start = torch.eye(3)[None], torch.tensor([[0.1, 0.2, 4.5]])
    >>> R, t, stats = weighted_pnp(torch.eye(4)[None] / 4, bearings, points3d, *start)
    >>> bool(stats.converged), (t - torch.tensor([0, 0, 4])).abs().max().item() < 1e-5
    (True, True)
    """
    if method not in ("newton", "lbfgs"):
        raise ValueError(f"expected `method` 'newton' or 'lbfgs', got {method!r}")
    return _optimum(assignment, bearings, points3d, rotation, translation, method, tolerance, max_iterations)


def _optimum(
    assignment: Tensor, bearings: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor, method: Method,
    tolerance: float, max_iterations: int,
) -> tuple[Tensor, Tensor, SolveStats]:  # fmt: skip
    """The optimum in float64, linked to the arguments that it depends on."""
    q = _unit_weight(aggregate(assignment, bearings).double())
    points, frame = _normalise(points3d.double().mT.contiguous(), q.detach())
    with torch.no_grad():
        found = is_finite(rotation, translation)
        start = _start(rotation.double(), translation.double(), found, frame)
        if method == "newton":
            r, t, iterations = newton(q, points, *start, tolerance=tolerance, max_iterations=max_iterations)
        else:
            tolerance = max(tolerance, LINE_SEARCH_TOLERANCE)
            dense = assignment.double(), bearings.double(), points.mT
            r, t, iterations = lbfgs(*dense, *start, tolerance=tolerance, max_iterations=max_iterations)
        stats, factor = _judge(q, points, r, t, found, iterations, tolerance)

    def solve_adjoint(gradient: Tensor) -> Tensor:
        adjoint = torch.cholesky_solve(gradient.unsqueeze(-1), factor).squeeze(-1)
        return torch.where(stats.converged[:, None], adjoint, 0)

    zero = torch.zeros_like(factor[:, 0])
    step = at_optimum(zero, lambda _, q, p: pose_gradient(q, p, r, t), solve_adjoint, q, points)
    # The step is zero: exp([w]x) R = R + [w]x R is exact, in the derivative too.
    moved_r = r + hat(step[:, :3]) @ r
    moved_t = frame.leave(moved_r, t + step[:, 3:])
    moved_r = torch.where(found[:, None, None], moved_r, torch.nan)
    moved_t = torch.where(found[:, None], moved_t, torch.nan)
    return moved_r.to(assignment.dtype), moved_t.to(assignment.dtype), stats


class _Frame(NamedTuple):
    """Scene coordinates p = scale * p' + centre in which the points have unit size; keeps the Hessian well scaled."""

    centre: Float[Tensor, "b 3"]
    scale: Float[Tensor, "b 1"]

    def enter(self, rotation: Tensor, translation: Tensor) -> Tensor:
        return (translation + (rotation @ self.centre.unsqueeze(-1)).squeeze(-1)) / self.scale

    def leave(self, rotation: Tensor, translation: Tensor) -> Tensor:
        return translation * self.scale - (rotation @ self.centre.unsqueeze(-1)).squeeze(-1)


def _lengths(columns: Float[Tensor, "b 3 n"]) -> Float[Tensor, "b 1 n"]:
    return columns.square().sum(-2, keepdim=True).sqrt()


def _unit_weight(q: Float[Tensor, "b 3 n"]) -> Float[Tensor, "b 3 n"]:
    """q_j times a constant, so that their lengths sum to one: the optimum is the same, for the objective is linear."""
    total = _lengths(q.detach()).sum(-1, keepdim=True)
    return q / total.clamp_min(torch.finfo(q.dtype).tiny)


def _normalise(points: Float[Tensor, "b 3 n"], q: Float[Tensor, "b 3 n"]) -> tuple[Float[Tensor, "b 3 n"], _Frame]:
    """Points with weighted mean zero and weighted mean square one, and the frame that they are in."""
    weight, fixed = _lengths(q), points.detach()
    centre = (weight * fixed).sum(-1)
    scale = (weight * (fixed - centre.unsqueeze(-1)).square()).sum((-2, -1)).sqrt().unsqueeze(-1)
    scale = torch.where(scale > 0, scale, 1)
    return (points - centre.unsqueeze(-1)) / scale.unsqueeze(-1), _Frame(centre, scale)


def _start(rotation: Tensor, translation: Tensor, found: Bool[Tensor, " b"], frame: _Frame) -> tuple[Tensor, Tensor]:
    """The start in the frame; any pose for samples that have none. The nearest rotation to a rounded one."""
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    r = roma.special_procrustes(torch.where(found[:, None, None], rotation, eye))
    return r, frame.enter(r, torch.where(found[:, None], translation, 1))


def _judge(
    q: Tensor, points: Tensor, r: Tensor, t: Tensor, found: Tensor, iterations: Int[Tensor, " b"], tolerance: float
) -> tuple[SolveStats, Float[Tensor, "b 6 6"]]:
    """Whether each sample is a well-posed minimum, and the Cholesky factor of its Hessian (the identity if not)."""
    end = derivatives(q, points, r, t)
    residual = end.gradient.norm(dim=-1)
    eye = torch.eye(6, dtype=q.dtype, device=q.device)
    trace = end.hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    # A Cholesky factor of H - c I exists if and only if every eigenvalue of H exceeds c.
    margin = (WELL_POSED * trace)[:, None, None] * eye
    _, info = torch.linalg.cholesky_ex(torch.nan_to_num(end.hessian) - margin)
    definite = (info == 0) & (trace > 0) & end.hessian.isfinite().all((-2, -1))
    converged = found & (residual <= tolerance) & definite & (t.norm(dim=-1) < FARTHEST)
    factor, _ = torch.linalg.cholesky_ex(torch.where(converged[:, None, None], end.hessian, eye))
    return SolveStats(iterations, torch.where(found, residual, torch.inf), converged), factor


class WeightedPnP(nn.Module):
    """`weighted_pnp` with its options as a module.

    Args:
        method: newton, or lbfgs as in the paper.
        tolerance: norm of the gradient per unit of weight at which a sample stops, radians and scene radii.
        max_iterations: of the solver, at most.

    >>> layer = WeightedPnP(max_iterations=20)
    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> _, _, stats = layer(torch.eye(4)[None] / 4, bearings, points3d, torch.eye(3)[None], torch.tensor([[0.0, 0, 5]]))
    >>> stats.converged
    tensor([True])
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
