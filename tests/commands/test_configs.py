from pathlib import Path

import pytest
from planted_model import plant_model
from small_data import SMALL_NET, write_mesh_tree

from bpnp.cli import main

CONFIGS = Path(__file__).parents[2] / "configs"
RECIPES = sorted(path.name for path in CONFIGS.glob("*.yaml"))


def data_for(recipe: str, folder: Path) -> list[str]:
    """Where the recipe's data are, in small."""
    small = ["--data.batch_size=2"]
    if recipe.startswith(("colmap", "megadepth")):
        for i in range(5):
            plant_model(folder / "scenes" / f"scene{i}" / "sparse" / "0", seed=i)
        return [*small, f"--data.root={folder / 'scenes'}"]
    if recipe.startswith("sfm"):
        return [*small, "--data.num_points=30", "--data.train_pairs=4", "--data.val_pairs=2", "--data.test_pairs=2"]
    small += ["--data.num_points=30", "--data.pool_size=64", "--data.train_pairs=4", f"--data.cache_dir={folder}"]
    if recipe.startswith("quickstart"):
        return [*small, "--data.train_shapes=4", "--data.val_shapes=2", "--data.test_shapes=2"]
    return [*small, f"--data.root={write_mesh_tree(folder / 'meshes', train=4)}", "--data.val_fraction=0.3"]


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_trains_and_tests(recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.chdir(tmp_path)
    arguments = [f"--config={CONFIGS / recipe}", *data_for(recipe, tmp_path), f"--trainer.default_root_dir={tmp_path}"]
    matcher = "bpnp.models.Matcher" in (CONFIGS / recipe).read_text()
    arguments += ["--model.solver.channels=16", "--model.solver.depth=2"] if matcher else SMALL_NET[1:]
    main(["fit", *arguments, "--trainer.fast_dev_run=true"])
    main(["test", *arguments, "--trainer.fast_dev_run=true"])


@pytest.mark.parametrize("preset", sorted(path.name for path in (CONFIGS / "presets").glob("*.yaml")))
def test_every_preset_joins_a_recipe(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    configs = [f"--config={CONFIGS / 'quickstart.yaml'}", f"--config={CONFIGS / 'presets' / preset}"]
    arguments = [*configs, *data_for("quickstart", tmp_path), *SMALL_NET[1:]]
    main(["fit", *arguments, f"--trainer.default_root_dir={tmp_path}"])
