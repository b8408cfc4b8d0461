"""Weighted blind PnP layer (paper Eq. 8): from an initial pose to the pose that best explains a soft assignment.

The objective is f(R, t) = sum_ij P_ij (1 - f_i . g(R p_j + t)) with g(y) = y / |y|. It is linear in the bearings: with
q_j = sum_i P_ij f_i, f = sum P - sum_j q_j . g(R p_j + t). After one product, an evaluation costs O(n), not O(m n).

A step (w, s) moves the points in the frame of the scene: y = R (exp([w]x) p + s) + t. In this frame the q_j turn and
the p_j stay. Both are columns of (b, 3, n) tensors, because torch sums three rows of n numbers faster than n rows of
three.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bpnp.checks import check_shapes
from bpnp.geometry import choose, hat, is_finite
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
    """

    columns: int = 0
    clipped: int = 0  # columns whose norm was reduced

    def reset(self) -> None:
        """Set both counts to zero."""
        self.columns = self.clipped = 0


@dataclass
class _ColumnLimit:
    """Limit of the norm of the columns of the pose's derivative, for the backward pass of `_Aggregate`."""

    largest: float
    count: ClippedColumns | None
    grams: Float[Tensor, "b n 3 3"] | None = None  # f_i^T grams_j f_i is the squared norm of column ij; set when solved


class _Aggregate(torch.autograd.Function):
    """F^T P (b, 3, n): q_j = sum_i P_ij f_i, the mean bearing of each 3D point times the point's weight.

    Its gradients are exact products too. With a limit, the gradient of P_ij is that of the shortened column.
    """

    @staticmethod
    def forward(ctx: Any, assignment: Tensor, bearings: Tensor, limit: _ColumnLimit | None) -> Tensor:
        ctx.save_for_backward(assignment, bearings)
        ctx.limit = limit
        return bearings.mT @ assignment

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        assignment, bearings = ctx.saved_tensors
        to_assignment, to_bearings = ctx.needs_input_grad[:2]
        of_assignment = bearings @ gradient if to_assignment else None
        if of_assignment is not None and ctx.limit is not None:
            outer = (bearings.unsqueeze(-1) * bearings.unsqueeze(-2)).flatten(-2)
            norms = (outer.to(ctx.limit.grams) @ ctx.limit.grams.flatten(-2).mT).clamp_min(0).sqrt()
            if ctx.limit.count is not None:
                real = assignment > 0
                ctx.limit.count.columns += int(real.sum())
                ctx.limit.count.clipped += int((real & (norms > ctx.limit.largest)).sum())
            of_assignment = of_assignment * (ctx.limit.largest / norms).clamp_max(1).to(of_assignment)
        of_bearings = assignment @ gradient.mT if to_bearings else None
        return of_assignment, of_bearings, None


class Derivatives(NamedTuple):
    """Value, gradient and Hessian of -sum_j q_j . g(R p_j + t) in the step (w, s), at zero."""

    value: Float[Tensor, " b"]
    gradient: Float[Tensor, "b 6"]
    hessian: Float[Tensor, "b 6 6"]


class Objective:
    """The aggregated objective of a batch of problems, and its derivatives in the step (w, s).

    With y = p + R^T t, d = |y|, u = y/d and R^T q for q, the derivative of a term in y is h = ((q.u) u - q)/d, and its
    second derivative G = [(q.u)(I - 3 u u^T) + q u^T + u q^T]/d^2 = c I + v k^T + k v^T, where c = (q.u)/d^2, v = u/d
    and k = (q - 1.5 (q.u) u)/d. The derivatives by a step are linear in h, c and v k^T, and polynomials of degree 2 in
    p. One product thus gives all sums over the points, and a constant matrix makes derivatives of them.
    """

    def __init__(self, q: Columns, points: Columns) -> None:
        """Set the weighted bearings q_j and the scene points p_j of each sample."""
        self.q, self.points = q, points
        homogeneous = torch.cat([torch.ones_like(points[:, :1]), points], 1)
        self.monomials = homogeneous[:, FIRST] * homogeneous[:, SECOND]

    def packed(self, rotation: Rotations, translation: Translations) -> Float[Tensor, "b 43"]:
        """Return value, gradient and Hessian in one row a sample, which `unpack` separates."""
        back = rotation.mT
        q, y = back @ self.q, self.points + back @ translation.unsqueeze(-1)
        inverse = y.square().sum(1, keepdim=True).clamp_min(NEAR**2).rsqrt()
        u = y * inverse
        along = (q * u).sum(1, keepdim=True)
        v, q = u * inverse, q * inverse
        k = torch.addcmul(q, along, v, value=-1.5)
        h = torch.addcmul(-q, along, v)
        products = (v.unsqueeze(2) * k.unsqueeze(1)).flatten(1, 2)
        moments = self.monomials @ torch.cat([products, h, along * inverse.square(), along], 1).mT
        return moments.flatten(1) @ _from_moments(q.dtype, q.device)

    def derivatives(self, rotation: Rotations, translation: Translations) -> Derivatives:
        """Return value, gradient and Hessian."""
        return unpack(self.packed(rotation, translation))


