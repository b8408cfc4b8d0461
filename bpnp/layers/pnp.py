"""Weighted blind PnP layer (paper Eq. 8): from an initial pose to the pose that best explains a soft assignment.

The objective is f(R, t) = sum_ij P_ij (1 - f_i . g(R p_j + t)) with g(y) = y / |y|. It is linear in the bearings: with
q_j = sum_i P_ij f_i, f = sum P - sum_j q_j . g(R p_j + t). After one product, an evaluation costs O(n), not O(m n).

A step (w, s) acts on the left: y = exp([w]x) R p + t + s. The q_j and p_j are columns of (b, 3, n) tensors, because
torch sums three rows of n numbers faster than n rows of three.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.checks import check_shapes
from bpnp.geometry import choose, hat, is_finite, retract
from bpnp.layers.implicit import first_derivative, refuse_second_derivative
from bpnp.layers.lbfgs import lbfgs
from bpnp.precision import full_precision
from bpnp.types import SolveStats

Columns = Float[Tensor, "b 3 n"]
Rotations = Float[Tensor, "b 3 3"]
Translations = Float[Tensor, "b 3"]
NEAR = 1e-12  # scene radii; smaller distances are set to this: a point at the camera centre has no direction
FARTHEST = 1e4  # scene radii; beyond this distance all bearings coincide: the solver has diverged
WELL_POSED = 1e-9  # smallest Hessian eigenvalue, as a fraction of the trace, for which the pose has a derivative


Solver = Literal["newton", "lbfgs"]


@dataclass
class ClippedColumns:
    """Number of columns of the pose's derivative in backward passes, and of those that were clipped.

    Column ij is the derivative of the pose (angle-axis, translation) with respect to P_ij.

    Attributes:
        columns: Columns so far.
        clipped: Columns whose norm was reduced.
    """

    columns: int = 0
    clipped: int = 0

    def reset(self) -> None:
        """Set both counts to zero."""
        self.columns = self.clipped = 0


class _Aggregate(torch.autograd.Function):
    """F^T P (b, 3, n): q_j = sum_i P_ij f_i, the mean bearing of each 3D point times the point's weight.

    Its gradients are exact products too. With `grams` (b, n, 3, 3) and `limit`, f_i^T grams_j f_i is the squared norm
    of column ij, and the gradient of P_ij is that of the column scaled down to the norm `limit`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        assignment: Tensor,
        bearings: Tensor,
        grams: Tensor | None = None,
        limit: float = math.inf,
        count: ClippedColumns | None = None,
    ) -> Tensor:
        ctx.save_for_backward(assignment, bearings, grams)
        ctx.limit, ctx.count = limit, count
        return bearings.mT @ assignment

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        assignment, bearings, grams = ctx.saved_tensors
        to_assignment, to_bearings = ctx.needs_input_grad[:2]
        of_assignment = bearings @ gradient if to_assignment else None
        if of_assignment is not None and grams is not None:
            outer = (bearings.unsqueeze(-1) * bearings.unsqueeze(-2)).flatten(-2)
            norms = (outer.to(grams) @ grams.flatten(-2).mT).clamp_min(0).sqrt()
            if ctx.count is not None:
                real = assignment > 0
                ctx.count.columns += int(real.sum())
                ctx.count.clipped += int((real & (norms > ctx.limit)).sum())
            of_assignment = of_assignment * (ctx.limit / norms).clamp_max(1).to(of_assignment)
        of_bearings = assignment @ gradient.mT if to_bearings else None
        return of_assignment, of_bearings, None, None, None


class Derivatives(NamedTuple):
    """Value, gradient and Hessian of -sum_j q_j . g(R p_j + t) in the step (w, s), at zero."""

    value: Float[Tensor, " b"]
    gradient: Float[Tensor, "b 6"]
    hessian: Float[Tensor, "b 6 6"]


