"""Shares of a loop over threads: every index once, errors passed on, and a fork that is not stuck."""

import multiprocessing
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from bpnp.compilation import in_threads


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