FIRST, SECOND = (list(index) for index in zip(*((a, b) for a in range(4) for b in range(a, 4)), strict=True))


def unpack(packed: Float[Tensor, "b 43"]) -> Derivatives:
    """Separate value, gradient and Hessian."""
    return Derivatives(packed[:, 0], packed[:, 1:7], packed[:, 7:].unflatten(1, (6, 6)))


@cache
def _from_moments(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "140 43"]:
    """Return the matrix from the moments of `Objective` to value, gradient and Hessian.

    For the homogeneous point (1, p) the derivative of y in the step is sum_a p_a L_a, with L_0 = [0, I] and
    L_a = [-[e_a]x, 0]. The gradient is thus sum_a L_a^T sum p_a h, and the Hessian sum_ab L_a^T (sum p_a p_b G) L_b,
    plus sym(sum p h^T) - (sum p.h) I in its rotation block, the second derivative of exp([w]x) p.
    """
    eye = torch.eye(3, dtype=torch.float64, device="cpu")
    zero = torch.zeros_like(eye)
    by_step = torch.stack([torch.cat([zero, eye], 1), *(torch.cat([-hat(e), zero], 1) for e in eye)])
    basis = torch.eye(10 * 14, dtype=torch.float64, device="cpu").view(-1, 10, 14)
    moments = basis.new_zeros(len(basis), 4, 4, 14)
    moments[:, FIRST, SECOND] = moments[:, SECOND, FIRST] = basis
    products, h, c, along = moments.split([9, 3, 1, 1], -1)
    products, h = products.unflatten(-1, (3, 3)), h[:, 0]
    second = products + products.mT + c.unsqueeze(-1) * eye
    hessian = torch.einsum("aki, zabkl, blj -> zij", by_step, second, by_step)
    bend = h[:, 1:]
    trace = bend.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
    hessian[:, :3, :3] += (bend + bend.mT) / 2 - trace * eye
    gradient = torch.einsum("aki, zak -> zi", by_step, h)
    return torch.cat([-along[:, 0, 0], gradient, hessian.flatten(1)], 1).to(device, dtype)


def _optimality(q: Columns, points: Columns, rotation: Rotations, translation: Translations) -> Float[Tensor, "b 6"]:
    """Return the gradient of `Objective` alone, which autograd can follow to q and to the points."""
    q, y = rotation.mT @ q, points + rotation.mT @ translation.unsqueeze(-1)
    inverse = y.square().sum(1, keepdim=True).clamp_min(NEAR**2).rsqrt()
    u = y * inverse
    h = ((q * u).sum(1, keepdim=True) * u - q) * inverse
    outer = points @ h.mT
    twist = outer - outer.mT
    return torch.stack([twist[:, 1, 2], twist[:, 2, 0], twist[:, 0, 1], *h.sum(-1).unbind(-1)], -1)


EQUAL = 1e-13  # a smaller difference of two objective values (weights sum to one) is rounding error