def derivatives(q: Columns, points: Columns, rotation: Rotations, translation: Translations) -> Derivatives:
    """Compute the value, gradient and Hessian of the objective together.

    With x = R p, y = x + t, d = |y|, u = y/d, the derivative of a term in y is h = ((q.u) u - q)/d, and its second
    derivative G = [(q.u)(I - 3 u u^T) + q u^T + u q^T]/d^2. Since dy = D (w, s) with D = [-[x]x, I], the Hessian is
    sum D^T G D, plus sym(x h^T) - (x.h) I in its rotation block, the second derivative of exp([w]x) x.
    G is written as (q.u)/d^2 I + v k^T + k v^T with v = u/d, k = (q - 1.5 (q.u) u)/d.

    Args:
        q: Weighted bearings (b, 3, n).
        points: Scene points (b, 3, n).
        rotation: R (b, 3, 3).
        translation: t (b, 3).
    """
    x = rotation @ points
    y = x + translation.unsqueeze(-1)
    u, inverse, h = _point_gradient(q, y)
    along = (q * u).sum(-2, keepdim=True)
    v = inverse * u
    k = inverse * q - 1.5 * along * v
    # D^T v = (x cross v, v), and x cross y = x cross t.
    dv = torch.cat([hat(translation).mT @ v, v], -2)
    dk = torch.cat([torch.linalg.cross(x, k, dim=-2), k], -2)
    low_rank = dv @ dk.mT
    curvature = along * inverse.square()
    weighted = curvature * x
    second, bend = x @ weighted.mT, x @ h.mT
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    # sum c D^T D = [[c (|x|^2 I - x x^T), c [x]x], [.., c I]]
    trace = (second - bend).diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    rotation_block = trace * eye - second + 0.5 * (bend + bend.mT)
    mixed = hat(weighted.sum(-1))
    top = torch.cat([rotation_block, mixed], -1)
    bottom = torch.cat([mixed.mT, curvature.sum(-1, keepdim=True) * eye], -1)
    hessian = low_rank + low_rank.mT + torch.cat([top, bottom], -2)
    return Derivatives(-along.sum((-2, -1)), _gradient(bend, h), hessian)


