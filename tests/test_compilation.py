"""Compiled loops: kept where they can be kept, and announced."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bpnp.runtime

pytestmark = pytest.mark.nightly

CONSTANTS = """
OFFSET = 0
"""
FACTOR = """
from typing import NamedTuple
from bpnp.runtime import compiler


class Scaled(NamedTuple):
    value: int
    times: int


@compiler(part=True)
def factor():
    return 2
"""
LOOP = """
from bpnp.constants import OFFSET
from bpnp.runtime import compiler
from bpnp.factor import factor


@compiler()
def double(x):
    return factor() * x.value + OFFSET
"""
CALL = """
import numba
import bpnp.factor
from bpnp.loop import double
from bpnp.runtime import Clock
print(double(bpnp.factor.Scaled(4, 1)), double(bpnp.factor.Scaled(5, 1)), Clock.compiling > 0, numba.config.CACHE_DIR)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Create a package `bpnp` with a compiled loop, in a folder that no user can write to."""
    folder = tmp_path / "installed" / "bpnp"
    source = Path(bpnp.runtime.__file__).parent
    folder.mkdir(parents=True)
    for name in ("runtime.py", "files.py", "bounded_files.py"):
        shutil.copy(source / name, folder)
    (folder / "__init__.py").touch()
    (folder / "constants.py").write_text(CONSTANTS)
    (folder / "factor.py").write_text(FACTOR)
    (folder / "loop.py").write_text(LOOP)
    (folder / "__pycache__").touch()  # a file where the folder would be
    return folder.parent


def start(package: Path, cache: Path, code: str = CALL) -> subprocess.Popen[str]:
    """Start a process that calls the loop, with a home in which it may write to `cache`."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA", "BPNP"))}
    environment |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": str(cache), "HOME": str(cache)}
    call = [sys.executable, "-c", code]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(call, env=environment, cwd=package, text=True, **pipes)


def called(package: Path, cache: Path, code: str = CALL) -> tuple[str, str]:
    """Return what a new process that calls the loop prints, and what it logs."""
    process = start(package, cache, code)
    out, log = process.communicate()
    assert process.returncode == 0, log
    return out, log


def test_a_loop_is_compiled_once_into_the_users_cache(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first, second = called(package, cache), called(package, cache)
    assert first[0] == second[0] == "8 10 True \n"  # numba's own setting is unchanged: empty
    assert (first[1].count("compiling"), second[1]) == (1, "")
    assert list((cache / "bpnp" / "loops").rglob("*.nbc"))
    assert not list(package.rglob("*.nbc"))


def test_a_loop_is_compiled_again_after_a_change_of_a_part_a_tuple_or_a_number_of_another_file(
    package: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    assert called(package, cache)[0] == "8 10 True \n"
    (package / "bpnp" / "factor.py").write_text(FACTOR.replace("return 2", "return 30"))
    assert called(package, cache)[0] == "120 150 True \n"
    swapped = FACTOR.replace("value: int\n    times: int", "times: int\n    value: int")
    (package / "bpnp" / "factor.py").write_text(swapped)  # the types of the fields are as before
    assert called(package, cache)[0] == "2 2 True \n"
    (package / "bpnp" / "factor.py").write_text(FACTOR)
    (package / "bpnp" / "constants.py").write_text(CONSTANTS.replace("0", "7"))
    assert called(package, cache)[0] == "15 17 True \n"
    (package / "bpnp" / "constants.py").write_text(CONSTANTS)
    out, log = called(package, cache)
    assert (out, log) == ("8 10 True \n", "")  # the first version is still there


def test_one_of_several_processes_compiles_a_loop(package: Path, tmp_path: Path) -> None:
    processes = [start(package, tmp_path / "cache") for _ in range(3)]
    ends = [process.communicate() for process in processes]
    assert [out for out, _ in ends] == ["8 10 True \n"] * 3
    assert sum(log.count("compiling") for _, log in ends) == 1


def test_a_loop_runs_where_nothing_can_be_written(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    cache.touch()  # a file where the folder would be
    out, log = called(package, cache)
    assert out == "8 10 True \n"
    assert "compiling" in log
    assert f"in every process, since {cache}/bpnp/loops cannot be written" in log


FULL = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
"""


def test_a_loop_runs_where_its_code_does_not_fit_on_the_disk(package: Path, tmp_path: Path) -> None:
    """The folder can be written to, but no file may have more than 2000 bytes; without the limit the loop is kept."""
    cache = tmp_path / "cache"
    out, log = called(package, cache, FULL + CALL)
    assert out == "8 10 True \n"
    assert "compiling" in log
    assert not list(cache.rglob("*.nbc"))
    assert called(package, cache)[0] == "8 10 True \n"
    assert list(cache.rglob("*.nbc"))


SIGNATURES = """
import sys
import numpy as np
from bpnp.runtime import Loop
from bpnp import GravityPrior, PosePrior, solve
from bpnp.search.find import warm_up
def signatures():
    loops = {loop for name in list(sys.modules) if name.startswith("bpnp.search.")
             for loop in vars(sys.modules[name]).values()
             if isinstance(loop, Loop)}
    return sorted(f"{loop.__name__}:{len(loop.compiled.signatures) if loop.compiled else 0}" for loop in loops)
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


def test_after_warm_up_no_problem_compiles_a_loop() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNATURES], capture_output=True, text=True, check=True)
    warm, used = done.stdout.splitlines()
    versions = dict(entry.split(":") for entry in warm.split())
    assert {"explore", "descend", "descend_sparse", "add_up"} <= set(versions)
    assert set(versions.values()) == {"1"}
    assert used == warm
