"""`solve` with a user's modules, and in several threads."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from planted import plant, posed

from bpnp import solve
from bpnp.types import Prediction


class Recorder(torch.nn.Module):
    """Notes in which mode its parts run."""

    modes: set[bool]

    def __init__(self, *, fails: bool = False) -> None:
        super().__init__()
        self.part, self.frozen = torch.nn.Linear(1, 1), torch.nn.BatchNorm1d(1).eval()
        self.fails = fails

    def forward(self, batch) -> Prediction:
        seen.update({self.training, self.part.training, self.frozen.training, torch.is_grad_enabled()})
        if self.fails:
            raise RuntimeError("on purpose")
        rotation, translation = torch.eye(3).expand(len(batch), 3, 3), torch.tensor([[0.0, 0.0, 5.0]])
        return Prediction(poses={"fixed": posed(rotation, translation.expand(len(batch), 3))})


seen: set[bool] = set()


@pytest.mark.parametrize("fails", [False, True])
def test_a_module_keeps_the_mode_of_each_of_its_parts(fails: bool) -> None:
    planted, module = plant(1, 30), Recorder(fails=fails)
    before = {name: part.training for name, part in module.named_modules()}
    assert set(before.values()) == {True, False}
    seen.clear()
    if fails:
        with pytest.raises(RuntimeError, match="on purpose"):
            solve(planted.points2d[0], planted.points3d[0], solver=module)
    else:
        solve(planted.points2d[0], planted.points3d[0], solver=module)
    assert seen == {False}
    assert {name: part.training for name, part in module.named_modules()} == before


@pytest.mark.slow
def test_several_threads_find_what_one_does() -> None:
    problems = [plant(1, 120, seed=seed, noise=0.001, outliers2d=30, outliers3d=30) for seed in range(4)]

    def solved(i: int) -> str:
        solution = solve(problems[i].points2d[0], problems[i].points3d[0], time_limit=math.inf)
        return replace(solution, seconds=0.0).to_json()

    alone = [solved(i) for i in range(4)]
    together = threading.Barrier(4, timeout=60)

    def at_once(i: int) -> str:
        together.wait()
        return solved(i)

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(at_once, range(4))) == alone
