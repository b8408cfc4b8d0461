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

import bpnp.compilation
from bpnp.compilation import in_threads

LOOP = """
from bpnp.compilation import compiler


@compiler()
def double(x):
    return 2 * x
"""


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_every_index_is_visited_once(threads: int, count: int) -> None:
    seen = np.zeros(count, int)
    in_threads(lambda first, last: np.add.at(seen, np.arange(first, last), 1), count)
    assert (seen == 1).all()


def test_no_thread_has_an_empty_share(threads: int) -> None:
    shares: list[int] = []
    in_threads(lambda first, last: shares.append(last - first), 2)
    assert sum(shares) == 2
    assert min(shares) >= 1
    assert len(shares) == min(threads, 2)


def test_shares_run_at_the_same_time() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    together = threading.Barrier(3, timeout=20)
    try:
        in_threads(lambda _first, _last: together.wait(), 3)
    finally:
        torch.set_num_threads(before)


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
def test_a_fork_has_threads_of_its_own() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    in_threads(lambda _first, _last: None, 10)
    torch.set_num_threads(before)
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
    (folder / "loop.py").write_text(LOOP)
    (folder / "__pycache__").touch()  # a file where the folder would be
    return folder.parent


def doubled(package: Path, cache: str) -> tuple[str, str]:
    """What a process prints and logs that calls the loop."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    environment |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": cache, "HOME": cache}
    ask = [sys.executable, "-c", "from bpnp.loop import double; print(double(4), double(5))"]
    ended = subprocess.run(ask, env=environment, cwd=package, capture_output=True, text=True, check=True)
    return ended.stdout, ended.stderr


def test_a_package_that_cannot_be_written_to_compiles_once_into_the_users_cache(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first, second = doubled(package, str(cache)), doubled(package, str(cache))
    assert first[0] == second[0] == "8 10\n"
    assert first[1].count("compiling") == 1
    assert second[1] == ""
    assert list(cache.rglob("*.nbi"))


def test_without_any_folder_to_write_to_each_process_compiles(package: Path) -> None:
    for _ in range(2):
        printed, logged = doubled(package, "/dev/null/nowhere")
        assert printed == "8 10\n"
        assert logged.count("compiling") == 1


def test_processes_that_compile_at_once_do_not_break_each_other(package: Path, tmp_path: Path) -> None:
    """All find the loop's value, and what they leave in the cache is whole: the next one compiles nothing."""
    cache = str(tmp_path / "cache")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    environment |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": cache, "HOME": cache}
    gate = tmp_path / "gate"
    gate.mkdir()
    ask = (
        f"import os, time\nfrom bpnp.loop import double\nopen(f'{gate}/{{os.getpid()}}', 'w').close()\n"
        f"while len(os.listdir('{gate}')) < 3: time.sleep(0.001)\n"
    )
    together = [
        subprocess.Popen(
            [sys.executable, "-c", ask + "print(double(4), double(5))"], env=environment, cwd=package,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(3)
    ]  # fmt: skip
    for process in together:
        printed, logged = process.communicate(timeout=120)
        assert process.returncode == 0, logged
        assert printed == "8 10\n"
    assert doubled(package, cache) == ("8 10\n", "")
