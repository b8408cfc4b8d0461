"""Nets of padded point sets against plain ones in torch, in double precision but where rounding is the subject."""

import warnings
from copy import deepcopy

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bpnp.models.nets import InputTransform, MaskedBatchNorm, PointFeatures, linear_context_norm, normalise_points3d

SIZES = (9, 1, 14)


def sets(channels: int, *, garbage: float = 50.0) -> tuple[list[Tensor], Tensor, Tensor]:
    """Sets of different sizes, the same padded with garbage, and the mask."""
    single = [torch.randn(size, channels, dtype=torch.float64) for size in SIZES]
    padded = garbage * torch.randn(len(SIZES), max(SIZES), channels, dtype=torch.float64)
    mask = torch.arange(max(SIZES)) < torch.tensor(SIZES).unsqueeze(-1)
    for i, points in enumerate(single):
        padded[i, : len(points)] = points
    return single, padded, mask


def randomise(module: nn.Module) -> nn.Module:
    """Batch norms as after some training: no statistic or factor at its neutral start."""
    for norm in module.modules():
        if isinstance(norm, nn.BatchNorm1d):
            nn.init.normal_(norm.weight)
            nn.init.normal_(norm.bias)
            nn.init.normal_(norm.running_mean)
            nn.init.uniform_(norm.running_var, 0.5, 2)
    return module


@pytest.mark.parametrize("net", [PointFeatures(3, channels=16, depth=4), InputTransform()], ids=["plain", "transform"])
def test_padding_changes_no_gradient_in_training(net: nn.Module) -> None:
    net.double()
    _, padded, mask = sets(3)
    weights = torch.randn(net(padded, mask).shape, dtype=torch.float64)

    def gradients(points: Tensor) -> list[Tensor]:
        net.zero_grad()
        (net(points, mask) * weights)[mask].sum().backward()
        return [p.grad.clone() for p in net.parameters() if p.grad is not None]

    for a, b in zip(gradients(padded), gradients(padded * mask.unsqueeze(-1)), strict=True):
        assert a.isfinite().all()
        assert (a - b).abs().max() < 1e-9


@pytest.mark.parametrize("momentum", [0.1, None], ids=["rate", "mean of all batches"])
def test_batch_norm_is_torchs_on_the_real_points(momentum: float | None) -> None:
    ours, theirs = MaskedBatchNorm(5, momentum=momentum).double(), nn.BatchNorm1d(5, momentum=momentum).double()
    theirs.load_state_dict(ours.state_dict())
    for _ in range(4):
        single, padded, mask = sets(5)
        out, expected = ours(padded, mask), theirs(torch.cat(single))
        torch.testing.assert_close(out[mask], expected)
    for name, value in theirs.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], value)
    ours.eval()
    theirs.eval()
    torch.testing.assert_close(ours(padded, mask)[mask], theirs(torch.cat(single)))


def test_batch_norm_of_vectors_is_torchs_and_one_sample_uses_the_running_statistics() -> None:
    ours, theirs = MaskedBatchNorm(5).double(), nn.BatchNorm1d(5).double()
    x = torch.randn(6, 5, dtype=torch.float64)
    torch.testing.assert_close(ours(x), theirs(x))
    state = {k: v.clone() for k, v in ours.state_dict().items()}
    one = torch.randn(1, 5, dtype=torch.float64, requires_grad=True)
    out = ours(one)
    torch.testing.assert_close(out, theirs.eval()(one))
    assert torch.equal(ours.running_mean, state["running_mean"])
    assert torch.equal(ours.running_var, state["running_var"])
    out.sum().backward()
    assert one.grad is not None
    assert one.grad.isfinite().all()


@pytest.mark.parametrize("training", [True, False])
def test_the_input_transform_is_pointnets(training: bool) -> None:
    net = randomise(InputTransform()).double().train(training)
    plain = deepcopy(net)
    single, padded, mask = sets(3)
    weights = torch.randn(*mask.shape, 3, dtype=torch.float64)

    def norm(k: int, z: Tensor) -> Tensor:
        return F.relu(nn.BatchNorm1d.forward(plain.norms[k], z))

    z = torch.cat(single)
    for k in range(3):
        z = norm(k, F.linear(z, plain.linears[k].weight, plain.linears[k].bias))
    z = torch.stack([part.max(0).values for part in z.split(SIZES)])
    for k in (3, 4):
        z = norm(k, plain.linears[k](z))
    transforms = torch.eye(3) + plain.out(z).view(-1, 3, 3)
    expected = torch.cat([x @ transform for x, transform in zip(single, transforms, strict=True)])
    moved = net(padded, mask)[mask]
    torch.testing.assert_close(moved, expected)
    for result in (moved, expected):
        (result * weights[mask]).sum().backward()
    for ours, theirs in zip(net.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad)
    for ours, theirs in zip(net.buffers(), plain.buffers(), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_normalised_scenes_do_not_depend_on_their_unit_and_origin() -> None:
    single, padded, mask = sets(3)
    normalised = normalise_points3d(padded, mask)
    for i, x in enumerate(single):
        y = normalised[i, : len(x)]
        assert y.mean(0).abs().max() < 1e-12
        assert abs(float((y**2).sum(-1).mean().sqrt()) - (len(x) > 1)) < 1e-12
    assert not normalised[~mask].any()
    moved = normalise_points3d(250 * padded + torch.tensor([30.0, -20, 10]), mask)
    torch.testing.assert_close(moved, normalised, atol=1e-10, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("residual", [True, False])
def test_the_normed_map_has_the_gradient_of_its_formula(residual: bool, padded: bool) -> None:
    x, mask = sets(5, garbage=3.0)[1:]
    weight, bias, skip = (torch.randn(*shape) for shape in ((6, 5), (6,), (*x.shape[:2], 6)))
    inputs = [value.double().requires_grad_() for value in (x, weight, bias, skip)]
    assert torch.autograd.gradcheck(
        lambda x, w, b, s: linear_context_norm(x, w, b, mask if padded else None, s if residual else None), inputs
    )


def test_a_batch_norm_of_two_processes_is_that_of_both_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process has the same batch: each sum over processes is twice the own one, and so is its gradient."""
    own = torch.randn(3, 5, dtype=torch.float64)
    weight = torch.randn(3, 5, dtype=torch.float64)

    def step(x: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        norm, x = MaskedBatchNorm(5).double(), x.clone().requires_grad_()
        y = norm(x)
        return y.detach(), torch.autograd.grad((y * weight).sum(), x)[0]

    both = step(torch.cat([own, own]), torch.cat([weight, weight]))
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.all_reduce", lambda values, *_: values.mul_(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for split, whole in zip(step(own, weight), both, strict=True):
            torch.testing.assert_close(split, whole[:3])
