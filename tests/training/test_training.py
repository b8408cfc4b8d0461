"""Whole runs in processes of their own: killed and resumed, and split over two processes."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_data import SMALL_MESHES, SMALL_NET

from bpnp.report import read_results

ARGUMENTS = [
    "--data=bpnp.datamodules.MeshDataModule",
    *SMALL_MESHES,
    *SMALL_NET,
    "--model.learning_rate=1e-3",
    "--data.fresh_views=true",
    "--trainer.accelerator=cpu",
    "--trainer.log_every_n_steps=1",
]
WARMUP = ["--trainer.callbacks=bpnp.training.PoseLossWarmup", "--trainer.callbacks.start_epoch=2"]


def start(command: str, folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    paths = [f"--trainer.default_root_dir={folder}", f"--data.cache_dir={folder.parent}/cache"]
    return subprocess.Popen(
        [sys.executable, "-m", "bpnp", command, *ARGUMENTS, *paths, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def finish(process: subprocess.Popen[bytes]) -> None:
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()[-2000:]


def logged(folder: Path, metric: str, epoch: int) -> float:
    """The last value of a metric in an epoch over all the logs of a run."""
    values = []
    for path in sorted(folder.rglob("metrics.csv"), key=lambda p: p.stat().st_mtime):
        with path.open(newline="") as file:
            values += [row[metric] for row in csv.DictReader(file) if row["epoch"] == str(epoch) and row.get(metric)]
    return float(values[-1])


def test_a_killed_run_resumes_and_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    finish(start("fit", whole, *WARMUP, "--trainer.max_epochs=4"))
    process = start("fit", killed, *WARMUP, "--trainer.max_epochs=4000")
    last = killed / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 200
    while not last.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert last.exists()
    resume = ["--ckpt_path=last", "--trainer.max_epochs=4"]
    done = start("fit", killed, *WARMUP, *resume)
    _, errors = done.communicate(timeout=300)
    if done.returncode:
        pytest.fail(errors.decode()[-2000:])
    for metric in ("val/rotation_q2_deg", "val/pnp/rotation_q2_deg", "val/correspondence_loss"):
        assert logged(killed, metric, 3) == logged(whole, metric, 3), metric


def test_two_processes_give_the_figures_of_one(tmp_path: Path) -> None:
    # In float64: Adam turns the rounding of a gradient that should be zero into a whole step.
    double = "--trainer.precision=64-true"
    results = {}
    for devices in (1, 2):
        folder = tmp_path / str(devices)
        strategy = [f"--trainer.devices={devices}", "--trainer.strategy=" + ("ddp" if devices == 2 else "auto")]
        finish(start("fit", folder, *strategy, double, "--trainer.max_epochs=2"))
        finish(start("test", folder, *strategy, double, f"--ckpt_path={folder}/checkpoints/last.ckpt"))
        results[devices] = read_results(folder / "test")
    one, two = results[1], results[2]
    # Seven test pairs in batches of four: the second process repeats some, which count once.
    assert [row.id for row in two.rows] == [row.id for row in one.rows]
    assert len(one.rows) == 7 * 3
    assert two.correspondence_loss == pytest.approx(one.correspondence_loss, abs=1e-8)
    for estimate, values in one.estimates.items():
        for key in ("rotation_q2_deg", "translation_q2", "recall_rotation_20deg"):
            assert two.estimates[estimate][key] == pytest.approx(values[key], rel=1e-6), (estimate, key)
