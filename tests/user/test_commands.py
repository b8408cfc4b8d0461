"""Commands in another folder, without a terminal: each is one process with the threads that it takes by default."""

import csv
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from user_world import BPNP, plain_environment, run_in

from bpnp.examples import load

DEBUG = ("--config", "quickstart", "--config", "presets/debug")
ESTIMATES = ("ransac", "pnp", "refined")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which the quickstart was trained for a few steps."""
    folder = tmp_path_factory.mktemp("another folder")
    run_in(folder, *BPNP, "fit", *DEBUG)
    return folder


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_a_trained_network_is_used_from_the_command_line(command: str, trained: Path) -> None:
    """Before, each ended in a traceback with two cores: RANSAC's threads wrote into an inference tensor."""
    shown = run_in(trained, *BPNP, command, *DEBUG, "--ckpt_path", "last")
    if command == "test":
        assert all(name in shown for name in ESTIMATES)
        with (trained / "runs/debug/test/problems.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["estimate"] for row in rows} == set(ESTIMATES)
        assert all(np.isfinite(float(row["rotation_error_deg"])) for row in rows)


PYTHON = """
from lightning import Trainer
from bpnp import BPnPNet
from bpnp.datamodules import MeshDataModule
from bpnp.layers import RansacPnP
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.training import BlindPnPTask, PoseLossWarmup

def main():
    sizes = {"channels": 16, "depth": 2}
    net = BPnPNet(ImageFeatures(**sizes), SceneFeatures(**sizes), ransac=RansacPnP(backend="BACKEND"))
    task = BlindPnPTask(net)
    data = MeshDataModule(num_points=24, pool_size=64, train_shapes=8, val_shapes=4, test_shapes=4, train_problems=16,
                          batch_size=4, cache_dir="store", num_workers=WORKERS)
    quiet = {"enable_progress_bar": False, "enable_model_summary": False}
    trainer = Trainer(max_epochs=2, callbacks=[PoseLossWarmup(1)], log_every_n_steps=1, **quiet)
    trainer.fit(task, data)
    trainer.validate(task, data)
    trainer.test(task, data)
    assert len(trainer.predict(task, data)) == 1

if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize(("backend", "workers"), [("opencv", 0), ("poselib", 1)])
def test_a_script_of_the_user_trains_tests_and_predicts(backend: str, workers: int, tmp_path: Path) -> None:
    """Before, `trainer.validate` failed, as on the command line."""
    (tmp_path / "mine.py").write_text(PYTHON.replace("BACKEND", backend).replace("WORKERS", str(workers)))
    run_in(tmp_path, sys.executable, "mine.py")


def check_solve(folder: Path, environment: dict[str, str] | None = None) -> None:
    """`bpnp solve` finds the planted rotation of points in files, and writes it."""
    leds = load("leds")
    for name in ("points2d", "points3d", "camera"):
        np.savetxt(folder / f"{name}.csv", getattr(leds, name), delimiter=",")
    options = ("--camera", "camera.csv", "--output", "pose.json")
    run_in(folder, *BPNP, "solve", "points2d.csv", "points3d.csv", *options, environment=environment)
    rotation = np.array(json.loads((folder / "pose.json").read_text())["rotation"])
    assert leds.rotation_error_deg(rotation) < 3


def test_points_of_files_are_solved_in_another_folder(tmp_path: Path) -> None:
    """Would have caught a command that needs the folder of the repository, a terminal or a pinned thread."""
    check_solve(tmp_path)
    run_in(tmp_path, *BPNP, "verify", "points2d.csv", "points3d.csv", "pose.json", "--camera", "camera.csv")


def test_a_closed_output_and_a_deleted_folder_are_no_traceback(tmp_path: Path) -> None:
    """Before, a closed output was; the deleted folder was "No such file", without its name."""
    shell = f"{shlex.join(BPNP)} --version >&-"
    closed = subprocess.run(["sh", "-c", shell], cwd=tmp_path, stderr=subprocess.PIPE, text=True, check=False)
    assert (closed.returncode, closed.stderr) == (0, "")
    shell = f"mkdir gone && cd gone && rmdir ../gone && {shlex.join(BPNP)} --version"
    deleted = subprocess.run(["sh", "-c", shell], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (deleted.returncode, deleted.stdout) == (2, "")
    assert deleted.stderr == "bpnp: error: the working folder was deleted; change to a folder that exists\n"


def bare_environment(**variables: str) -> dict[str, str]:
    """Return what `env -i` leaves, with the path of programs."""
    return {"PATH": plain_environment()["PATH"], **variables}


@pytest.mark.nightly
def test_an_empty_environment_and_a_cold_cache_are_enough(tmp_path: Path) -> None:
    """Would have caught loops that only load from a cache, and variables that the tests set."""
    environment = bare_environment(HOME=str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    run_in(tmp_path, *BPNP, "fit", *DEBUG, environment=environment)
    shown = run_in(tmp_path, *BPNP, "test", *DEBUG, "--ckpt_path", "last", environment=environment)
    assert all(name in shown for name in ESTIMATES)
    check_solve(tmp_path, environment)
    assert list((tmp_path / "home").rglob("*.nbc"))


@pytest.mark.nightly
@pytest.mark.parametrize("home", [None, "/proc/nowhere"])
def test_a_home_is_not_needed(home: str | None, tmp_path: Path) -> None:
    """Would have caught the endless loop that waited for a cache folder which cannot be made."""
    check_solve(tmp_path, bare_environment(**({} if home is None else {"HOME": home})))
