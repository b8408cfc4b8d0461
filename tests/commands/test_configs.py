import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from authors_pickles import sample, write
from planted_model import plant_model
from small_data import SMALL_NET, write_mesh_tree
from torch import Tensor, nn

import bpnp
from bpnp import BPnPNet
from bpnp.cli import main

pytestmark = pytest.mark.slow

CONFIGS = Path(bpnp.__file__).parents[1] / "configs"
RECIPES = sorted(
    path.relative_to(CONFIGS).with_suffix("").as_posix()
    for folder in (".", "paper")
    for path in CONFIGS.glob(f"{folder}/*.yaml")
)
DAILY = {"quickstart", "matcher"} | {  # in `make test` too
    f"paper/{name}{kind}" for name in ("modelnet40", "megadepth") for kind in ("", "_code")
}


ADDED = {"presets", "successors"}  # folders of configurations that are given after a recipe


def data_for(recipe: str, folder: Path) -> list[str]:
    """Where the recipe's data are, in small."""
    small = ["--data.batch_size=2"]
    if recipe.startswith(("colmap", "megadepth", "paper/megadepth", "paper/finetune")):
        for i in range(5):
            plant_model(folder / "scenes" / f"scene{i}" / "sparse" / "0", seed=i)
        return [*small, f"--data.root={folder / 'scenes'}"]
    if recipe == "data61":
        return [*small, f"--data.root={write(folder / 'authors', [sample(i) for i in range(6)], 'data61_2d3d')}",
                f"--data.cache_dir={folder}", "--data.val_fraction=0.3"]  # fmt: skip
    if recipe.startswith("synthetic_maps"):
        few = {"num_points": 30, "train_problems": 4, "val_problems": 2, "test_problems": 2}
        return [*small, *(f"--data.{name}={count}" for name, count in few.items())]
    small += ["--data.num_points=30", "--data.pool_size=64", "--data.train_problems=4", f"--data.cache_dir={folder}"]
    if recipe.startswith("quickstart"):
        return [*small, "--data.train_shapes=4", "--data.val_shapes=2", "--data.test_shapes=2"]
    return [*small, f"--data.root={write_mesh_tree(folder / 'meshes', train=4)}", "--data.val_fraction=0.3"]


