"""What `import bpnp` and the first `solve` load: nothing that they do not use."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bpnp
from bpnp.examples import load

pytestmark = pytest.mark.slow

COSTLY = ("lightning", "wandb", "trimesh", "pandas", "matplotlib", "plotly", "torchmetrics")
OTHERS = ("roma", "torch._dynamo", "bpnp.models", "sympy", "scipy.optimize", "numba", "pycolmap", "jsonargparse")


def loaded(statements: str, names: tuple[str, ...]) -> list[str]:
    """Which of the modules `names` are loaded after `statements` in a new interpreter."""
    ask = f"import sys\n{statements}\nprint(*[name for name in {names} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()


def test_importing_the_package_loads_neither_compilers_nor_optimisers() -> None:
    assert loaded("import bpnp", (*COSTLY, *OTHERS)) == []


def run_loads(*lines: str) -> list[str]:
    """Which of the modules COSTLY these commands load, and torch."""
    calls = "\n".join(f"try:\n    main({line.split()})\nexcept SystemExit:\n    pass" for line in lines)
    return loaded(f"from bpnp.cli import main\n{calls}", (*COSTLY, "torch"))


def test_help_and_mistakes_load_no_torch() -> None:
    commands = ("solve", "prepare", "localize", "report", "view", "table", "convert-weights", "wandb", "fit")
    mistakes = ("slove", "solve --bogus", "solve")
    assert run_loads("--help", "--version", *mistakes, *(f"{name} --help" for name in commands)) == []


def test_the_command_that_solves_loads_no_torch(tmp_path: Path) -> None:
    example = load("mesh")
    for name, points in (("points2d", example.points2d), ("points3d", example.points3d), ("camera", example.camera)):
        np.savetxt(tmp_path / f"{name}.csv", points, delimiter=",")
    files = [str(tmp_path / f"{name}.csv") for name in ("points2d", "points3d", "camera")]
    assert run_loads(f"solve {files[0]} {files[1]} --camera {files[2]}") == []
    assert "lightning" in run_loads("convert-weights nowhere out.ckpt")  # the check sees what is loaded


@pytest.mark.parametrize("name", bpnp.__all__)
def test_every_public_name_is_found_and_listed(name: str) -> None:
    assert getattr(bpnp, name).__name__ == name
    assert name in dir(bpnp)
