"""Checkpoints: written and read as plain data, of networks made of parts."""

import io
from pathlib import Path
from typing import Any

import pytest
import torch
from planted import padded, plant
from small_data import small_net
from torch import Tensor, nn

from bpnp import Batch, BPnPNet, Matcher
from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP
from bpnp.models import Refinement, TrainedNet
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.models.weights import (
    LEARNED,
    PARTS,
    build_module,
    checkpoint_path,
    describe_module,
    differences,
    fitting_state,
    read_data,
)
from bpnp.search.arguments import checked_prior


class Flat(nn.Module):
    """A user's features: a linear map."""

    def __init__(self, coordinates: int, *, channels: int = 4) -> None:
        super().__init__()
        self.coordinates, self.channels = coordinates, channels
        self.map = nn.Linear(coordinates, channels)

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        return nn.functional.normalize(self.map(points), dim=-1)


def pair() -> Batch:
    return padded([plant(1, 10, outliers2d=2, seed=10, dtype=torch.float32)])


def content(net: nn.Module, **more: Any) -> dict[str, Any]:
    state = {f"solver.{name}": value for name, value in net.state_dict().items()}
    return {"solver": describe_module(net), "state_dict": state | more}


def save(net: nn.Module, path: Path, **more: Any) -> Path:
    torch.save(content(net, **more), path)
    return path


def test_a_checkpoint_gives_the_same_network(tmp_path: Path) -> None:
    net = small_net(transport=Sinkhorn(learn_mu=True), centre=True, normalise=True, rounds=2)
    again = BPnPNet.from_checkpoint(save(net, tmp_path / "net.ckpt", **{"other.weight": torch.ones(1)}))
    assert describe_module(again) == describe_module(net)
    assert not again.training
    with torch.no_grad():
        assert torch.equal(again.match(pair()).assignment, net.eval().match(pair()).assignment)


def test_a_checkpoint_gives_the_class_of_its_network(tmp_path: Path) -> None:
    net = Matcher(channels=16, depth=1, heads=2, frame="view").eval()
    file, other = save(net, tmp_path / "matcher.ckpt"), save(small_net(8, 1), tmp_path / "other.ckpt")
    again = TrainedNet.from_checkpoint(file)
    assert isinstance(again, Matcher)
    assert again.frame == "view"
    torch.testing.assert_close(again.match(pair()).assignment, net.match(pair()).assignment)
    with pytest.raises(ValueError, match=r"other.ckpt is a checkpoint of BPnPNet, not of Matcher"):
        Matcher.from_checkpoint(other)


def test_a_part_of_the_users_comes_back_only_if_the_user_names_its_class(tmp_path: Path) -> None:
    net = BPnPNet(Flat(2), Flat(3, channels=4), Sinkhorn(mu=0.3)).eval()
    file = save(net, tmp_path / "net.ckpt")
    with pytest.raises(ValueError, match=r"cannot load BPnPNet from .*net.ckpt: the class .*test_weights.Flat"):
        BPnPNet.from_checkpoint(file)
    again = BPnPNet.from_checkpoint(file, parts=[Flat])
    assert again.transport.mu == 0.3
    torch.testing.assert_close(again.match(pair()).assignment, net.match(pair()).assignment)


@pytest.mark.parametrize("name", ["os.system", "subprocess.Popen", "torch.nn.modules.linear.Linear", "BPnPNet.forward"])
def test_a_checkpoint_cannot_name_an_unknown_class(name: str, tmp_path: Path) -> None:
    solver = describe_module(small_net())
    solver["settings"]["transport"] = {"class": name, "settings": {"command": "true"}}
    torch.save({"solver": solver, "state_dict": {}}, tmp_path / "evil.ckpt")
    with pytest.raises(ValueError, match=rf"evil.ckpt: the class '{name}' is not among "):
        BPnPNet.from_checkpoint(tmp_path / "evil.ckpt")


def test_every_part_of_the_package_is_described_by_its_arguments() -> None:
    modules = [
        ImageFeatures(channels=8, depth=1, centre=True, scale=2.0),
        SceneFeatures(channels=8, depth=1, normalise=True),
        Sinkhorn(mu=0.3, learn_mu=True, tolerance=1e-5, max_iterations=7),
        RansacPnP(backend="opencv", matches_factor=2.0, threshold=0.1, max_iterations=9, seed=4),
        WeightedPnP(tolerance=1e-8, max_iterations=3),
        Refinement(hypotheses=3, enabled=False),
        Matcher(channels=8, depth=1, heads=2, neighbours=0, mu=0.2, tolerance=1e-5, ransac=RansacPnP(threshold=0.2)),
    ]
    for module in modules:
        description = describe_module(module)
        again = build_module(description, (*PARTS, BPnPNet, Matcher))
        assert describe_module(again) == description
        assert type(again) is type(module)
    assert describe_module(modules[2])["settings"]["mu"] == 0.3
    assert describe_module(modules[-1])["settings"]["ransac"]["settings"]["threshold"] == 0.2


