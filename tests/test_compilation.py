"""Compiled loops: kept where they can be kept, announced, and shared among threads of which none is stuck."""

import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

import bpnp.compilation
from bpnp.compilation import in_threads, one_blas_thread

FACTOR = """
from bpnp.compilation import compiler


@compiler(no_cpython_wrapper=True)
def factor():
    return 2
"""
LOOP = """
from bpnp.compilation import compiler
from bpnp.factor import factor


@compiler()
def double(x):
    return factor() * x
"""


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_every_index_is_visited_once_and_no_share_is_empty(threads: int, count: int) -> None:
    seen, shares = np.zeros(count, int), list[int]()

    def work(first: int, last: int) -> None:
        seen[first:last] += 1
        shares.append(last - first)

    in_threads(work, count)
    assert (seen == 1).all()
    assert len(shares) == max(min(threads, count), 1)
    assert count == 0 or min(shares) >= 1


@pytest.mark.parametrize("threads", [3], indirect=True)
def test_shares_run_at_the_same_time(threads: int) -> None:
    together = threading.Barrier(threads, timeout=20)
    in_threads(lambda _first, _last: together.wait(), threads)


def test_an_error_in_any_share_is_raised(threads: int) -> None:
    def fail(_first: int, last: int) -> None:
        if last == 10:
            raise ArithmeticError("last share")

    with pytest.raises(ArithmeticError, match="last share"):
        in_threads(fail, 10)


def _square(results: "multiprocessing.Queue[float]") -> None:
    torch.set_num_threads(2)
    squares = np.zeros(10)

    def work(first: int, last: int) -> None:
        squares[first:last] = np.arange(first, last) ** 2

    in_threads(work, 10)
    results.put(float(squares.sum()))


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*")
@pytest.mark.parametrize("threads", [2], indirect=True)
@pytest.mark.usefixtures("threads")
def test_a_fork_has_threads_of_its_own() -> None:
    in_threads(lambda _first, _last: None, 10)
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    child = context.Process(target=_square, args=(results,))
    child.start()
    assert results.get(timeout=60) == 285.0
    child.join()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with a package `bpnp` of a compiled loop beside which nothing can be written, whoever runs the test."""
    folder = tmp_path / "installed" / "bpnp"
    folder.mkdir(parents=True)
    shutil.copy(bpnp.compilation.__file__, folder / "compilation.py")
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


NOTE_STATE = """
import atexit, gc
from numba.core import event
from numba.core.types import BaseFunction
def note():
    print(gc.isenabled(), BaseFunction.get_call_type.__module__)
class Listener(event.Listener):
    def on_start(self, event):
        note()
    def on_end(self, event):
        pass
event.register("numba:compile", Listener())
atexit.register(note)
"""


@pytest.mark.parametrize(("before", "collects"), [("", True), ("gc.disable()\n", False)])
def test_what_rests_while_a_loop_is_compiled_goes_on_afterwards(
    before: str, collects: bool, package: Path, tmp_path: Path
) -> None:
    """Python's collector, and numba's own way to resolve the types of a call."""
    printed, _ = started(package, str(tmp_path / "cache"), NOTE_STATE + before).communicate(timeout=120)
    compiling, called, values, last = printed.splitlines()
    assert (compiling, called, values) == ("False bpnp.compilation", "False bpnp.compilation", "8 10")
    assert last == f"{collects} numba.core.types.functions"


def test_a_change_of_a_file_with_a_called_function_compiles_again(package: Path, tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    assert doubled(package, cache)[0] == "8 10\n"
    (package / "bpnp" / "factor.py").write_text(FACTOR.replace("2", "30"))
    assert doubled(package, cache)[0] == "120 150\n"
    with (package / "bpnp" / "compilation.py").open("a") as source:
        source.write("# compiles in another way\n")
    assert doubled(package, cache)[1].count("compiling") == 1


def test_without_any_folder_to_write_to_each_process_compiles(package: Path) -> None:
    for _ in range(2):
        printed, logged = doubled(package, "/dev/null/nowhere")
        assert printed == "8 10\n"
        assert logged.count("compiling") == 1


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


def test_blas_has_one_thread_until_the_last_of_several_users_ends() -> None:
    def of_blas() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(3, "blas"):
        one_blas_thread.__enter__()
        with one_blas_thread:
            assert of_blas() == {1}
        with pytest.raises(ValueError, match="bad"):
            one_blas_thread(int)("bad")
        assert of_blas() == {1}
        one_blas_thread.__exit__()
        assert of_blas() == {3}


SIGNATURES = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from bpnp import solve
for n in (10, 100):
    points = np.random.default_rng(0).normal(size=(n, 3))
    seen = points + (0, 0, 6)
    labels, image = np.arange(n) % 3, seen[:, :2] / seen[:, 2:]
    solve(image, points)
    solve(image.astype(np.float32), np.asfortranarray(points), labels2d=labels, labels3d=labels.astype(np.int32))
    solve(image, points, normals3d=-seen / np.linalg.norm(seen, axis=1, keepdims=True))
loops = {loop for name in list(sys.modules) if name.startswith("bpnp.") for loop in vars(sys.modules[name]).values()
         if isinstance(loop, Dispatcher) and not loop.targetoptions.get("no_cpython_wrapper")}
print(*sorted(f"{loop.py_func.__name__}:{len(loop.signatures)}" for loop in loops if loop.signatures))
"""


def test_whatever_the_arrays_of_a_pair_each_loop_is_compiled_once() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNATURES], capture_output=True, text=True, check=True)
    names, counts = zip(*(entry.split(":") for entry in done.stdout.split()), strict=True)
    assert {"descend", "descend_sparse", "sweep", "vary"} <= set(names)
    assert set(counts) == {"1"}
