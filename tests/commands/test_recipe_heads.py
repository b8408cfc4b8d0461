"""The head of each recipe names what differs from the paper's recipe, with the values of the parsed options."""

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import bpnp
from bpnp.cli import main
from bpnp.layers import RansacPnP, Sinkhorn, WeightedPnP
from bpnp.models.evaluation import Refinement
from bpnp.models.nets import ImageFeatures, SceneFeatures

pytestmark = pytest.mark.slow

Options = dict[str, Any]
Parse = Callable[[str], Options]

CONFIGS = Path(bpnp.__file__).parents[1] / "configs"
RECIPES = [*sorted(path.stem for path in CONFIGS.glob("*.yaml")), "paper/finetune_reprojection"]
PARTS = {
    "features2d": ImageFeatures,
    "features3d": SceneFeatures,
    "transport": Sinkhorn,
    "ransac": RansacPnP,
    "pnp": WeightedPnP,
    "refinement": Refinement,
}
# Where a run is stored, what it logs, and how fast it loads: no difference of the experiment.
LOGGED = re.compile(r"trainer\.(default_root_dir|logger|log_every_n_steps)|data\.num_workers")
# Words of the head for an option that differs; in braces, a value of the recipe and its format.
SHAPES = "{data.train_shapes:,} drawn shapes"
POINTS = "{data.num_points:,} of {data.pool_size:,} points"
EPOCHS = "{switch.start_epoch} + {switch.rest} epochs"
STEPS = "{trainer.max_steps} steps in all"
NO_VALIDATION = "no validation"
NEWTON = "Newton's method"
PHRASES = {
    "data.class_path": "drawn maps",
    "data.root": SHAPES,
    "data.train_shapes": SHAPES,
    "data.val_shapes": "{data.val_shapes} for validation",
    "data.test_shapes": "{data.test_shapes} for tests",
    "data.val_problems": "{data.val_problems} for validation",
    "data.test_problems": "{data.test_problems} for tests",
    "data.train_problems": "{data.train_problems:,} problems an epoch",
    "data.max_points": "at most {data.max_points} points",
    "data.num_points": POINTS,
    "data.pool_size": POINTS,
    "data.min_points": "at least {data.min_points} matches",
    "data.fresh_views": "new views every epoch",
    "data.batch_size": "batches of {data.batch_size}",
    "data.rotation": "any rotation",
    "data.val_fraction": "{data.val_fraction:.0%} of the scenes for validation",
    "data.test_fraction": "no test",
    "data.train_outliers": "outliers in training",
    "data.outliers": "outliers of up to {data.outliers.1:.0%} of a side",
    "data.frame": "in the axes of a view",
    "model.solver.class_path": "another network",
    "model.solver.frame": "in the axes of a view",
    "model.solver.features2d.centre": "centred features",
    "model.solver.features3d.centre": "centred features",
    "model.solver.features2d.scale": "image coordinates times {model.solver.features2d.scale:g}",
    "model.solver.features3d.normalise": "normalised scene points",
    "model.solver.ransac.backend": "LO-RANSAC",
    "model.solver.ransac.matches_factor": "{model.solver.ransac.matches_factor:g} min(m, n) matches",
    "model.solver.ransac.threshold": "threshold {model.solver.ransac.threshold:g}",
    "model.solver.pnp.solver": NEWTON,
    "model.solver.pnp.tolerance": NEWTON,
    "model.solver.pnp.max_iterations": NEWTON,
    "model.solver.pnp.clip_columns": "no clipping of the derivative's columns",
    "model.solver.refinement.enabled": "refinement in tests",
    "model.solver.rounds": "{model.solver.rounds} rounds of matching",
    "model.learning_rate": "learning rate {model.learning_rate:.0e}",
    "model.warmup_steps": "warm-up of {model.warmup_steps} steps",
    "model.matching_loss": "likelihood in place of L_c",
    "model.loss.class_path": "reprojection loss in place of L_c",
    "model.weights": "packaged weights to start from",
    "switch": "no pose loss",
    "switch.start_epoch": EPOCHS,
    "switch.weight": "pose loss of weight {switch.weight:g}",
    "trainer.max_epochs": EPOCHS,
    "trainer.max_steps": STEPS,
    "trainer.limit_val_batches": NO_VALIDATION,
    "trainer.gradient_clip_val": "gradients clipped to {trainer.gradient_clip_val:g}",
    "trainer.check_val_every_n_epoch": "validation every {trainer.check_val_every_n_epoch} epochs",
}


def flatten(options: Options, prefix: str = "") -> Options:
    """Return the options by dotted name, without `init_args`; of callbacks those of `PoseLossWarmup`, as "switch"."""
    found: Options = {}
    for key, value in options.items():
        name = prefix if key == "init_args" else f"{prefix}{key}."
        if key == "callbacks":
            for callback in value or []:
                if callback["class_path"].endswith("PoseLossWarmup"):
                    found |= flatten(callback["init_args"], "switch.")
        elif isinstance(value, dict):
            found |= flatten(value, name)
        elif isinstance(value, list) and not any(isinstance(each, dict) for each in value):
            found |= {f"{name}{i}": each for i, each in enumerate(value)}
        else:
            found[name.removesuffix(".")] = value
    return found


def fill_defaults(options: Options) -> Options:
    """Replace each part of a network that is None by the options of its constructor."""
    arguments = options["model"]["solver"]["init_args"]
    for name in PARTS.keys() & arguments.keys():
        defaults = {key: each.default for key, each in inspect.signature(PARTS[name]).parameters.items()}
        arguments[name] = defaults | (arguments[name] or {}).get("init_args", {})
    return options


