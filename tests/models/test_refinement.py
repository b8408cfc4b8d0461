import math
from dataclasses import replace

import pytest
import torch
from planted import Planted, plant, posed
from small_data import small_net
from torch import Tensor, nn

from bpnp import Batch, Pose, SolveStats
from bpnp.geometry import is_finite
from bpnp.models import Refinement, evaluation
from bpnp.models.evaluation import ALONE, TRUST, WIDTH, log_support, refinement_enabled
from bpnp.types import Prediction


def support(
    plan: Tensor, planted: Planted, rotation: Tensor, translation: Tensor, batch: Batch | None = None
) -> Tensor:
    return log_support(Prediction(plan), batch or planted.batch(), posed(rotation, translation))


def test_is_the_sum_over_bearings_written_out() -> None:
    planted = plant(1, 6, outliers2d=2, outliers3d=1)
    plan = planted.diffuse(0.05)
    found = support(plan, planted, *planted.pose)
    rays = planted.bearings[0]
    area = float(((rays - rays.mean(0)) ** 2).sum(1).mean()) * 2 * math.pi
    total = 0.0
    for i, ray in enumerate(rays):
        inner = 0.0
        for j, p in enumerate(planted.points3d[0]):
            seen = planted.rotation[0] @ p + planted.translation[0]
            chord = float((seen / seen.norm() - ray).norm())
            given = TRUST * float(plan[0, i, j] / plan[0, i].sum()) + (1 - TRUST) / len(planted.points3d[0])
            inner += given * area * math.exp(-(chord**2) / 2 / WIDTH**2) / (2 * math.pi * WIDTH**2)
        total += math.log(ALONE + (1 - ALONE) * inner)
    assert float(found[0]) == pytest.approx(total, rel=1e-7)


def test_speaks_for_the_true_pose_and_against_a_wrong_one_whatever_the_padding() -> None:
    planted = plant(3, 40, outliers2d=20, outliers3d=20)
    plan, batch = planted.diffuse(0.03), planted.batch()
    right = support(plan, planted, *planted.pose)
    wrong = support(plan, planted, *planted.near(2.0))
    assert (right > 0).all()
    assert (wrong < 0).all()
    pad = nn.functional.pad
    wide = replace(
        batch,
        points2d=pad(batch.points2d, (0, 0, 0, 3)),
        points3d=pad(batch.points3d, (0, 0, 0, 5)),
        mask2d=pad(batch.mask2d, (0, 3)),
        mask3d=pad(batch.mask3d, (0, 5)),
        match3d=None,
    )
    torch.testing.assert_close(support(pad(plan, (0, 5, 0, 3)), planted, *planted.pose, wide), right)


def test_there_is_none_without_a_pose() -> None:
    planted = plant(2, 8)
    rotation = planted.rotation.clone()
    rotation[1] = torch.nan
    found = support(planted.permutation(), planted, rotation, planted.translation)
    assert found[0] > 0
    assert found[1] == -math.inf


def test_a_pose_that_the_assignment_contradicts_gives_way_to_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Annealing is made to end at a wrong pose wherever it starts from proposals; the sure sample keeps its pose."""
    planted = plant(2, 40, noise=1e-4)
    refinement, batch = Refinement(), planted.batch()
    wrong, calls = planted.near(2.5), []

    def annealed(_: Batch, rotation: Tensor, translation: Tensor) -> Pose:
        calls.append(rotation.shape[1])
        crowd = rotation.shape[1] > 2
        ends = (torch.stack([planted.rotation[0], wrong[0][1]]), torch.stack([planted.translation[0], wrong[1][1]]))
        turned, shifted = ends if crowd else planted.pose
        missing = ~is_finite(rotation, translation).any(1)
        turned = turned.masked_fill(missing[:, None, None], torch.nan)
        shifted = shifted.masked_fill(missing[:, None], torch.nan)
        return Pose(turned, shifted, SolveStats(torch.full((2,), len(calls)), torch.zeros(2), ~missing))

    monkeypatch.setattr(evaluation, "refine", annealed)
    own = posed(*planted.near(0.02))
    refined = refinement(Prediction(planted.permutation(), poses={"ransac": own, "pnp": own}), batch).poses["refined"]
    assert calls[0] > 2
    assert calls[1] == 2
    torch.testing.assert_close(refined.rotation, planted.rotation)
    torch.testing.assert_close(refined.translation, planted.translation)
    assert refined.stats.iterations.tolist() == [1, 2]
    assert refined.stats.converged.all()


def test_refinement_is_off_within_a_block_and_as_it_was_after_an_error() -> None:
    outer = nn.ModuleList([small_net(), small_net(refine=False)])

    def fail() -> None:
        with refinement_enabled(outer, False):
            assert [net.estimates for net in outer] == [("ransac", "pnp")] * 2
            raise RuntimeError("inside")

    with pytest.raises(RuntimeError, match="inside"):
        fail()
    assert [net.refinement.enabled for net in outer] == [True, False]
    with refinement_enabled(outer, True):
        assert [net.refinement.enabled for net in outer] == [True, False]
