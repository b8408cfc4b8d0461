"""Compiled loops: kept where they can be kept, and announced."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bpnp.loops.compilation

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


def started(package: Path, cache: str, before: str = "") -> "subprocess.Popen[str]":
    """A process that calls the loop of the package after the statements `before`."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    environment |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": cache, "HOME": cache}
    ask = [sys.executable, "-c", f"from bpnp.loop import double\n{before}print(double(4), double(5))"]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(ask, env=environment, cwd=package, **streams)  # type: ignore[call-overload,no-any-return]


def doubled(package: Path, cache: str) -> tuple[str, str]:
    """What such a process prints and logs."""
    return started(package, cache).communicate(timeout=120)


def test_a_package_that_cannot_be_written_to_compiles_once_into_the_users_cache(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first, second = doubled(package, str(cache)), doubled(package, str(cache))
    assert first[0] == second[0] == "8 10\n"
    assert first[1].count("compiling") == 1
    assert second[1] == ""
    assert list(cache.rglob("*.nbi"))


def test_a_change_of_a_file_that_a_loop_reads_compiles_again(package: Path, tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    assert doubled(package, cache)[0] == "8 10\n"
    (package / "bpnp" / "factor.py").write_text(FACTOR.replace("2", "30"))
    assert doubled(package, cache)[0] == "120 150\n"
    with (package / "bpnp" / "loops" / "compilation.py").open("a") as source:
        source.write("# compiles in another way\n")
    assert doubled(package, cache)[1].count("compiling") == 1


def test_processes_that_compile_at_once_do_not_break_each_other(package: Path, tmp_path: Path) -> None:
    """All find the loop's value, and what they leave in the cache is whole: the next one compiles nothing."""
    cache, gate = str(tmp_path / "cache"), tmp_path / "gate"
    gate.mkdir()
    wait = (
        f"import os, time\nopen(f'{gate}/{{os.getpid()}}', 'w').close()\n"
        f"while len(os.listdir('{gate}')) < 3: time.sleep(0.001)\n"
    )
    for process in [started(package, cache, wait) for _ in range(3)]:
        printed, logged = process.communicate(timeout=120)
        assert (process.returncode, printed) == (0, "8 10\n"), logged
    assert doubled(package, cache) == ("8 10\n", "")


SIGNATURES = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from bpnp import GravityPrior, PosePrior, solve
from bpnp.search.warm_up import warm_up
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
    assert {"explore", "descend", "descend_sparse", "add_shifted", "add_up"} <= set(versions)
    assert set(versions.values()) == {"1"}
    assert used == warm


def test_the_time_of_compilation_is_in_no_limit(tmp_path: Path) -> None:
    """The clock of deadlines stands still while a loop is compiled, and only then."""
    script = (
        "from bpnp.loops.parallel import Clock\n"
        "from bpnp.search.kernels.neighbours import hashed\n"
        "import numpy as np\n"
        "hashed(np.eye(3), 0.1).count_on(np.eye(3), np.zeros((1, 3)), 1)\n"
        "print(Clock.compiling)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    seconds = []
    for _ in range(2):
        run = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
        )
        seconds.append(float(run.stdout))
    assert seconds[0] > 0.01
    assert seconds[1] == 0
