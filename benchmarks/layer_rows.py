"""The rows of the layers' table: what is timed against the paper's method, and how far either is from float64."""

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import roma
import torch
from exact import plan_gradient, pnp_gradient, pnp_optimum, relative_error
from paper_layers import SINKHORN_TOLERANCE, pnp_backward, pnp_forward, sinkhorn_backward, sinkhorn_forward
from problems import Kind, Problem, diagonal_mass, planted, planted_network
from steps import training_step
from timing import Race, race
from torch import Tensor

from bpnp.geometry import bearings, rotation_angle
from bpnp.layers import ransac_pnp, sinkhorn, weighted_pnp

MU, MANY = 0.1, 10_000
FORWARD_CASES: tuple[tuple[Kind, float, float, float, int, str], ...] = (
    # kind, level, clutter, mu, iterations of the paper's method (to its tolerance of 1e-9 where they are many), target
    ("independent", 0.7, 0.0, MU, 100, ">= 1x, 1e-6"),
    ("smooth", 3, 0.0, MU, 100, ">= 1x, 1e-6"),
    ("smooth", 10, 0.0, MU, 100, ">= 1x, 1e-6"),
    ("smooth", 3, 0.0, MU, MANY, ""),
    ("smooth", 10, 0.0, 0.01, 100, "1e-6"),
    ("independent", 0.7, 0.2, 0.01, 100, "1e-6"),
)
BACKWARD_CASES: tuple[tuple[Kind, float, str], ...] = (
    ("independent", 0.7, ">= 10x, 1e-5"),
    ("smooth", 1, ">= 10x, 1e-5"),
    ("smooth", 3, ">= 10x, 1e-5"),
    ("smooth", 10, ">= 10x, 1e-5"),
    ("independent", 0.02, "no NaN, 1e-3"),
)


@dataclass(frozen=True)
class Size:
    points: int
    rounds: int
    batches: tuple[int, int]  # the usual one, and a larger one for the PnP layer


@dataclass(frozen=True)
class Row:
    """A race, and figures of both sides: error of the pose or the gradient, or of the marginals."""

    what: str
    inputs: str
    batch: int
    target: str
    race: Race
    figure: str = ""
    paper_figure: str = ""


def all_rows(size: Size) -> Iterable[Row]:
    for batch in size.batches:
        yield from _pnp_rows(batch, size)
    usual = size.batches[0]
    for kind, level, clutter, mu, iterations, target in FORWARD_CASES:
        problem = planted(usual, size.points, kind=kind, level=level, clutter=clutter)
        yield _sinkhorn_forward(problem, size, kind + (", clutter" if clutter else ""), mu, iterations, target)
    for kind, level, target in BACKWARD_CASES:
        yield _sinkhorn_backward(planted(usual, size.points, kind=kind, level=level), size, kind, target)
    yield from _step_rows(usual, size)


def _pnp_rows(b: int, size: Size) -> Iterable[Row]:
    problem = planted(b, size.points, kind="smooth", level=10)
    plan, rays, points3d = sinkhorn(problem.cost)[0], bearings(problem.batch.points2d), problem.batch.points3d
    inputs = f"smooth, {diagonal_mass(plan):.0%}"
    found = ransac_pnp(plan, problem.batch.points2d, points3d)[:2]
    optimum = pnp_optimum(plan, rays, points3d, _vector(*found))

    def distance(rotation: Tensor, translation: Tensor) -> str:
        """Largest, in radians and scene units."""
        angle = rotation_angle(rotation.double(), optimum.rotation).amax()
        return f"{max(angle, (translation - optimum.translation).norm(dim=-1).amax()):.1e}"

    usual = b == size.batches[0]
    cases = [(torch.float64, "RANSAC", found)]
    if usual:
        cases += [(torch.float64, "10 degrees off", _turned(*found)), (torch.float32, "RANSAC", found)]
    for dtype, where, start in cases:
        ours = partial(weighted_pnp, plan, rays, points3d, *start)
        baseline = partial(pnp_forward, *(x.to(dtype) for x in (plan, rays, points3d, _vector(*start))))
        pose = baseline()
        yield Row(
            f"PnP forward from {where}, L-BFGS in {dtype}".replace("torch.", ""), inputs, b,
            ">= 100x, 1e-6" if dtype == torch.float64 else "", race(ours, baseline, rounds=size.rounds),
            distance(*ours()[:2]), distance(roma.rotvec_to_rotmat(pose[:, :3]), pose[:, 3:]),
        )  # fmt: skip

    leaf = plan.clone().requires_grad_()
    solved = weighted_pnp(leaf, rays, points3d, *found)[:2]
    incoming = [_noise(x.shape, seed) for seed, x in enumerate(solved)]
    pose = optimum.pose.float().requires_grad_()
    through = (roma.rotvec_to_rotmat(pose[:, :3]) * incoming[0]).sum() + (pose[:, 3:] * incoming[1]).sum()
    ours_back = partial(torch.autograd.grad, solved, leaf, incoming, retain_graph=True)
    paper_back = partial(pnp_backward, pose, plan, rays, points3d, torch.autograd.grad(through, pose)[0])
    exact = pnp_gradient(optimum, plan, rays, points3d, incoming[0].double(), incoming[1].double())
    yield Row(
        "PnP backward", inputs, b, ">= 50x, 1e-5", race(ours_back, paper_back, rounds=size.rounds),
        f"{relative_error(ours_back()[0], exact):.1e}", f"{relative_error(paper_back(), exact):.1e}",
    )  # fmt: skip


