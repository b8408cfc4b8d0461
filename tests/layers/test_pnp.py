from typing import Any

import pytest
import torch
from planted import Planted, plant
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bpnp.geometry import camera_centre, rotation_angle, transform
from bpnp.layers import weighted_pnp
from bpnp.types import SolveStats

Solved = tuple[Tensor, Tensor, SolveStats]


def solve(planted: Planted, assignment: Tensor, start: tuple[Tensor, Tensor], **options: Any) -> Solved:
    return weighted_pnp(assignment, planted.bearings, planted.points3d, *start, **options)


def apart(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> float:
    """Largest angle in radians or distance between the poses of two lists."""
    return torch.maximum(rotation_angle(a[0], b[0]), (a[1] - b[1]).norm(dim=-1)).max().item()


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_weighted_pnp_recovers_a_planted_pose(dtype: torch.dtype) -> None:
    """In half precision, the initial rotation is orthogonal to two digits."""
    planted = plant(12, 25, outliers2d=6, outliers3d=9)
    rotation, translation = planted.near(0.15)
    start = rotation.to(dtype), translation.to(dtype)
    *found, stats = solve(planted, planted.permutation(), start, tolerance=1e-12)
    assert stats.converged.all()
    assert apart((found[0], found[1]), planted.pose) < 1e-9
    assert torch.linalg.det(found[0]).sub(1).abs().max() < 1e-11


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e3, 0.0), (1e-3, 0.0), (1.0, 1e4)])
def test_the_gradients_of_weighted_pnp_are_finite_differences(scale: float, offset: float) -> None:
    """All central differences are samples of one batch, solved to 1e-13."""
    planted = plant(1, 6, outliers2d=2, seed=7)
    rotation, translation = planted.near(0.05)
    start = rotation, scale * translation - offset * rotation.sum(-1)
    sizes = [48, 24, 18]

    def poses(inputs: Tensor, **options: Any) -> Tensor:
        p, f, x = inputs.split(sizes, -1)
        variables = p.unflatten(-1, (8, 6)), f.unflatten(-1, (8, 3)), scale * x.unflatten(-1, (6, 3)) + offset
        r, t, stats = weighted_pnp(*variables, *(s.expand(len(p), *s.shape[1:]) for s in start), **options)
        assert stats.converged.all()
        return torch.cat([r.flatten(1), (camera_centre(r, t) - offset) / scale], -1)

    at = torch.cat([x.flatten() for x in (planted.diffuse(0.2), planted.bearings, planted.points3d)])
    step = 1e-5 * torch.eye(len(at), dtype=torch.float64)
    exact = {"tolerance": 1e-13}
    differences = (poses(at + step, **exact) - poses(at - step, **exact)) / 2e-5
    jacobian = torch.autograd.functional.jacobian(lambda x: poses(x.unsqueeze(0), **exact)[0], at)
    for analytic, numeric in zip(jacobian.mT.split(sizes), differences.split(sizes), strict=True):
        assert (analytic - numeric).abs().max() < 1e-5 * numeric.abs().max()


