"""The authors' weights: a plain network written from the formulas, with their names, gives the same numbers."""

import datetime
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from authors_network import Released, checkpoint, plan
from authors_pickles import Exploit
from small_data import quiet_trainer
from torch import Tensor, nn

from bpnp import Batch, BPnPNet
from bpnp.cli import main
from bpnp.datamodules import MeshDataModule
from bpnp.models.bpnpnet import load_authors_weights, tensor_maps
from bpnp.training.task import BlindPnPTask


@pytest.fixture(scope="module")
def reference() -> Released:
    torch.manual_seed(5)
    net = Released()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.3, 2)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0, 0.2)
            module.num_batches_tracked += 1234
    return net.eval()


def pairs() -> list[tuple[Tensor, Tensor]]:
    return [(torch.rand(m, 2) - 0.5, torch.randn(n, 3)) for m, n in ((40, 40), (25, 61), (64, 12))]


def test_parameter_counts_are_those_of_the_paper_code(reference: Released) -> None:
    state = reference.state_dict()
    assert {key: tuple(value.shape) for key, value in state.items()} == {
        k: shape for k, (shape, _) in tensor_maps().items()
    }
    assert len(state) == 185
    assert sum(p.numel() for p in reference.parameters()) == 1_992_841
    assert sum(p.numel() for p in BPnPNet().parameters()) == 1_992_841


@pytest.mark.slow
@pytest.mark.parametrize("zipped", [True, False])
def test_converted_weights_give_the_cost_and_assignment_of_the_released_code(
    reference: Released, tmp_path: Path, zipped: bool
) -> None:
    file = tmp_path / "ModelNet40.pth.tar"
    torch.save(checkpoint(reference), file, _use_new_zipfile_serialization=zipped)
    net = load_authors_weights(file).double()
    reference = Released()
    reference.load_state_dict(torch.load(file, weights_only=False)["state_dict"])
    reference.double().eval()
    sets = [(p2.double(), p3.double()) for p2, p3 in pairs()]
    batch = Batch.from_arrays([p2 for p2, _ in sets], [p3 for _, p3 in sets])
    cost, assignment = net.cost(batch), net.match(batch).assignment
    for i, (p2, p3) in enumerate(sets):
        expected = reference(p2[None], p3[None])[0]
        assert expected.std() > 0.02  # enough for the assignment to depend on it
        torch.testing.assert_close(cost[i, : len(p2), : len(p3)], expected, rtol=0, atol=1e-9)
        torch.testing.assert_close(assignment[i, : len(p2), : len(p3)], plan(expected), rtol=1e-4, atol=1e-8)


def test_convert_weights_writes_our_checkpoint(
    reference: Released, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "released.pth.tar", tmp_path / "sub" / "out.ckpt"
    torch.save(checkpoint(reference), file)
    main(["convert-weights", str(file), str(out)])
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert list(out.parent.iterdir()) == [out]
    (p2, p3), net = pairs()[0], BPnPNet.from_checkpoint(out)
    assert not net.training
    torch.testing.assert_close(net.cost(Batch.from_arrays(p2, p3)), reference(p2[None], p3[None]), rtol=0, atol=2e-3)
    data = MeshDataModule(num_points=16, pool_size=16, test_shapes=2, cache_dir=str(tmp_path))
    task = BlindPnPTask()
    quiet_trainer(tmp_path).test(task, data, ckpt_path=str(out), weights_only=True)
    torch.testing.assert_close(task.solver.state_dict(), net.state_dict(), rtol=0, atol=0)


def test_the_weights_are_not_replaced_by_the_checkpoint_made_of_them(
    reference: Released, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, link = tmp_path / "released.pth.tar", tmp_path / "link.ckpt"
    torch.save(checkpoint(reference), file)
    link.symlink_to(file)
    before = file.read_bytes()
    for out in (file, link):
        with pytest.raises(SystemExit):
            main(["convert-weights", str(file), str(out)])
        assert f"{out} is an input and would be overwritten; name another file" in capsys.readouterr().err
    assert file.read_bytes() == before


BIAS = "FeatureExtractor2d.conv_11.conv2.0.bias"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({BIAS: None}, f"no '{BIAS}'"),
        ({"stn.fc4.bias": torch.zeros(3)}, "an unexpected 'stn.fc4.bias'"),
        ({BIAS: torch.zeros(127)}, rf"'{BIAS}' of shape \(127,\), not \(128,\)"),
        ({"stn.conv1.weight": torch.zeros(64, 3)}, r"'stn.conv1.weight' of shape \(64, 3\), not \(64, 3, 1\)"),
        ({BIAS: 3.0}, f"'{BIAS}' as a float"),
        ({BIAS: torch.full((128,), torch.nan)}, f"'{BIAS}' with NaN"),
    ],
)
def test_a_wrong_tensor_is_named(reference: Released, tmp_path: Path, change: dict[str, object], message: str) -> None:
    state = {k: v for k, v in (reference.state_dict() | change).items() if v is not None}
    torch.save({"state_dict": state}, tmp_path / "x.pth.tar")
    with pytest.raises(ValueError, match=message):
        load_authors_weights(tmp_path / "x.pth.tar")


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "x.pth.tar"
    torch.save({"state_dict": {}, "optimizer": Exploit()}, file, _use_new_zipfile_serialization=zipped)
    with pytest.raises(ValueError, match=r"cannot read .*x\.pth\.tar: .*system in it is refused"):
        load_authors_weights(file)
    assert not Path("hacked").exists()


def test_a_file_that_holds_no_weights_is_named(reference: Released, tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    torch.save(checkpoint(reference), whole)
    contents = {
        "empty": b"",
        "text": b"Not Found",
        "html": b"<!DOCTYPE html><html></html>",
        "truncated": whole.read_bytes()[:-5000],
        "half": whole.read_bytes()[: whole.stat().st_size // 2],
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"cannot read .*{name}: "):
            load_authors_weights(tmp_path / name)
    for name, value in {"list": [1], "bare": OrderedDict(a=torch.zeros(1)), "date": {"state_dict": 1}}.items():
        torch.save(value, tmp_path / name)
        with pytest.raises(ValueError, match=f"{name} has no `state_dict`"):
            load_authors_weights(tmp_path / name)
    torch.save({"state_dict": {}, "when": datetime.date(2020, 7, 1)}, tmp_path / "object")
    with pytest.raises(ValueError, match=r"datetime\.date in it"):
        load_authors_weights(tmp_path / "object")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_authors_weights(tmp_path / "nowhere")