def newton(
    objective: Objective,
    rotation: Rotations,
    translation: Translations,
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Rotations, Translations, Int[Tensor, " b"], Derivatives]:
    """Minimise the aggregated objective by Newton's method with Levenberg damping, for the whole batch at once.

    Each sample has its own damping, zero until a step fails, and stops by itself. The weights |q_j| of a sample sum to
    one, and the points have unit size. `tolerance` is the largest gradient norm at the result. The iterations of each
    sample and the derivatives at the end are returned too.
    """
    eye = torch.eye(6, dtype=rotation.dtype, device=rotation.device)
    current = objective.packed(rotation, translation)
    value, gradient, hessian = unpack(current)
    slope = torch.linalg.vector_norm(gradient, dim=-1)
    damping, iterations = torch.zeros_like(slope), torch.zeros_like(slope, dtype=torch.long)
    for _ in range(max_iterations):
        active = slope > tolerance
        if not bool(active.any()):
            break
        iterations += active
        factor, info = torch.linalg.cholesky_ex(torch.addcmul(hessian, damping[:, None, None], eye))
        step = torch.cholesky_solve(gradient.unsqueeze(-1), factor)
        new_rotation = rotation @ _rotation_of(-step[:, :3, 0])
        new_translation = torch.baddbmm(translation.unsqueeze(-1), rotation, step[:, 3:], alpha=-1).squeeze(-1)
        trial = objective.packed(new_rotation, new_translation)
        new_value, new_gradient, _ = unpack(trial)
        new_slope = torch.linalg.vector_norm(new_gradient, dim=-1)
        # Near the optimum the values agree to rounding; there the smaller gradient decides. NaN is not accepted.
        flat = (new_value - value).abs() <= EQUAL
        accept = active & (info == 0) & ((new_value < value) | (flat & (new_slope < slope)))
        rotation, translation = choose(accept, new_rotation, rotation), choose(accept, new_translation, translation)
        current, slope = choose(accept, trial, current), torch.where(accept, new_slope, slope)
        value, gradient, hessian = unpack(current)
        lowered, raised = torch.threshold(damping / 10, 1e-7, 0), (10 * damping).clamp_min(1e-3)
        damping = torch.where(accept, lowered, raised)
    return rotation, translation, iterations, unpack(current)


def _lbfgs(
    objective: Objective, rotation: Rotations, translation: Translations, **stops: Any
) -> tuple[Rotations, Translations, Int[Tensor, " b"], Derivatives]:
    """Minimise the objective by L-BFGS, with the arguments and results of `newton`."""
    r, t, iterations = lbfgs(objective.q, objective.points, rotation, translation, **stops)
    return r, t, iterations, objective.derivatives(r, t)


def _rotation_of(w: Float[Tensor, "b 3"]) -> Rotations:
    """Return the Cayley transform of [w/2]x, a rotation that differs from exp([w]x) in the third order of w."""
    k, eye = hat(w), torch.eye(3, dtype=w.dtype, device=w.device)
    factor = 4 / (4 + w.square().sum(-1))[:, None, None]
    return torch.addcmul(eye, factor, torch.baddbmm(k, k, k, alpha=0.5))


SOLVERS = {"newton": newton, "lbfgs": _lbfgs}


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
    if solver not in SOLVERS:
        raise ValueError(f"`solver` is {solver!r}; it is one of {', '.join(SOLVERS)}")
    if clip_columns is not None and not clip_columns > 0:
        raise ValueError(f"`clip_columns` is {clip_columns}; it is a norm above 0, or None for no limit")
    bearings = bearings.to(assignment.dtype)
    limit = None if clip_columns is None else _ColumnLimit(clip_columns, clipped)
    weighted: Columns = _Aggregate.apply(assignment, bearings, limit).double()
    usable = weighted.isfinite().all((-2, -1)) & points3d.isfinite().all((-2, -1))
    if not bool(usable.all()):
        # Zeros have a zero gradient; that of NaN would be NaN, and that of the network with it.
        assignment, bearings, points3d = (
            torch.where(usable[:, None, None], values, 0) for values in (assignment, bearings, points3d)
        )
        weighted = _Aggregate.apply(assignment, bearings, limit).double()
    with torch.no_grad():
        # The optimum does not depend on a factor of the weights |q_j|; here they sum to one.
        lengths = _lengths(weighted)
        total = lengths.sum(-1, keepdim=True).clamp_min(torch.finfo(lengths.dtype).tiny)
    q = weighted / total
    points, centre, scale = _normalise(points3d.double().mT.contiguous(), lengths / total)
    with torch.no_grad():
        found = usable & is_finite(rotation, translation)
        # Make a rounded rotation orthonormal; samples without a pose get an arbitrary one.
        r = torch.where(found[:, None, None], rotation.double(), torch.eye(3, dtype=q.dtype, device=q.device))
        r = _orthonormalise(r)
        t = (torch.where(found[:, None], translation.double(), 1) + _rotate(r, centre)) / scale
        objective = Objective(q.detach(), points.detach())
        r, t, iterations, end = SOLVERS[solver](objective, r, t, tolerance=tolerance, max_iterations=max_iterations)
        residual, well_posed, factor = _judge(end)
        converged = found & (residual <= tolerance) & well_posed & (t.norm(dim=-1) < FARTHEST)
        if limit is not None:
            to_scene = _scene_step(r, centre, scale)
            # The columns are those for a P that sums to one, as in the paper.
            unit = (assignment.sum((-2, -1)).double() / total[:, 0, 0])[:, None, None]
            limit.grams = _column_grams(objective.points, r, t, factor, unit * to_scene)

    if q.requires_grad or points.requires_grad:
        # One more Newton step y - H^-1 F(y, x), H held fixed, has the derivative -H^-1 dF/dx of the optimum y(x).
        step = -torch.cholesky_solve(_optimality(q, points, r, t).unsqueeze(-1), factor).squeeze(-1)
        step = torch.where(converged[:, None], step - step.detach(), 0)
        step.register_hook(refuse_second_derivative)
        # The step is zero: R exp([w]x) = R + R [w]x is exact, in the derivative too.
        r, t = r + r @ hat(step[:, :3]), t + _rotate(r, step[:, 3:])
    t = t * scale - _rotate(r, centre)
    r = torch.where(found[:, None, None], r, torch.nan).to(assignment.dtype)
    t = torch.where(found[:, None], t, torch.nan).to(assignment.dtype)
    return r, t, SolveStats(iterations, torch.where(found, residual, torch.inf), converged)


