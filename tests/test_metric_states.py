import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torchmetrics import MetricCollection

from bpnp.metrics import (
    MeanOverProblems,
    PoseErrors,
    PoseQuartiles,
    PoseRecall,
    RecallThresholds,
    pose_quartiles,
    pose_recalls,
)

pytestmark = pytest.mark.slow


def random_errors(seed: int, size: int, first_index: int = 0) -> PoseErrors:
    values = torch.from_numpy(np.random.default_rng(seed).gamma(1.0, 10.0, (4, size)))
    return PoseErrors(*values, index=torch.arange(first_index, first_index + size))


def select(errors: PoseErrors, rows: list[int]) -> PoseErrors:
    columns = (errors.rotation_deg, errors.translation, errors.centre, errors.reprojection_deg, errors.index)
    return PoseErrors(*(column[rows] for column in columns if column is not None))


def test_metrics_over_batches_are_the_functions_over_everything() -> None:
    errors = random_errors(0, 23)
    metrics = MetricCollection([PoseQuartiles(), PoseRecall(RecallThresholds(rotation_deg=(4, 8), joint=[(15, 5)]))])
    for rows in (range(0, 10), range(10, 20), range(20, 23)):
        metrics.update(select(errors, list(rows)))
    values = metrics.compute()
    thresholds = RecallThresholds(rotation_deg=(4, 8), joint=[(15, 5)])
    expected = pose_quartiles(errors) | pose_recalls(errors, thresholds)
    assert values.keys() == expected.keys()
    for key in values:
        torch.testing.assert_close(values[key], expected[key], rtol=0, atol=0)
    metrics.reset()
    metrics.update(select(errors, [3]))
    assert metrics.compute()["rotation_q1_deg"] == errors.rotation_deg[3]


def test_a_repeated_pair_is_counted_once_only_if_it_has_an_index() -> None:
    errors = random_errors(0, 5)
    metric = PoseQuartiles()
    for rows in ([0, 1, 2], [3, 4, 1], [4]):
        metric.update(select(errors, rows))
    expected = np.quantile(errors.rotation_deg.numpy(), 0.75)
    assert metric.compute()["rotation_q3_deg"].item() == pytest.approx(expected, rel=1e-14)
    metric.reset()
    for _ in range(3):
        metric.update(PoseErrors(*(torch.tensor([value], dtype=torch.float64) for value in (1, 2, 3, 4))))
    assert len(metric.errors().rotation_deg) == 3


def _process(rank: int, folder: Path, shards: list[list[list[list[int]]]]) -> None:
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    results = []
    for processes in shards:
        metrics = MetricCollection([PoseQuartiles(), PoseRecall()]).to(torch.device("cpu"))
        mean = MeanOverProblems()
        for rows in processes[rank]:
            metrics.update(select(random_errors(0, 7), rows))
            mean.update(torch.tensor(rows) ** 2.0, torch.tensor(rows))
        values = metrics.compute() | {"mean": mean.compute()}
        results.append({key: value.item() for key, value in values.items()})
    (folder / f"{rank}.json").write_text(json.dumps(results))
    torch.distributed.destroy_process_group()


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_two_processes_give_the_metrics_of_one(tmp_path: Path) -> None:
    shards = [
        [[[0, 2], [4, 6]], [[1, 3], [5, 0]]],  # the sampler repeats pair 0 so that 7 pairs make 2 x 4
        [[[0, 1], [2, 3, 4]], [[5, 6]]],  # uneven
        [[[0, 1, 2, 3, 4, 5, 6]], []],  # nothing for one process
    ]
    torch.multiprocessing.spawn(_process, (tmp_path, shards), nprocs=2)
    errors = random_errors(0, 7)
    expected = {key: value.item() for key, value in (pose_quartiles(errors) | pose_recalls(errors)).items()}
    expected["mean"] = (0 + 1 + 4 + 9 + 16 + 25 + 36) / 7
    for rank in range(2):
        assert json.loads((tmp_path / f"{rank}.json").read_text()) == [expected] * 3
