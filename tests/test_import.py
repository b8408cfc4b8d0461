"""`import bpnp` and the first `solve` load nothing that they do not use."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from planted_model import plant_model

import bpnp
from bpnp.examples import load

pytestmark = pytest.mark.slow

COSTLY = ("lightning", "wandb", "trimesh", "pandas", "matplotlib", "plotly", "torchmetrics")
OTHERS = ("roma", "torch._dynamo", "bpnp.models", "sympy", "scipy.optimize", "numba", "pycolmap", "jsonargparse")


def loaded(statements: str, names: tuple[str, ...]) -> list[str]:
    """Return which of the modules `names` are loaded after `statements` in a new interpreter."""
    ask = f"import sys\n{statements}\nprint(*[name for name in {names} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()


def test_importing_the_package_loads_neither_compilers_nor_optimisers() -> None:
    assert loaded("import bpnp", (*COSTLY, *OTHERS)) == []


def run_loads(*lines: str) -> list[str]:
    """Return which of the modules COSTLY these commands load, and torch."""
    calls = "\n".join(f"try:\n    main({line.split()})\nexcept SystemExit:\n    pass" for line in lines)
    return loaded(f"from bpnp.cli import main\n{calls}", (*COSTLY, "torch"))


def test_help_and_mistakes_load_no_torch() -> None:
    commands = ("solve", "prepare", "localize", "report", "view", "table", "convert-weights", "wandb", "fit")
    mistakes = ("slove", "solve --bogus", "solve")
    assert run_loads("--help", "--version", *mistakes, *(f"{name} --help" for name in commands)) == []


def saved_example(folder: Path) -> list[str]:
    """Write image points, scene points and camera of an example; return the names of the files."""
    example = load("mesh")
    sides = {"points2d": example.points2d, "points3d": example.points3d, "camera": example.camera}
    for name, values in sides.items():
        np.savetxt(folder / f"{name}.csv", values, delimiter=",")
    pose = {"rotation": example.rotation.tolist(), "translation": example.translation.tolist()}
    (folder / "pose.json").write_text(json.dumps(pose))
    return [str(folder / name) for name in ("points2d.csv", "points3d.csv", "camera.csv", "pose.json")]


def test_the_commands_that_solve_and_verify_load_no_torch(tmp_path: Path) -> None:
    points2d, points3d, camera, pose = saved_example(tmp_path)
    solve = f"solve {points2d} {points3d} --camera {camera} --output {tmp_path}/found.json"
    assert run_loads(solve, f"verify {points2d} {points3d} {pose} --camera {camera}") == []
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "confident"
    assert "torch" in run_loads(f"solve {points2d} {points3d} --camera {camera} --device cpu")  # the check sees it


def test_a_missing_file_is_reported_before_the_search_is_loaded(tmp_path: Path) -> None:
    points2d, points3d, *_ = saved_example(tmp_path)
    none = tmp_path / "none.csv"
    lines = f"solve {none} {points3d}", f"solve {points2d} {none}", f"verify {points2d} {points3d} {tmp_path}/none.json"
    calls = "\n".join(f"try:\n    main({line.split()})\nexcept SystemExit:\n    pass" for line in lines)
    assert loaded(f"from bpnp.cli import main\n{calls}", ("numba", "scipy", "bpnp.search", "torch")) == []


LOCALIZE = """
from bpnp import SceneMap
scene = SceneMap.from_colmap({folder!r})
view = scene.views[0]
pixels = view.camera.project(scene.points3d[view.points] @ view.rotation.T + view.translation)
assert scene.localize(pixels, view.camera).verdict == "confident"
"""


def test_a_photo_is_localized_in_a_map_without_torch(tmp_path: Path) -> None:
    plant_model(tmp_path, images=4, points=120, seen=60)
    assert loaded(LOCALIZE.format(folder=str(tmp_path)), (*COSTLY, "torch")) == []


@pytest.mark.parametrize("name", bpnp.__all__)
def test_every_public_name_is_found_and_listed(name: str) -> None:
    assert getattr(bpnp, name).__name__ == name
    assert name in dir(bpnp)
