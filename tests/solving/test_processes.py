"""Many pairs in several processes: the same solutions, nothing lost, no process left."""

import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch

import bpnp
from bpnp.examples import load
from bpnp.loops.parallel import in_processes
from bpnp.solving import sources

pytestmark = pytest.mark.slow

EXAMPLES = [load("photo", seed=seed) for seed in range(6)]
SETS = [e.points2d for e in EXAMPLES], [e.points3d for e in EXAMPLES], [e.camera for e in EXAMPLES]


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two threads, and processes however little there is to do."""
    monkeypatch.setattr(sources, "WORTH_FORKING", 0.0)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def alike(one: bpnp.Solution, other: bpnp.Solution) -> bool:
    same = np.array_equal(one.rotation, other.rotation) and np.array_equal(one.translation, other.translation)
    return same and np.array_equal(one.matches, other.matches) and one.reason == other.reason


def test_solutions_are_those_of_single_calls_whatever_the_number_of_threads(threads: None) -> None:
    shared = bpnp.solve_many(*SETS, time_limit=math.inf)
    torch.set_num_threads(1)
    single = [bpnp.solve(*pair, time_limit=math.inf) for pair in zip(*SETS, strict=True)]
    assert all(map(alike, shared, single))
    for example, solution in zip(EXAMPLES, shared, strict=True):
        assert example.rotation_error_deg(solution.rotation) < 0.5


def test_an_error_in_a_worker_is_raised_and_ends_the_others() -> None:
    def work(item: int) -> int:
        if item == 3:
            raise ValueError("item 3")
        time.sleep(0.01)
        return item

    with pytest.raises(ValueError, match="item 3"):
        list(in_processes(work, range(1000), 2))
    assert multiprocessing.active_children() == []


def test_a_worker_that_is_killed_is_an_error_and_no_hang() -> None:
    def work(item: int) -> int:
        if item == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return item

    with pytest.raises(RuntimeError, match="was killed, possibly out of memory"):
        list(in_processes(work, range(1000), 2))
    assert multiprocessing.active_children() == []


def test_an_iteration_that_is_left_leaves_no_process() -> None:
    some = in_processes(lambda item: item, range(1000), 2)
    next(some)
    some.close()  # type: ignore[attr-defined]
    assert multiprocessing.active_children() == []


def test_a_child_of_another_thread_goes_on() -> None:
    """It is started while the iteration runs, so it is not among the children at the beginning."""
    some = in_processes(lambda item: item, range(1000), 2)
    next(some)
    child = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    thread = threading.Thread(target=child.start)
    thread.start()
    thread.join()
    some.close()  # type: ignore[attr-defined]
    try:
        assert multiprocessing.active_children() == [child]
        assert child.is_alive()
    finally:
        child.kill()
        child.join()
