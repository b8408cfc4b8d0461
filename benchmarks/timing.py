"""How the layers are timed: candidates take turns in one process."""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bpnp.cli import keep_freed_memory

LONGEST = 10.0  # seconds; a slower call is timed once, at its first
SHORTEST = 0.05  # seconds; a faster call is repeated within a round, so that the clock and its neighbours matter less


@dataclass(frozen=True)
class Spread:
    """Median and quartiles over the rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> "Spread":
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
        return cls(float(median), float(low), float(high))


@dataclass(frozen=True)
class Timing:
    """Milliseconds a call: by the clock, and of this process' processor time, which other programs hardly change."""

    wall: Spread
    cpu: Spread


@dataclass(frozen=True)
class Race:
    """Times of two candidates, and how many times longer the second took, round by round."""

    ours: Timing
    baseline: Timing
    ratio: Spread
    cpu_ratio: Spread


def race(ours: Callable[[], object], baseline: Callable[[], object], *, rounds: int) -> Race:
    """Time both in turns, `rounds` times after they have warmed up."""
    candidates = [ours, baseline]
    first = _measure(baseline, 1)
    if first[0] > 1000 * LONGEST:
        samples = [[_measure(ours, _repeats(ours)), first]]
    else:
        repeats = [_repeats(candidate) for candidate in candidates]
        samples = [[_measure(c, n) for c, n in zip(candidates, repeats, strict=True)] for _ in range(rounds)]
    (wall, cpu), (baseline_wall, baseline_cpu) = (
        ([pair[i][0] for pair in samples], [pair[i][1] for pair in samples]) for i in range(2)
    )
    return Race(
        Timing(Spread.of(wall), Spread.of(cpu)),
        Timing(Spread.of(baseline_wall), Spread.of(baseline_cpu)),
        Spread.of([b / a for a, b in zip(wall, baseline_wall, strict=True)]),
        Spread.of([b / a for a, b in zip(cpu, baseline_cpu, strict=True)]),
    )


def _repeats(candidate: Callable[[], object]) -> int:
    """Calls in a round, after one or, where that was quick, two to warm up."""
    milliseconds, _ = _measure(candidate, 1)
    if milliseconds < 1000:
        milliseconds, _ = _measure(candidate, 1)
    return max(1, round(1000 * SHORTEST / milliseconds))


def _measure(candidate: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Milliseconds a call by the clock and of processor time."""
    start, cpu_start = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        candidate()
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu_start
    return 1000 * wall / repeats, 1000 * cpu / repeats


def restart_with_settings() -> None:
    """Start the program again with the settings that are read before its first line, unless the environment has them.

    OMP_WAIT_POLICY=passive: by default waiting threads spin. Where another program wants one of the cores, a step of
    two threads then takes 30 times as long, and processor time says nothing.
    THP_MEM_ALLOC_ENABLE=1: torch asks for large pages. Freed memory is kept, as in `bpnp fit`.
    """
    settings = {"OMP_WAIT_POLICY": "passive", "THP_MEM_ALLOC_ENABLE": "1"}
    if not settings.keys() <= os.environ.keys():
        os.execve(sys.executable, sys.orig_argv, settings | dict(os.environ))
    keep_freed_memory()