def _vector(rotation: Tensor, translation: Tensor) -> Tensor:
    return torch.cat([roma.rotmat_to_rotvec(rotation), translation], -1)


def _turned(rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """10 degrees and 0.5 scene units away."""
    axis, shift = (torch.nn.functional.normalize(_noise(translation.shape, seed), dim=-1) for seed in (2, 3))
    return roma.rotvec_to_rotmat(torch.pi / 18 * axis) @ rotation, translation + 0.5 * shift


def _sinkhorn_forward(problem: Problem, size: Size, inputs: str, mu: float, iterations: int, target: str) -> Row:
    ours = partial(sinkhorn, problem.cost, mu=mu)
    tolerance = SINKHORN_TOLERANCE if iterations == MANY else 0
    baseline = partial(sinkhorn_forward, problem.cost, mu=mu, iterations=iterations, tolerance=tolerance)
    plan, ends = ours()[0], "to its tolerance" if tolerance else f"{iterations} iterations"
    return Row(
        f"Sinkhorn forward, mu {mu}, paper {ends}", f"{inputs}, {diagonal_mass(plan):.0%}", len(plan), target,
        race(ours, baseline, rounds=size.rounds), _marginal_error(plan), _marginal_error(baseline()),
    )  # fmt: skip


def _marginal_error(plan: Tensor) -> str:
    """Largest L1 error of the row or column sums over the samples, or how many entries are not numbers."""
    if bad := int((~plan.isfinite()).sum()):
        return f"{bad / plan.numel():.0%} NaN"
    errors = [(plan.double().sum(axis) - 1 / plan.shape[-1]).abs().sum(-1).amax() for axis in (-1, -2)]
    return f"{max(errors):.1e}"


def _sinkhorn_backward(problem: Problem, size: Size, inputs: str, target: str) -> Row:
    """dL/dM of the correspondence loss; the error is the largest of this and of a random dL/dP."""
    cost = problem.cost.requires_grad_()
    linked = sinkhorn(cost, mu=MU)[0]
    plan = linked.detach()
    by_loss = 1 - 2 * torch.eye(plan.shape[1]).expand_as(plan)

    def ours(incoming: Tensor = by_loss) -> Tensor:
        return torch.autograd.grad(linked, cost, incoming, retain_graph=True)[0]

    def baseline(incoming: Tensor = by_loss) -> Tensor:
        return sinkhorn_backward(plan, incoming, mu=MU)

    def error(solve: Callable[[Tensor], Tensor]) -> str:
        gradients = [(solve(v), plan_gradient(plan, v, MU)) for v in (by_loss, _noise(plan.shape, 0))]
        if bad := sum(int((~value.isfinite()).sum()) for value, _ in gradients):
            return f"{bad / 2 / plan.numel():.0%} NaN"
        return f"{max(relative_error(*pair) for pair in gradients):.1e}"

    return Row(
        "Sinkhorn backward", f"{inputs}, {diagonal_mass(plan):.1%}", len(plan), target,
        race(ours, baseline, rounds=size.rounds), error(ours), error(baseline),
    )  # fmt: skip


def _step_rows(b: int, size: Size) -> Iterable[Row]:
    problem = planted(b, size.points, kind="smooth", level=10)
    net = planted_network(problem)
    with torch.no_grad():
        assignment = net.match(problem.batch).assignment
    assert assignment is not None
    inputs = f"smooth, {diagonal_mass(assignment):.0%}"
    for poses, what, target in ((False, "correspondence loss", ">= 3x"), (True, "with pose loss", ">= 7x")):
        ours, paper = (training_step(deepcopy(net), problem.batch, poses=poses, paper=p) for p in (False, True))
        yield Row(f"training step, {what}", inputs, b, target, race(ours, paper, rounds=size.rounds))


def _noise(shape: torch.Size, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))