@pytest.fixture
def parse(capsys: pytest.CaptureFixture[str]) -> Parse:
    """Return the options of a recipe as `bpnp fit --print_config` prints them, with those of default parts."""

    def parse(name: str) -> Options:
        with pytest.raises(SystemExit):
            main(["fit", f"--config={name}", "--print_config"])
        options = flatten(fill_defaults(yaml.safe_load(capsys.readouterr().out)))
        if "switch.start_epoch" in options:
            options["switch.weight"] = options["switch.weight"] or 1.0  # None: 1, as `pose_weight` is 0
        return options

    return parse


def read_head(recipe: str) -> tuple[str, str]:
    """Return the paper's recipe to which the head of a recipe compares it, and the differences."""
    lines = (CONFIGS / f"{recipe}.yaml").read_text(encoding="utf-8").splitlines()
    head = " ".join(line.strip("# ") for line in lines if line.startswith("#"))
    found = re.search(r"Differences from configs/(paper/\w+)\.yaml: (.*?)\. Needs: ", head)
    assert found is not None, head
    return found[1], found[2]


def find_differences(own: Options, paper: Options, explicit: set[str]) -> set[str]:
    """Return the names of the options that differ, with one name for all options of outliers.

    Options of a class that the paper does not use are compared only if the recipe sets them.
    """
    compared = {key for key in own if key in paper or key in explicit}
    differing = {key for key in compared if own[key] != paper.get(key) and not LOGGED.fullmatch(key)}
    if own.get("data.root"):  # where the user's data lie
        differing.discard("data.root")
    if "switch.start_epoch" not in own:
        differing.add("switch")
    return {re.sub(r"outliers\..*", "outliers", key) for key in differing}


def fill(phrase: str, options: Options) -> str:
    """Replace `{name:format}` by the value of the option."""
    text = re.sub(r"\{([\w.]+):?([^}]*)\}", lambda found: format(options[found[1]], found[2]), phrase)
    return text.replace("e-0", "e-").replace("%", " %")


def phrases_for(own: Options, differing: set[str]) -> dict[str, str]:
    """Return the phrases, with those of a recipe that has no switch, no validation or no pool of points."""
    phrases = dict(PHRASES)
    if "switch" in differing:
        phrases["trainer.max_epochs"] = "{trainer.max_epochs} epochs" if own["trainer.max_steps"] < 0 else STEPS
    if "data.pool_size" not in own:
        phrases["data.num_points"] = "{data.num_points} points"
    if own.get("data.val_fraction") == 0:
        phrases["data.val_fraction"] = NO_VALIDATION
    return phrases


def find_idle_phrases(head: str, needed: set[str]) -> set[str]:
    """Return the phrases of a head, with any values, that none of the needed ones is an example of."""
    number = r"[\d.,]+(e-\d+)?( %)?"
    patterns = {re.sub(r"\\\{.*?\\\}", lambda _: number, re.escape(phrase)) for phrase in PHRASES.values()}
    idle = {pattern for pattern in patterns if not any(re.search(pattern, phrase) for phrase in needed)}
    return {found[0] for pattern in idle if (found := re.search(rf"(?<![\w-]){pattern}(?![\w-])", head))}


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_head_of_a_recipe_names_what_differs_from_the_paper_and_nothing_else(recipe: str, parse: Parse) -> None:
    reference, head = read_head(recipe)
    own, paper = parse(recipe), parse(reference)
    explicit = set(flatten(yaml.safe_load((CONFIGS / f"{recipe}.yaml").read_text(encoding="utf-8"))))
    differing = find_differences(own, paper, explicit)
    assert differing <= PHRASES.keys(), f"no words for {differing - PHRASES.keys()}"
    own["switch.rest"] = own["trainer.max_epochs"] - own.get("switch.start_epoch", 0)
    phrases = phrases_for(own, differing)
    expected = {fill(phrases[name], own) for name in differing}
    assert {phrase for phrase in expected if phrase not in head} == set()
    assert find_idle_phrases(head, expected) == set()
    assert len(differing) > 3


def test_a_head_with_a_difference_that_is_none_is_found() -> None:
    head = "batches of 8, learning rate 1e-4 after a warm-up of 20 steps, no pose loss, refinement in tests"
    needed = {"batches of 8", "warm-up of 20 steps", "no pose loss"}
    assert find_idle_phrases(head, needed) == {"learning rate 1e-4", "refinement in tests"}
    assert find_idle_phrases("validation every 8 epochs, 10 % of the scenes for validation", needed) == {
        "validation every 8 epochs",
        "10 % of the scenes for validation",
    }


@pytest.mark.parametrize("name", ["modelnet40", "megadepth"])
def test_the_experiments_of_the_paper_have_none_of_our_additions(name: str, parse: Parse) -> None:
    """docs/paper.md lists the additions; a test then computes the paper's two estimates."""
    paper = parse(f"paper/{name}")
    assert not paper["model.solver.refinement.enabled"]
    assert (paper["model.solver.rounds"], paper["model.matching_loss"]) == (0, "correspondence")
    assert (paper["model.warmup_steps"], paper["trainer.gradient_clip_val"], paper["optimizer"]) == (0, None, None)
    assert not any(paper[f"model.solver.features{size}d.centre"] for size in (2, 3))


def test_the_preset_has_the_loss_and_the_ransac_of_the_paper(parse: Parse) -> None:
    preset = flatten(yaml.safe_load((CONFIGS / "presets/correspondence.yaml").read_text(encoding="utf-8")))
    paper = parse("paper/modelnet40")
    names = {f"model.solver.ransac.{name}" for name in ("backend", "matches_factor", "threshold")}
    names |= {"model.solver.rounds", "model.matching_loss"}
    assert {name: preset.get(name) for name in names} == {name: paper[name] for name in names}
