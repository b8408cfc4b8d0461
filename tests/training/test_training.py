"""Whole runs in processes of their own: killed and resumed, and split over two processes."""

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from small_data import MESHES, SMALL_NET

from bpnp.cli import main
from bpnp.report import read_results

pytestmark = pytest.mark.nightly

ARGUMENTS = [
    *MESHES,
    *SMALL_NET,
    "--model.learning_rate=1e-3",
    "--data.fresh_views=true",
    "--trainer.accelerator=cpu",
    "--trainer.log_every_n_steps=1",
]
WARMUP = ["--trainer.callbacks=bpnp.training.PoseLossWarmup", "--trainer.callbacks.start_epoch=2"]


def words(command: str, folder: Path, *arguments: str) -> list[str]:
    paths = [f"--trainer.default_root_dir={folder}", f"--data.cache_dir={folder.parent}/cache"]
    return [command, *ARGUMENTS, *paths, *arguments]


def start(command: str, folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """The command in a process of its own."""
    line = [sys.executable, "-m", "bpnp", *words(command, folder, *arguments)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.Popen(line, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen[bytes]) -> None:
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()[-2000:]
    assert "sync_dist" not in errors.decode()  # Lightning's warning of a metric that is not of all processes


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread, like the processes that the results are compared with."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def logged(folder: Path, metric: str, epoch: int) -> float:
    """The last value of a metric in an epoch over all the logs of a run."""
    values = []
    for path in sorted(folder.rglob("metrics.csv"), key=lambda p: p.stat().st_mtime):
        with path.open(newline="") as file:
            values += [row[metric] for row in csv.DictReader(file) if row["epoch"] == str(epoch) and row.get(metric)]
    return float(values[-1])


def test_a_killed_run_resumes_and_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    main(words("fit", whole, *WARMUP, "--trainer.max_epochs=4"))
    process = start("fit", killed, *WARMUP, "--trainer.max_epochs=4000")
    last = killed / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 200
    while not last.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert last.exists()
    main(words("fit", killed, *WARMUP, "--ckpt_path=last", "--trainer.max_epochs=4"))
    for metric in ("val/ransac/rotation_q2_deg", "val/pnp/rotation_q2_deg", "val/correspondence_loss"):
        assert logged(killed, metric, 3) == logged(whole, metric, 3), metric


def test_two_processes_give_the_figures_of_one(tmp_path: Path) -> None:
    # In float64: Adam turns the rounding of a gradient that should be zero into a whole step.
    double = "--trainer.precision=64-true"
    one, two = tmp_path / "1", tmp_path / "2"
    more = {one: ["--trainer.devices=1"], two: ["--trainer.devices=2", "--trainer.strategy=ddp"]}
    for folder in (one, two):
        fit = ["fit", folder, *more[folder], double, "--trainer.max_epochs=2"]
        test = ["test", folder, *more[folder], double, f"--ckpt_path={folder}/checkpoints/last.ckpt"]
        for arguments in (fit, test):
            main(words(*arguments)) if folder is one else finish(start(*arguments))
    for metric in ("train/loss", "train/correspondence_loss", "train/sinkhorn_iterations"):
        assert logged(two, metric, 1) == pytest.approx(logged(one, metric, 1), rel=1e-6), metric
    alone, split = read_results(one / "test"), read_results(two / "test")
    # Seven test pairs in batches of four: the second process repeats some, which count once.
    assert [row.id for row in split.rows] == [row.id for row in alone.rows]
    assert len(alone.rows) == 7 * 3
    assert split.correspondence_loss == pytest.approx(alone.correspondence_loss, abs=1e-8)
    for estimate, values in alone.estimates.items():
        for key in ("rotation_q2_deg", "translation_q2", "recall_rotation_20deg"):
            assert split.estimates[estimate][key] == pytest.approx(values[key], rel=1e-6), (estimate, key)
