"""Loops shared among threads: every index once, none stuck; and numpy's products on one thread meanwhile."""

import multiprocessing
import os
import sys
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from bpnp.runtime import in_threads, one_blas_thread, thread_count


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_threads_are_those_of_torch_else_of_the_environment_else_the_cpus(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert thread_count() == threads
    monkeypatch.delitem(sys.modules, "torch")
    for value, count in (("3", 3), ("4,2", 4)):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        assert thread_count() == count
    for value in ("0", "many", ""):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        assert thread_count() == len(os.sched_getaffinity(0))


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_every_index_is_visited_once_and_no_part_is_empty(threads: int, count: int) -> None:
    seen, shares = np.zeros(count, int), list[int]()

    def work(first: int, last: int) -> None:
        seen[first:last] += 1
        shares.append(last - first)

    in_threads(work, count)
    assert (seen == 1).all()
    assert len(shares) == max(min(threads, count), 1)
    assert count == 0 or min(shares) >= 1


def test_an_error_in_any_part_is_raised(threads: int) -> None:
    def fail(_first: int, last: int) -> None:
        if last == 10:
            raise ArithmeticError("last share")

    with pytest.raises(ArithmeticError, match="last share"):
        in_threads(fail, 10)


def test_a_tensor_in_the_work_is_refused_with_any_number_of_threads(threads: int) -> None:
    """A worker thread has no inference mode, so that it could not fill the tensor of a caller that has."""
    result = torch.zeros(10)

    def fill(first: int, last: int) -> None:
        result[first:last] = 1

    def one_of_several(first: int, last: int, parts: tuple[object, ...] = ()) -> None:
        fill(first, last)

    for work in (fill, one_of_several, lambda i, j: fill(i, j)):
        with pytest.raises(TypeError, match="'result'"):
            in_threads(work, 10)
    assert not result.any()


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
