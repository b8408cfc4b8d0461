"""Compiled loops: kept where they can be kept, and announced."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bpnp.loops.compilation

pytestmark = pytest.mark.slow

FACTOR = """
from bpnp.loops.compilation import compiler


@compiler(no_cpython_wrapper=True)
def factor():
    return 2
"""
LOOP = """
from bpnp.loops.compilation import compiler
from bpnp.factor import factor


@compiler()
def double(x):
    return factor() * x
"""
CALL = """
from bpnp.loop import double
from bpnp.loops.parallel import Clock
print(double(4), double(5), Clock.compiling > 0)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with a package `bpnp` of a compiled loop beside which nothing can be written, whoever runs the test."""
    folder = tmp_path / "installed" / "bpnp"
    shutil.copytree(Path(bpnp.loops.compilation.__file__).parent, folder / "loops")
    (folder / "__init__.py").touch()
    (folder / "factor.py").write_text(FACTOR)
    (folder / "loop.py").write_text(LOOP)
    (folder / "__pycache__").touch()  # a file where the folder would be
    return folder.parent


def doubled(package: Path, cache: str) -> tuple[str, str]:
    """What a new process that calls the loop prints, with whether the clock of limits stood still, and what it logs."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    environment |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": cache, "HOME": cache}
    ask = [sys.executable, "-c", CALL]
    done = subprocess.run(ask, env=environment, cwd=package, capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


def test_a_loop_is_compiled_once_into_the_users_cache_and_again_after_a_change(package: Path, tmp_path: Path) -> None:
    """Of its package, which cannot be written to, and of a file that the loop reads."""
    cache = str(tmp_path / "cache")
    first, second = doubled(package, cache), doubled(package, cache)
    assert (first[0], second[0]) == ("8 10 True\n", "8 10 False\n")
    assert (first[1].count("compiling"), second[1]) == (1, "")
    (package / "bpnp" / "factor.py").write_text(FACTOR.replace("2", "30"))
    assert doubled(package, cache)[0] == "120 150 True\n"


SIGNATURES = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from bpnp import GravityPrior, PosePrior, solve
from bpnp.search.search import warm_up
def signatures():
    loops = {loop for name in list(sys.modules) if name.startswith("bpnp.search.")
             for loop in vars(sys.modules[name]).values()
             if isinstance(loop, Dispatcher) and not loop.targetoptions.get("no_cpython_wrapper")}
    return sorted(f"{loop.py_func.__name__}:{len(loop.signatures)}" for loop in loops)
warm_up()
print(*signatures())
for n in (10, 100):
    points = np.random.default_rng(0).normal(size=(n, 3))
    seen = points + (0, 0, 6)
    labels, image = np.arange(n) % 3, seen[:, :2] / seen[:, 2:]
    solve(image, points)
    solve(image.astype(np.float32), np.asfortranarray(points), labels2d=labels, labels3d=labels.astype(np.int32))
    solve(image, points, normals3d=-seen / np.linalg.norm(seen, axis=1, keepdims=True))
    solve(image, points, prior=GravityPrior((0, 1, 0), (0, 1, 0)), time_limit=2)
    solve(image, points, prior=PosePrior(np.eye(3), None, 1.0), time_limit=2)
    solve(image, points, prior=PosePrior(np.eye(3), (0, 0, 6), 4.0, 0.3), time_limit=2)
    random = np.random.default_rng(1).normal(size=(n, 3)) + (0, 0, 9)
    solve(random[:, :2] / random[:, 2:], points, normals3d=points / np.linalg.norm(points, axis=1, keepdims=True),
          time_limit=3)
print(*signatures())
"""


def test_after_warming_up_nothing_is_compiled_whatever_the_arrays_of_a_problem() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNATURES], capture_output=True, text=True, check=True)
    warm, used = done.stdout.splitlines()
    versions = dict(entry.split(":") for entry in warm.split())
    assert {"explore", "descend", "descend_sparse", "add_up"} <= set(versions)
    assert set(versions.values()) == {"1"}
    assert used == warm
