"""Muon: against the singular value decomposition, against torch's Muon and Adam, and in a training that is resumed."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from trainer_observer import Observer, fit

from bpnp.training import Muon
from bpnp.training.muon import orthogonalise

SHORT = ["--optimizer=bpnp.training.Muon", "--trainer.limit_val_batches=0"]


@pytest.mark.parametrize("shape", [(48, 48), (32, 96), (96, 32)])
def test_the_singular_vectors_stay_and_the_singular_values_become_about_one(shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(3)
    matrix = torch.randn(1, *shape, generator=generator)
    u, _, vt = torch.linalg.svd(matrix[0], full_matrices=False)
    inner = u.T @ orthogonalise(1e3 * matrix)[0] @ vt.T
    singular = inner.diagonal()
    assert singular[:-3].min() > 0.6  # the smallest singular values may not have converged
    assert singular.max() < 1.3
    assert (inner - singular.diag()).abs().max() < 1e-4


def test_the_singular_values_are_those_of_the_polynomial() -> None:
    """a s + b s^3 + c s^5, five times, of the singular values divided by the norm, in float32."""
    matrix = torch.randn(24, 24, generator=torch.Generator().manual_seed(4))
    u, s, vt = torch.linalg.svd(matrix.double())
    s /= s.norm()
    for _ in range(5):
        s = 3.4445 * s - 4.775 * s**3 + 2.0315 * s**5
    found = orthogonalise(torch.stack([matrix, matrix.bfloat16().float()]))
    assert found.dtype == torch.float32
    assert (found[0] - u * s @ vt).abs().max() < 1e-5
    half = orthogonalise(matrix.bfloat16()[None])
    assert half.dtype == torch.bfloat16
    assert torch.equal(half[0], found[1].bfloat16())


def test_a_zero_gradient_moves_nothing() -> None:
    assert torch.equal(orthogonalise(torch.zeros(2, 20, 30)), torch.zeros(2, 20, 30))


def network() -> nn.Sequential:
    torch.manual_seed(5)
    return nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU(), nn.Linear(64, 32), nn.Linear(32, 2))


def gradients(net: nn.Module, step: int) -> None:
    """Set gradients that do not depend on the weights."""
    generator = torch.Generator().manual_seed(step)
    for parameter in net.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_matrices_move_as_with_torch_and_the_rest_as_with_adam() -> None:
    ours, other = network(), network()
    optimizer = Muon(ours.parameters(), lr=0.02, adam_lr=0.003)
    hidden = [other[2].weight, other[4].weight]
    rest = [one for one in other.parameters() if all(one is not matrix for matrix in hidden)]
    muon = torch.optim.Muon(hidden, lr=0.02, weight_decay=0.0, adjust_lr_fn="original")
    adam = torch.optim.Adam(rest, lr=0.003)
    start = [one.detach().clone() for one in ours.parameters()]
    for step in range(5):
        gradients(ours, step)
        gradients(other, step)
        optimizer.step()
        muon.step()
        adam.step()
    for one, before, expected in zip(ours.parameters(), start, other.parameters(), strict=True):
        is_matrix = any(expected is matrix for matrix in hidden)
        error = (one - expected).norm() / (expected - before).norm()
        assert error < (0.05 if is_matrix else 1e-6)  # torch's Muon has bfloat16
        assert one.grad is not None  # as torch leaves them


def test_a_closure_is_called_once_with_gradients() -> None:
    net = network()
    calls = []

    def closure() -> Tensor:
        net.zero_grad()
        loss = net(torch.ones(4, 3)).square().mean()
        loss.backward()
        calls.append(loss.item())
        return loss

    optimizer = Muon(net.parameters())
    losses = [optimizer.step(closure).item() for _ in range(20)]
    assert calls == losses
    assert losses[-1] < 0.2 * losses[0]


def test_frozen_parameters_stay_and_negative_rates_are_refused() -> None:
    net = network()
    net[2].weight.requires_grad = False
    optimizer = Muon(net.parameters())
    assert sum(len(group["params"]) for group in optimizer.param_groups) == 7
    for name in ("lr", "adam_lr"):
        with pytest.raises(ValueError, match=f"`{name}` is -1.0; it must be 0 or more"):
            Muon(net.parameters(), **{name: -1.0})


@pytest.mark.slow
def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    """The momentum and both schedules continue."""
    options = [*SHORT, "--model.warmup_steps=6", "--trainer.limit_train_batches=2"]
    fit(tmp_path / "whole", *options, "--trainer.max_epochs=3")
    whole, rates = Observer.weights[-1], list(Observer.rates)
    fit(tmp_path / "parts", *options, "--trainer.max_epochs=1")
    fit(tmp_path / "parts", *options, "--trainer.max_epochs=3", "--ckpt_path=last")
    torch.testing.assert_close(Observer.weights[-1], whole, rtol=0, atol=0)
    assert rates == pytest.approx([0.01 * step / 7 for step in range(1, 7)])