def _scene_step(rotation: Rotations, centre: Translations, scale: Float[Tensor, "b 1"]) -> Float[Tensor, "b 6 6"]:
    """Return the matrix from a step (w, s) in the solver's frame to one of (angle-axis r, t in scene units).

    t = scale t' - R c, so dt = R (scale s + c x w); dr = J^-1 R w with the left Jacobian J of exp at r.
    """
    import roma  # here, not at the top: it imports all of torch's compiler

    r = roma.rotmat_to_rotvec(rotation)
    angle = r.norm(dim=-1).clamp_min(1e-6)[:, None, None]
    turn, eye = hat(r), torch.eye(3, dtype=r.dtype, device=r.device)
    # (1 / a^2 - cot(a / 2) / (2 a)), which tends to 1 / 12
    bend = 1 / angle**2 - 1 / (2 * angle * torch.tan(angle / 2))
    inverse = eye - turn / 2 + torch.where(angle > 1e-3, bend, 1 / 12) * (turn @ turn)
    zero = torch.zeros_like(inverse)
    top = torch.cat([inverse @ rotation, zero], -1)
    bottom = rotation @ torch.cat([hat(centre), scale[:, :, None] * eye], -1)
    return torch.cat([top, bottom], -2)


def _column_grams(
    points: Columns,
    rotation: Rotations,
    translation: Translations,
    factor: Float[Tensor, "b 6 6"],
    to_scene: Float[Tensor, "b 6 6"],
) -> Float[Tensor, "b n 3 3"]:
    """Return A_j^T A_j (b, n, 3, 3) for the columns dy / dP_ij = A_j f_i of the pose's derivative.

    With u = g(p_j + R^T t) and D = [-[p]x, I], the optimality condition has d/dP_ij = -D^T (I - u u^T) R^T f_i / d; dy
    is minus the inverse Hessian times it. `factor` is the Cholesky factor of the Hessian.
    """
    p = points.mT
    y = p + _rotate(rotation.mT, translation).unsqueeze(-2)
    inverse = y.square().sum(-1, keepdim=True).clamp_min(NEAR**2).rsqrt()
    u = (y * inverse).unsqueeze(-1)
    eye = torch.eye(3, dtype=p.dtype, device=p.device)
    project = inverse.unsqueeze(-1) * (eye - u * u.mT) @ rotation.mT.unsqueeze(1)
    rows = torch.cat([hat(p) @ project, project], -2)  # D^T (I - u u^T) R^T / d, D^T = [[p]x; I]
    b, n = rows.shape[:2]
    solved = torch.cholesky_solve(rows.permute(0, 2, 1, 3).reshape(b, 6, 3 * n), factor)
    columns = (to_scene @ solved).reshape(b, 6, n, 3).permute(0, 2, 1, 3)
    return columns.mT @ columns


def _lengths(columns: Columns) -> Float[Tensor, "b 1 n"]:
    return columns.square().sum(-2, keepdim=True).sqrt()


def _orthonormalise(rotation: Rotations) -> Rotations:
    """Return the rotations with the directions of the first column and of the plane of the first two."""
    first, second, _ = rotation.unbind(-1)
    first = nn.functional.normalize(first, dim=-1)
    third = nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
    return torch.stack([first, torch.linalg.cross(third, first), third], -1)


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