@pytest.mark.parametrize(
    "recipe",
    [pytest.param(recipe, marks=() if recipe in DAILY else pytest.mark.nightly) for recipe in RECIPES],
)
def test_every_recipe_trains_and_tests(recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.chdir(tmp_path)
    arguments = [f"--config={recipe}", *data_for(recipe, tmp_path), f"--trainer.default_root_dir={tmp_path}"]
    matcher = "bpnp.models.Matcher" in (CONFIGS / f"{recipe}.yaml").read_text()
    arguments += ["--model.solver.channels=16", "--model.solver.depth=2"] if matcher else SMALL_NET[1:]
    arguments += ["--model.weights=null"] if "weights:" in (CONFIGS / f"{recipe}.yaml").read_text() else []
    main(["fit", *arguments, "--trainer.fast_dev_run=true"])
    tested = ["--data.test_fraction=1"] if "finetune" in recipe else []  # on the scenes that it was tuned to
    main(["test", *arguments, *tested, "--trainer.fast_dev_run=true"])


class Coordinates(nn.Module):
    """A user's features: the coordinates themselves, turned by a learned map."""

    def __init__(self, size: int, channels: int = 8) -> None:
        super().__init__()
        self.size, self.channels = size, channels
        self.map = nn.Linear(size, channels)

    def forward(self, points: Tensor, mask: Tensor) -> Tensor:
        return nn.functional.normalize(self.map(points), dim=-1)


def test_a_part_is_swapped_in_the_recipe(tmp_path: Path) -> None:
    features = [f"--model.solver.features{size}d={__name__}.Coordinates" for size in (2, 3)]
    sizes = [f"--model.solver.features{size}d.size={size}" for size in (2, 3)]
    arguments = ["--config=procedural", *data_for("procedural", tmp_path), *features, *sizes]
    arguments += ["--model.solver.transport.mu=0.2", f"--trainer.default_root_dir={tmp_path}"]
    main(["fit", *arguments, "--trainer.max_epochs=1", "--trainer.limit_train_batches=1"])
    net = BPnPNet.from_checkpoint(tmp_path / "checkpoints" / "last.ckpt", parts=[Coordinates])
    assert (net.features3d.size, net.transport.mu, net.rounds) == (3, 0.2, 8)  # 8 rounds are the recipe's


@pytest.mark.nightly
@pytest.mark.parametrize(
    "preset",
    sorted(f"{path.parent.name}/{path.name}" for path in CONFIGS.glob("*/*.yaml") if path.parent.name in ADDED),
)
def test_every_preset_joins_a_recipe(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    configs = ["--config=quickstart", f"--config={preset.removesuffix('.yaml')}"]
    arguments = [*configs, *data_for("quickstart", tmp_path), *SMALL_NET[1:], "--pose_loss.start_epoch=0"]
    arguments += ["--trainer.max_epochs=1", "--trainer.limit_train_batches=2"] if "successors" in preset else []
    main(["fit", *arguments, f"--trainer.default_root_dir={tmp_path}"])
    used = dict(settings(yaml.safe_load((tmp_path / "logs" / "version_0" / "config.yaml").read_text())))
    wanted = dict(settings(yaml.safe_load((CONFIGS / preset).read_text())))
    wanted.pop("trainer.default_root_dir", None)  # the command line has another
    assert wanted.items() <= used.items()


def settings(config: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of each setting of a configuration."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


def printed(recipe: str, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """Return all settings that `bpnp fit` takes from a recipe, without `init_args` in their names."""
    with pytest.raises(SystemExit):
        main(["fit", f"--config={recipe}", "--print_config"])
    found = settings(yaml.safe_load(capsys.readouterr().out))
    return {name.replace("init_args.", ""): value for name, value in found}


@pytest.mark.parametrize("name", ["modelnet40", "megadepth"])
def test_the_experiments_of_the_paper_have_none_of_our_additions(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """docs/paper.md lists the additions; a test then computes the paper's two estimates."""
    paper = printed(f"paper/{name}", capsys)
    assert paper["model.solver.refinement.enabled"] == "False"
    assert (paper["model.solver.rounds"], paper["model.matching_loss"]) == ("0", "correspondence")
    unset = (paper["model.warmup_steps"], paper["trainer.gradient_clip_val"], paper["optimizer"])
    assert unset == ("0", "None", "None")
    assert [paper[f"model.solver.features{size}d"] for size in (2, 3)] == ["None", "None"]
    net = BPnPNet()
    assert not net.features2d.centre
    assert not net.features3d.centre


@pytest.mark.parametrize(("name", "rate"), [("modelnet40", 1e-4), ("megadepth", 1e-3)])
def test_the_recipes_of_the_authors_code_differ_in_what_their_heads_list(
    name: str, rate: float, capsys: pytest.CaptureFixture[str]
) -> None:
    paper, code = printed(f"paper/{name}", capsys), printed(f"paper/{name}_code", capsys)
    changed = {key: code[key] for key in code if code[key] != paper.get(key)}
    changed.pop("trainer.default_root_dir")
    assert {key: float(value) for key, value in changed.items() if value[0].isdigit()} == pytest.approx({
        "model.learning_rate": rate,
        "model.weight_decay": 1e-3,
        "model.pose_loss.max_rotation": math.pi / 2,
        "model.pose_loss.max_translation": 1.0,
        "model.solver.ransac.min_matches": 10,
        "model.solver.ransac.max_matches": 1000,
        "model.solver.refinement.angle": math.radians(1),
    })  # fmt: skip
    assert {key: value for key, value in changed.items() if not value[0].isdigit()} == {
        "model.pose_loss.class_path": "bpnp.training.PoseLoss",
        "model.solver.refinement.class_path": "bpnp.models.LeastSquares",
        "model.solver.refinement.enabled": "True",
    }


def test_the_preset_has_the_loss_and_the_ransac_of_the_paper(capsys: pytest.CaptureFixture[str]) -> None:
    preset = dict(settings(yaml.safe_load((CONFIGS / "presets" / "correspondence.yaml").read_text())))
    paper = printed("paper/modelnet40", capsys)
    names = {f"model.solver.ransac.{name}" for name in ("backend", "matches_factor", "threshold")}
    names |= {"model.solver.rounds", "model.matching_loss"}
    preset = {name.replace("init_args.", ""): value for name, value in preset.items()}
    assert {name: preset.get(name) for name in names} == {name: paper[name] for name in names}