def _point_gradient(q: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return u = y/d (b, 3, n), 1/d (b, 1, n) with d = |y|, and h = ((q.u) u - q)/d (b, 3, n)."""
    inverse = y.square().sum(-2, keepdim=True).clamp_min(NEAR**2).rsqrt()
    u = inverse * y
    return u, inverse, ((q * u).sum(-2, keepdim=True) * u - q) * inverse


def _gradient(outer: Tensor, h: Tensor) -> Float[Tensor, "b 6"]:
    """Return (sum x cross h, sum h) of columns x, h, given outer = sum x h^T."""
    twist = outer - outer.mT
    return torch.stack([twist[:, 1, 2], twist[:, 2, 0], twist[:, 0, 1], *h.sum(-1).unbind(-1)], -1)


EQUAL = 1e-13  # a smaller difference of two objective values (weights sum to one) is rounding error


def newton(
    q: Columns,
    points: Columns,
    rotation: Rotations,
    translation: Translations,
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Rotations, Translations, Int[Tensor, " b"]]:
    """Minimise the aggregated objective by Newton's method with Levenberg damping, for the whole batch at once.

    Each sample has its own damping, zero until a step fails, and stops by itself.

    Args:
        q: Weighted bearings (b, 3, n), the weights of a sample summing to one.
        points: Scene points of unit size (b, 3, n).
        rotation: Initial R (b, 3, 3).
        translation: Initial t (b, 3).
        tolerance: Largest gradient norm at the result.
        max_iterations: Largest number of iterations of a sample.

    Returns:
        Rotation (b, 3, 3), translation (b, 3) and the iterations of each sample (b,).
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


SOLVERS = {"newton": newton, "lbfgs": lbfgs}


@check_shapes
@full_precision
def weighted_pnp(
    assignment: Float[Tensor, "b m n"],
    bearings: Float[Tensor, "b m 3"],
    points3d: Float[Tensor, "b n 3"],
    rotation: Float[Tensor, "b 3 3"],
    translation: Float[Tensor, "b 3"],
    *,
    solver: Solver = "newton",
    tolerance: float = 1e-9,
    max_iterations: int = 50,
    clip_columns: float | None = None,
    clipped: ClippedColumns | None = None,
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
    """Minimise sum_ij P_ij (1 - f_i . g(R p_j + t)), g(y) = y / |y|, over (R, t) near an initial pose (paper Eq. 8).

    Gradients flow to assignment, bearings and points3d by the implicit function theorem with the true Hessian (paper
    Lemma 1). There is no second derivative. The solver runs in float64.

    Args:
        assignment: P (b, m, n), zero at padded points; its total does not matter.
        bearings: Unit vectors f_i (b, m, 3), `bpnp.geometry.bearings` of image points.
        points3d: p_j (b, n, 3), scene units.
        rotation: Initial R (b, 3, 3), camera = R p + t, without a gradient. A sample whose initial pose or other
            input is not finite has no pose.
        translation: Initial t (b, 3), scene units.
        solver: "newton" (damped Newton steps for the whole batch) or "lbfgs" (L-BFGS with a strong Wolfe line search,
            as in the paper; sample by sample). Both find the same optimum.
        tolerance: Largest gradient norm of the objective per unit of weight, in radians and scene radii. L-BFGS does
            not get below about 1e-10.
        max_iterations: Largest number of iterations of a sample, O(n) each.
        clip_columns: Largest norm of a column of the pose's derivative, d(r, t) / dP_ij with the angle-axis vector r in
            radians and t in scene units, for P that sums to one. Longer columns are scaled down; the paper uses 100. It
            applies only to the gradient of the assignment. Default: None, the exact derivative.
        clipped: Counts the columns of backward passes, and those that were clipped.

    Returns:
        Rotation (b, 3, 3) and translation (b, 3) in the dtype of the assignment, float32 for half precision, and stats.
        `residual` is the gradient norm that is compared with the tolerance. `converged` is False, and the gradient
        zero, where an input is NaN or infinite, the tolerance was not met, the camera is farther than 10^4 scene radii,
        or the Hessian is not positive definite: leave such samples out of a loss.

    Raises:
        ValueError: An argument has a wrong shape or dtype, the solver is unknown, or `clip_columns` is not positive.

    >>> import torch
    >>> from bpnp.layers import weighted_pnp
    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> start = torch.eye(3)[None], torch.tensor([[0.1, 0.2, 4.5]])
    >>> R, t, stats = weighted_pnp(torch.eye(4)[None] / 4, bearings, points3d, *start)
    >>> bool(stats.converged), (t - torch.tensor([0, 0, 4])).abs().max().item() < 1e-5
    (True, True)
    """
    import roma  # as in `bpnp.geometry.retract`

    if solver not in SOLVERS:
        raise ValueError(f"`solver` is {solver!r}; it is one of {', '.join(SOLVERS)}")
    if clip_columns is not None and not clip_columns > 0:
        raise ValueError(f"`clip_columns` is {clip_columns}; it is a norm above 0, or None for no limit")
    bearings = bearings.to(assignment.dtype)
    with torch.no_grad():
        q: Columns = _Aggregate.apply(assignment, bearings).double()
        usable = q.isfinite().all((-2, -1)) & points3d.isfinite().all((-2, -1))
    if not bool(usable.all()):
        # Zeros have a zero gradient; that of NaN would be NaN, and that of the network with it.
        assignment, bearings, points3d = (
            torch.where(usable[:, None, None], values, 0) for values in (assignment, bearings, points3d)
        )
        q = choose(usable, q, torch.zeros_like(q))
    with torch.no_grad():
        # The optimum does not depend on a factor of the weights |q_j|; here they sum to one.
        total = _lengths(q).sum(-1, keepdim=True).clamp_min(torch.finfo(q.dtype).tiny)
        q = q / total
        weight = _lengths(q)
    points, centre, scale = _normalise(points3d.double().mT.contiguous(), weight)
    with torch.no_grad():
        found = usable & is_finite(rotation, translation)
        # Project a rounded rotation onto SO(3); samples without a pose get an arbitrary one.
        r = torch.where(found[:, None, None], rotation.double(), torch.eye(3, dtype=q.dtype, device=q.device))
        r = roma.special_procrustes(r)
        t = (torch.where(found[:, None], translation.double(), 1) + _rotate(r, centre)) / scale
        r, t, iterations = SOLVERS[solver](q, points.detach(), r, t, tolerance=tolerance, max_iterations=max_iterations)
        residual, well_posed, factor = _judge(derivatives(q, points, r, t))
        converged = found & (residual <= tolerance) & well_posed & (t.norm(dim=-1) < FARTHEST)
        grams = None
        if clip_columns is not None:
            to_scene = _scene_step(r, centre, scale)
            # The columns are those for a P that sums to one, as in the paper.
            unit = (assignment.sum((-2, -1)).double() / total[:, 0, 0])[:, None, None]
            grams = _column_grams(points, r, t, factor, unit * to_scene)

    limit = math.inf if clip_columns is None else clip_columns
    q = _Aggregate.apply(assignment, bearings, grams, limit, clipped).double() / total
    # One more Newton step y - H^-1 F(y, x), H held fixed, has the derivative -H^-1 dF/dx of the optimum y(x).
    rotated = r @ points
    *_, h = _point_gradient(q, rotated + t.unsqueeze(-1))
    optimality = _gradient(rotated @ h.mT, h)
    step = -torch.cholesky_solve(optimality.unsqueeze(-1), factor).squeeze(-1)
    step = torch.where(converged[:, None], step - step.detach(), 0)
    if step.requires_grad:
        step.register_hook(refuse_second_derivative)
    # The step is zero: exp([w]x) R = R + [w]x R is exact, in the derivative too.
    moved_r = r + hat(step[:, :3]) @ r
    moved_t = (t + step[:, 3:]) * scale - _rotate(moved_r, centre)
    moved_r = torch.where(found[:, None, None], moved_r, torch.nan).to(assignment.dtype)
    moved_t = torch.where(found[:, None], moved_t, torch.nan).to(assignment.dtype)
    return moved_r, moved_t, SolveStats(iterations, torch.where(found, residual, torch.inf), converged)


def _scene_step(rotation: Rotations, centre: Translations, scale: Float[Tensor, "b 1"]) -> Float[Tensor, "b 6 6"]:
    """Return the matrix from a step (w, s) in the solver's frame to one of (angle-axis r, t in scene units).

    t = scale t' - R c, so dt = scale s + (R c) x w; dr = J^-1 w with the left Jacobian J of exp at r.
    """
    import roma  # as in `bpnp.geometry.retract`

    r = roma.rotmat_to_rotvec(rotation)
    angle = r.norm(dim=-1).clamp_min(1e-6)[:, None, None]
    turn, eye = hat(r), torch.eye(3, dtype=r.dtype, device=r.device)
    # (1 / a^2 - cot(a / 2) / (2 a)), which tends to 1 / 12
    bend = 1 / angle**2 - 1 / (2 * angle * torch.tan(angle / 2))
    inverse = eye - turn / 2 + torch.where(angle > 1e-3, bend, 1 / 12) * (turn @ turn)
    zero = torch.zeros_like(inverse)
    top = torch.cat([inverse, zero], -1)
    bottom = torch.cat([hat(_rotate(rotation, centre)), scale[:, :, None] * eye], -1)
    return torch.cat([top, bottom], -2)


def _column_grams(
    points: Columns,
    rotation: Rotations,
    translation: Translations,
    factor: Float[Tensor, "b 6 6"],
    to_scene: Float[Tensor, "b 6 6"],
) -> Float[Tensor, "b n 3 3"]:
    """Return A_j^T A_j (b, n, 3, 3) for the columns dy / dP_ij = A_j f_i of the pose's derivative.

    With u = g(y_j) and D = [-[x]x, I], the optimality condition has d/dP_ij = -D^T (I - u u^T) f_i / d; dy is minus the
    inverse Hessian times it. `factor` is the Cholesky factor of the Hessian.
    """
    x = rotation @ points
    u, inverse, _ = _point_gradient(torch.zeros_like(x), x + translation.unsqueeze(-1))
    x, u, inverse = x.mT, u.mT, inverse.mT.unsqueeze(-1)
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    project = inverse * (eye - u.unsqueeze(-1) * u.unsqueeze(-2))
    rows = torch.cat([hat(x) @ project, project], -2)  # D^T (I - u u^T) / d, D^T = [[x]x; I]
    b, n = rows.shape[:2]
    solved = torch.cholesky_solve(rows.permute(0, 2, 1, 3).reshape(b, 6, 3 * n), factor)
    columns = (to_scene @ solved).reshape(b, 6, n, 3).permute(0, 2, 1, 3)
    return columns.mT @ columns


def _lengths(columns: Columns) -> Float[Tensor, "b 1 n"]:
    return columns.square().sum(-2, keepdim=True).sqrt()


def _rotate(rotation: Rotations, vector: Translations) -> Translations:
    return (rotation @ vector.unsqueeze(-1)).squeeze(-1)


def _normalise(points: Columns, weight: Float[Tensor, "b 1 n"]) -> tuple[Columns, Translations, Float[Tensor, "b 1"]]:
    """Return p' with weighted mean zero and mean square one, and centre and scale in p = scale p' + centre.

    The Hessian is well scaled in these coordinates.
    """
    fixed = points.detach()
    centre = (weight * fixed).sum(-1)
    scale = (weight * (fixed - centre.unsqueeze(-1)).square()).sum((-2, -1)).sqrt().unsqueeze(-1)
    scale = torch.where(scale > 0, scale, 1)
    return (points - centre.unsqueeze(-1)) / scale.unsqueeze(-1), centre, scale


def _judge(end: Derivatives) -> tuple[Float[Tensor, " b"], Bool[Tensor, " b"], Float[Tensor, "b 6 6"]]:
    """Return the gradient norm, which samples are well-posed minima, and the Cholesky factors of their Hessians.

    The factor is the identity for the other samples.
    """
    eye = torch.eye(6, dtype=end.hessian.dtype, device=end.hessian.device)
    trace = end.hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    # A Cholesky factor of H - c I exists if and only if every eigenvalue of H exceeds c.
    margin = (WELL_POSED * trace)[:, None, None] * eye
    _, info = torch.linalg.cholesky_ex(torch.nan_to_num(end.hessian) - margin)
    well_posed = (info == 0) & (trace > 0) & end.hessian.isfinite().all((-2, -1))
    factor, _ = torch.linalg.cholesky_ex(torch.where(well_posed[:, None, None], end.hessian, eye))
    return end.gradient.norm(dim=-1), well_posed, factor


class WeightedPnP(nn.Module):
    """Weighted PnP as a module; see `weighted_pnp`.

    `clipped` counts the columns of the derivative in backward passes, and those that `clip_columns` shortened; call
    `clipped.reset()` after reading it.

    Args:
        solver: "newton", the default, or "lbfgs" for the paper's L-BFGS with a strong Wolfe line search.
        tolerance: Gradient norm per unit of weight at which a sample stops, radians and scene radii; default 1e-9.
        max_iterations: Largest number of iterations of a sample, default 50.
        clip_columns: Largest norm of a column of the derivative with respect to the assignment; the paper uses 100.
            Default: None, no limit.

    >>> import torch
    >>> from bpnp.layers import WeightedPnP
    >>> layer = WeightedPnP(max_iterations=20)
    >>> points3d = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    >>> bearings = torch.nn.functional.normalize(points3d + torch.tensor([0.0, 0, 4]), dim=-1)
    >>> _, _, stats = layer(torch.eye(4)[None] / 4, bearings, points3d, torch.eye(3)[None], torch.tensor([[0.0, 0, 5]]))
    >>> stats.converged
    tensor([True])
    """

    def __init__(
        self,
        *,
        solver: Solver = "newton",
        tolerance: float = 1e-9,
        max_iterations: int = 50,
        clip_columns: float | None = None,
    ) -> None:
        super().__init__()
        self.solver, self.tolerance, self.max_iterations = solver, tolerance, max_iterations
        self.clip_columns = clip_columns
        self.clipped = ClippedColumns()

    def forward(
        self, assignment: Tensor, bearings: Tensor, points3d: Tensor, rotation: Tensor, translation: Tensor
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], SolveStats]:
        """Return rotation (b, 3, 3), translation (b, 3) and stats; see `weighted_pnp`.

        Args:
            assignment: P (b, m, n).
            bearings: f_i (b, m, 3).
            points3d: p_j (b, n, 3), scene units.
            rotation: Initial R (b, 3, 3).
            translation: Initial t (b, 3), scene units.
        """
        return weighted_pnp(
            assignment,
            bearings,
            points3d,
            rotation,
            translation,
            solver=self.solver,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            clip_columns=self.clip_columns,
            clipped=self.clipped,
        )