def degenerate(kind: str, planted: Planted) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Assignment, 3D points and start whose first sample has no well-posed optimum."""
    assignment, points3d = planted.permutation(), planted.points3d.clone()
    rotation, translation = (x.clone() for x in planted.near(0.05))
    if kind == "collinear":
        points3d[0, :, 1:] = 0
    elif kind == "one place":
        points3d[0] = 0.5
    elif kind in ("one point", "two points"):
        assignment[0, :, ("one point", "two points").index(kind) + 1 :] = 0
    elif kind == "nothing assigned":
        assignment[0] = 0
    elif kind == "no start":
        rotation[0], translation[0] = torch.nan, torch.nan
    elif kind == "start at infinity":
        translation[0, 2] = 1e9
    elif kind == "assignment NaN":
        assignment[0, 0, 0] = torch.nan
    elif kind == "assignment infinite":
        assignment[0, 0, 0] = torch.inf
    elif kind in ("point NaN", "point infinite"):
        points3d[0, 4, 1] = torch.nan if kind == "point NaN" else torch.inf
    return assignment, points3d, rotation, translation


ILL_POSED = (
    "collinear, one place, one point, two points, nothing assigned, no start, start at infinity, assignment NaN, "
    "assignment infinite, bearing NaN, point NaN, point infinite"
)


@pytest.mark.parametrize("kind", ILL_POSED.split(", "))
def test_a_sample_without_a_pose_is_flagged_and_affects_no_other(kind: str) -> None:
    planted = plant(3, 12, seed=10)
    assignment, points3d, *start = degenerate(kind, planted)
    bearings = planted.bearings.clone()
    if kind == "bearing NaN":
        bearings[0, 3] = torch.nan
    variables = [x.clone().requires_grad_() for x in (assignment, bearings, points3d)]
    r, t, stats = weighted_pnp(*variables, *start)
    assert stats.converged.tolist() == [False, True, True]
    assert apart((r[1:], t[1:]), (planted.rotation[1:], planted.translation[1:])) < 1e-6
    torch.nansum(r).add(torch.nansum(t)).backward()
    assert all(x.grad is not None and not x.grad[0].any() for x in variables)
    if "NaN" in kind or "infinite" in kind:
        assert r[0].isnan().all()
        assert t[0].isnan().all()
        assert stats.residual[0] == torch.inf
    expected = [x[1:].detach().clone().requires_grad_() for x in variables]
    alone = weighted_pnp(*expected, *(x[1:] for x in start))
    alone[0].sum().add(alone[1].sum()).backward()
    for x, y in zip(variables, expected, strict=True):
        assert x.grad is not None
        assert y.grad is not None
        assert (x.grad[1:] - y.grad).abs().max() < 1e-4 * y.grad.abs().max()


@pytest.mark.parametrize("kind", ["coplanar", "three points"])
def test_minimal_and_flat_scenes_have_a_pose(kind: str) -> None:
    planted = plant(4, 12, seed=11)
    if kind == "coplanar":
        points3d = planted.points3d * torch.tensor([1, 1, 0]).double()
        camera = transform(*planted.pose, points3d)
        seen = camera[..., :2] / camera[..., 2:]
        points2d = torch.empty_like(seen).scatter_(1, planted.match3d.unsqueeze(-1).expand_as(seen), seen)
        planted = Planted(points2d, points3d, *planted.pose, planted.match3d)
    assignment = planted.permutation()
    if kind == "three points":
        assignment[:, :, 3:] = 0
    *found, stats = solve(planted, assignment, planted.near(0.02), tolerance=1e-12)
    assert stats.converged.all()
    assert apart((found[0], found[1]), planted.pose) < 1e-5


@pytest.mark.parametrize(("radii", "near"), [(8e3, True), (1.2e4, False)])
def test_a_camera_beyond_ten_thousand_radii_is_flagged(radii: float, near: bool) -> None:
    """Exact bearings, from the true pose."""
    planted = plant(4, 30, seed=13)
    centred = planted.points3d - planted.points3d.mean(1, keepdim=True)
    points3d = centred / centred.square().sum(-1).mean(-1).sqrt()[:, None, None]
    translation = torch.tensor([[0.0, 0.0, radii]], dtype=torch.float64).expand(4, 3)
    bearings = torch.nn.functional.normalize(transform(planted.rotation, translation, points3d), dim=-1)
    assignment = torch.eye(30, dtype=torch.float64).expand(4, 30, 30) / 30
    stats = weighted_pnp(assignment, bearings, points3d, planted.rotation, translation)[2]
    assert stats.converged.tolist() == [near] * 4


class Products(TorchDispatchMode):
    """Count the matrix products with a factor of a shape."""

    def __init__(self, shape: torch.Size) -> None:
        super().__init__()
        self.shape, self.count = shape, 0

    def __torch_dispatch__(self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        if function is torch.ops.aten.bmm.default:
            self.count += any(factor.shape == self.shape for factor in args)
        return function(*args, **kwargs or {})


@pytest.mark.parametrize("trained", [False, True])
def test_the_assignment_is_reduced_once_a_forward_pass(trained: bool) -> None:
    planted = plant(2, 40, outliers2d=5, seed=14)
    assignment = planted.permutation().requires_grad_(trained)
    with Products(assignment.shape) as products:
        solve(planted, assignment, planted.near(0.05))
    assert products.count == 1


def test_an_initial_pose_behind_the_points_ends_in_front_or_is_flagged() -> None:
    planted = plant(8, 30, seed=12)
    r, t, stats = solve(planted, planted.permutation(), (planted.rotation, -planted.translation))
    in_front = (transform(r, t, planted.points3d)[..., 2] > 0).all(-1)
    assert (in_front | ~stats.converged).all()
    assert stats.residual.isfinite().all()