def test_a_checkpoint_of_another_shape_is_refused_with_what_differs() -> None:
    saved, own = small_net(8, 1, normalise=True), small_net(16, 2)
    expected = (
        r"features2d.channels=16 \(saved: 8\), .*features3d.normalise=False \(saved: True\). Leave these settings out"
    )
    with pytest.raises(ValueError, match=expected):
        fitting_state(content(saved), own)
    # The shapes agree; the assignment would be another one.
    with pytest.raises(ValueError, match=r"another BPnPNet: features3d.normalise=True \(saved: False\)\."):
        fitting_state(content(own), small_net(normalise=True))
    state, adjusted = fitting_state(content(own), small_net(rounds=2))
    assert state.keys() == own.state_dict().keys()
    assert adjusted == ["rounds=2 (saved: 0)"]
    with pytest.raises(ValueError, match="a checkpoint of another program, not of BPnPNet"):
        fitting_state({"state_dict": {}}, own)
    assert list(differences(describe_module(Flat(2)), describe_module(Flat(3)))) == [("coordinates", 2, 3)]


def test_weights_without_a_part_may_differ_only_in_the_setting_that_creates_it() -> None:
    saved = content(Matcher(channels=16, depth=1, heads=2))
    view = Matcher(channels=16, depth=1, heads=2, frame="view")
    state, adjusted = fitting_state(saved, view, allow_added=True)
    assert adjusted == ["frame=view (saved: any)"]
    assert state.keys() == view.state_dict().keys()
    for option, other in (("heads", 4), ("neighbours", 5)):
        changed = Matcher(channels=16, depth=1, **({"heads": 2} | {option: other}), frame="view")
        with pytest.raises(ValueError, match=rf"another Matcher: {option}={other} \(saved: \d\)\. Leave"):
            fitting_state(saved, changed, allow_added=True)


def test_a_name_of_packaged_weights_is_never_a_file_of_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("matcher-clutter", LEARNED):
        save(Matcher(channels=16, depth=1, heads=2), Path(name))
    assert Matcher.from_pretrained("matcher-clutter").channels == 128
    assert isinstance(checked_prior("learned"), BPnPNet)
    assert checkpoint_path("./matcher-clutter") == checkpoint_path(Path("matcher-clutter")) == Path("matcher-clutter")
    assert Matcher.from_checkpoint("./matcher-clutter").channels == 16


@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_that_is_cut_anywhere_is_named(tmp_path: Path, zipped: bool) -> None:
    file, whole = tmp_path / "x.ckpt", io.BytesIO()
    torch.save({"state_dict": {"a": torch.rand(3)}, "epoch": 3}, whole, _use_new_zipfile_serialization=zipped)
    for end in range(0, len(whole.getvalue()), 5):
        file.write_bytes(whole.getvalue()[:end])
        with pytest.raises(ValueError, match=r"x\.ckpt is no checkpoint of `bpnp fit`: it cannot be read \(.+\)$"):
            read_data(file)
    file.write_bytes(whole.getvalue())
    assert read_data(file)["epoch"] == 3


OLDER = {"class": "BPnPNet", "settings": {"rounds": 8, "channels": 16, "blocks": 2}}
OLDER_PART = {"class": "BPnPNet", "settings": {"ransac": {"class": "RansacPnP", "settings": {"pairs_factor": 1.5}}}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"solver": OLDER, "state_dict": {}}, r"bpnp: BPnPNet has no setting `channels`\. Train the network again$"),
        (
            {"solver": OLDER_PART, "state_dict": {}},
            r"x\.ckpt is of another version of bpnp: RansacPnP has no setting `pairs_factor`\. Train the network",
        ),
        ({"solver": {"class": "Hungarian"}, "state_dict": {}}, r"x\.ckpt is a checkpoint of Hungarian, not of BPnPNet"),
        ({"state_dict": {}}, r"x\.ckpt is a checkpoint of another program, not of BPnPNet"),
        ([1], r"x\.ckpt is no checkpoint of `bpnp fit`: it has no `state_dict`"),
        ({"state_dict": {}, "solver": Path()}, r"x\.ckpt is no checkpoint of `bpnp fit`: it cannot be read"),
        ("epoch,loss\n1,0.5\n", r"x\.ckpt is no checkpoint of `bpnp fit`: it cannot be read"),
    ],
)
def test_a_file_that_is_no_checkpoint_is_named_and_runs_no_code(tmp_path: Path, content: Any, message: str) -> None:
    file = tmp_path / "x.ckpt"
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*x\.ckpt; give a file"):
        BPnPNet.from_checkpoint(file)
    file.write_text(content) if isinstance(content, str) else torch.save(content, file)
    with pytest.raises(ValueError, match=message):
        BPnPNet.from_checkpoint(file)
