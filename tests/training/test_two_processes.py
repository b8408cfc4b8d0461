"""What processes that see different data have to agree on."""

import datetime
import os
import socket
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.strategies import DDPStrategy
from planted import plant
from small_data import small_net
from torch.utils.data import DataLoader

from bpnp.training.losses import correspondence_loss
from bpnp.training.task import BlindPnPTask


def _test(rank: int, folder: Path, port: int) -> None:
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "LOCAL_RANK": str(rank), "NODE_RANK": "0"}
    torch.manual_seed(0)
    batch = replace(plant(2, 12, seed=rank, dtype=torch.float32).batch(), index=torch.arange(2) + 2 * rank)
    batch = batch if rank == 0 else replace(batch, match3d=None)
    trainer = Trainer(
        accelerator="cpu",
        devices=2,
        strategy=DDPStrategy(timeout=datetime.timedelta(seconds=40)),
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        default_root_dir=folder,
    )
    task = BlindPnPTask(small_net(refine=False).eval())
    expected = correspondence_loss(task.solver.match(batch).assignment, batch.match3d).mean() if rank == 0 else None
    trainer.test(task, DataLoader([batch], batch_size=None), verbose=False)
    values = trainer.callback_metrics
    torch.save(
        (float(values["test/correspondence_loss"]), float(values["test/found"]), expected), folder / f"{rank}.pt"
    )


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_process_whose_pairs_have_no_matches_joins_the_mean_of_those_that_have(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(_test, (tmp_path, port), nprocs=2)
    (loss, found, expected), (same, too, _) = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert loss == same == pytest.approx(float(expected), rel=1e-5)
    assert found == too
