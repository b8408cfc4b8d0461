"""What a GPU that is at hand for minutes is for: its tests, seconds of a step, and the trainings of Tables 1 and 2.

    python -m benchmarks gpu --pack DATA     # on any machine, once: clouds and photos for the folder of the run
    python -m benchmarks gpu --minutes 8     # on the GPU; a second run goes on where the first one ended
    python -m benchmarks gpu --minutes 2     # without a GPU: the same on the CPU

A run has the tests of CUDA, the seconds of a step of configs/paper/modelnet40.yaml before and after the switch and of a
test problem, each once for each processor, and then trains as long as the minutes last: Table 1's network from the
packaged paper-lclp on with the pose loss, and Table 2's on drawn maps. In the end both are tested. `state.json` in the
folder of the run has the figures and a line for each run; the folder is all that the next run needs (less than 64 MiB:
two checkpoints of 16 MB, clouds as float16, and photos). Without `--pack` shapes and maps are drawn. Problems have
1,000 points, without a GPU 128.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import LightningDataModule
from paper_tables import NEVER, figures, network, trained_steps, workers
from paper_weights import SETTINGS
from record import ROOT, measured_today, processor, spread, write_json

from bpnp.datamodules import ColmapDataModule, MeshDataModule, SyntheticMapDataModule
from bpnp.datamodules.clouds import SPLITS, read_cloud
from bpnp.datamodules.colmap.module import colmap_recipe
from bpnp.datamodules.store import prepare
from bpnp.files import write_atomically
from bpnp.poses import MIN_POINTS
from bpnp.report.results import ProblemRow, rows_from
from bpnp.training.comparison import problem_order
from bpnp.types import Batch

CLOUDS, PHOTOS = "modelnet10", "photos"  # in the folder `data` of the run
MOST_CLOUDS = 300  # of a class and a split, so that the folder of the run has less than 64 MiB
EPOCH = 50  # steps between two epochs
TIMED, TESTED = 0.08, 0.12  # fractions of the minutes for a timing, and for the tests of a network
FEWEST_SECONDS = 10.0  # that a stage needs
POINTS = 1000 if torch.cuda.is_available() else 128  # of a problem
MAPS = (
    "--config=paper/megadepth", "--model.solver.features3d.normalise=true",
    "--data=bpnp.datamodules.SyntheticMapDataModule", "--data.outliers=0.0", "--data.frame=y_down", "--data.tilt_deg=8",
    "--data.heading_deg=40", "--data.val_problems=16", "--model.learning_rate=3e-4",
    f"--pose_loss.start_epoch={NEVER}",
)  # fmt: skip
SHAPES = (
    *SETTINGS, "--model.weights=paper-lclp", "--data.batch_size=8",
    "--model.learning_rate=2e-4", "--pose_loss.start_epoch=0", "--pose_loss.weight=4",
)  # fmt: skip
DRAWN = ("--data.train_shapes=1000", "--data.procedural_kind=aligned")


@dataclass(frozen=True)
class Run:
    """The folder of a run, and when it ends."""

    folder: Path
    end: float  # time.monotonic()
    minutes: float

    @property
    def file(self) -> Path:
        return self.folder / "state.json"

    def left(self) -> float:
        """Return the seconds that are left."""
        return self.end - time.monotonic()

    def state(self) -> dict[str, Any]:
        """Return what the runs in this folder have found."""
        empty: dict[str, Any] = {"runs": [], "tests": {}, "seconds": {}, "trainings": {}}
        return json.loads(self.file.read_text(encoding="utf-8")) if self.file.is_file() else empty

    def record(self, part: str, name: str, value: Any) -> None:
        """Write a finding at once: a run that is killed keeps what it has found."""
        state = self.state()
        state[part][name] = value
        write_json(self.file, state)
        print(f"{part} {name}: {value}", flush=True)


def device() -> str:
    """Return the name of the GPU, or of the processor without one."""
    return torch.cuda.get_device_name() if torch.cuda.is_available() else processor()


def run_tests(run: Run) -> str:
    """Run the tests of CUDA and return pytest's last line."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(ROOT / "tests" / "test_cuda.py")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=run.left() / 2, cwd=ROOT, check=False)
    except subprocess.TimeoutExpired:
        return "not finished within half of the time"
    return (done.stdout.strip() or done.stderr.strip()).splitlines()[-1]


def fit(arguments: tuple[str, ...], folder: Path, seconds: float, *, save: bool) -> dict[str, Any]:
    """Train for some seconds, from the last checkpoint on if there is one; return the steps and their seconds."""
    file = folder / "clock.json"
    file.unlink(missing_ok=True)
    resumed = ["--ckpt_path", "last"] if save and trained_steps(folder / "checkpoints" / "last.ckpt") else []
    clock = [
        "--trainer.callbacks+=clock.Clock", f"--trainer.callbacks.seconds={seconds}",
        f"--trainer.callbacks.file={file}", f"--trainer.callbacks.save={str(save).lower()}",
    ]  # fmt: skip
    precision = [] if torch.cuda.is_available() else ["--trainer.precision=32-true"]
    command = [
        sys.executable, "-m", "bpnp", "fit", *arguments, *precision, *clock, "--trainer.limit_val_batches=0",
        f"--trainer.limit_train_batches={EPOCH}", "--trainer.max_epochs=-1", "--trainer.enable_progress_bar=false",
        f"--trainer.default_root_dir={folder}", f"--data.num_workers={workers()}", f"--data.num_points={POINTS}",
        "--seed_everything=0", *resumed,
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    if not file.is_file():
        sys.exit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return dict(json.loads(file.read_text(encoding="utf-8")))


def time_steps(run: Run) -> None:
    """Time the paper's steps, without a checkpoint, and its inference."""
    seconds = run.state()["seconds"]
    few = ("--data.root=null", "--data.train_shapes=32", "--data.val_shapes=2", "--trainer.enable_checkpointing=false")
    for name, epoch in (("before the switch", NEVER), ("after the switch", 0)):
        key = f"{device()} | a step of {POINTS} points {name}"
        if key not in seconds and run.left() > FEWEST_SECONDS:
            folder = run.folder / "timing"
            arguments = ("--config=paper/modelnet40", *few, f"--pose_loss.start_epoch={epoch}")
            found = fit(arguments, folder, 60 * run.minutes * TIMED, save=False)
            shutil.rmtree(folder)
            run.record("seconds", key, found | measured_today())
    key = f"{device()} | a test problem of {POINTS} points"
    if key not in seconds and run.left() > FEWEST_SECONDS:
        batches = [batch for _, batch in zip(range(8), test_problems(MeshDataModule(None, **SMALL)), strict=False)]
        net = network("paper-lclp").to("cuda" if torch.cuda.is_available() else "cpu")
        times = []
        for batch in (batches[0], *batches):
            start = time.perf_counter()
            solve(net, batch)
            times.append(time.perf_counter() - start)
        found = {"problems": len(times) - 1, "seconds": float(np.mean(times[1:])), "paper, Titan V": 0.1}
        run.record("seconds", key, found | measured_today())


SMALL: dict[str, Any] = {"num_points": POINTS, "pool_size": 1000, "train_shapes": 4, "val_shapes": 2, "test_shapes": 40}


def solve(net: torch.nn.Module, batch: Batch) -> list[ProblemRow]:
    """Solve one problem on the device of the network, and return the errors of each estimate."""
    where = next(net.parameters()).device
    start = time.perf_counter()
    with torch.no_grad():
        prediction = net(batch.to(where)).to("cpu")
    return rows_from(prediction, batch, time.perf_counter() - start)


def test_problems(data: LightningDataModule) -> Iterator[Batch]:
    """Yield the test problems of a data module, each by itself, in a fixed random order."""
    data.setup("test")
    problems = data.datasets["test"]  # type: ignore[attr-defined]
    yield from (problems.problem(i) for i in problem_order(len(problems)))


def trainings(run: Run) -> dict[str, tuple[tuple[str, ...], LightningDataModule, tuple[float, float]]]:
    """Return arguments, tests and limits of the recall of each training."""
    clouds, photos = run.folder / "data" / CLOUDS, run.folder / "data" / PHOTOS
    drawn = MeshDataModule(None, **SMALL)
    shapes = (f"--data.root={clouds}",) if clouds.is_dir() else DRAWN
    shape_tests = MeshDataModule(str(clouds), num_points=POINTS, pool_size=1000) if clouds.is_dir() else drawn
    maps = SyntheticMapDataModule(num_points=POINTS, outliers=0.0, frame="y_down", tilt_deg=8, heading_deg=40)
    photo_tests = ColmapDataModule(str(photos), test_fraction=1.0, val_fraction=0.0, eval_max_points=POINTS)
    return {
        "table1": ((*SHAPES, *shapes), shape_tests, (15.0, 0.5)),
        "table2": (MAPS, photo_tests if photos.is_dir() else maps, (10.0, 1.0)),
    }


def train(run: Run) -> None:
    """Train both networks, the one with fewer seconds so far first, and test them."""
    chosen = trainings(run)
    spent = {name: run.state()["trainings"].get(name, {}).get("trained_seconds", 0.0) for name in chosen}
    order = sorted(chosen, key=lambda name: spent[name])
    for place, name in enumerate(order):
        later = len(order) - place
        seconds = run.left() / later - 60 * run.minutes * TESTED
        if seconds < FEWEST_SECONDS:
            continue
        arguments, tests, recall = chosen[name]
        folder, start = run.folder / name, time.monotonic()
        # A third is for starting and for drawing shapes.
        found = fit(arguments, folder, seconds * 2 / 3, save=True)
        compact(folder)
        spent[name] += time.monotonic() - start
        checkpoint = folder / "checkpoints" / "last.ckpt"
        measured = test(run, checkpoint, tests, recall, run.left() / later)
        figure = found | {"all_steps": trained_steps(checkpoint), "trained_seconds": round(spent[name], 1)}
        run.record("trainings", name, figure | measured | measured_today())


def test(
    run: Run, checkpoint: Path, data: LightningDataModule, recall: tuple[float, float], seconds: float
) -> dict[str, Any]:
    """Test a checkpoint on as many problems as the seconds allow, with the paper's inference."""
    end = time.monotonic() + min(seconds, 60 * run.minutes * TESTED)
    net = network(checkpoint).to("cuda" if torch.cuda.is_available() else "cpu")
    rows: list[ProblemRow] = []
    for batch in test_problems(data):
        rows += solve(net, batch)
        if time.monotonic() > end:
            break
    return {name: figures([row for row in rows if row.estimate == name], recall) for name in ("ransac", "pnp")}


def compact(folder: Path) -> None:
    """Keep only the last checkpoint of a training, with the moments of Adam in bfloat16: 16 instead of 24 MB.

    torch restores them in the type of the parameters.
    """
    last = folder / "checkpoints" / "last.ckpt"
    content = torch.load(last, map_location="cpu", weights_only=True)
    for optimizer in content["optimizer_states"]:
        for moments in optimizer["state"].values():
            moments.update({key: moments[key].bfloat16() for key in ("exp_avg", "exp_avg_sq") if key in moments})
    with write_atomically(last) as temporary:
        torch.save(content, temporary)
    for path in folder.iterdir():
        if path.name != "checkpoints":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for file in (folder / "checkpoints").glob("*.ckpt"):
        if file != last:
            file.unlink()


def pack(data: Path, folder: Path) -> None:
    """Write ModelNet10's clouds as float16 and the photos of the COLMAP models into the folder of the run."""
    folders = sorted(path for split in SPLITS for path in (data / CLOUDS).glob(f"*/{split}"))
    clouds = [file for path in folders for file in spread(sorted(path.glob("*.ply")), MOST_CLOUDS)]
    for file in clouds:
        out = folder / CLOUDS / file.relative_to(data / CLOUDS).with_suffix(".npy")
        out.parent.mkdir(parents=True, exist_ok=True)
        points = read_cloud(file)
        # In units of the shape: float16 has three digits.
        radius = np.abs(points - points.mean(0)).max() or 1.0
        np.save(out, ((points - points.mean(0)) / radius).astype(np.float16))
    photos = prepare(colmap_recipe(data / "colmap", min_points=MIN_POINTS, clutter=0.0), folder / PHOTOS)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    print(f"{folder}: {len(clouds)} clouds, {len(photos)} photos, {size / 2**20:.0f} MiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=8.0, help="of this run (default: %(default)s)")
    parser.add_argument("--run", type=Path, default=ROOT / "runs" / "gpu", help="(default: %(default)s)")
    parser.add_argument("--pack", type=Path, metavar="DATA", help="write the files for the run, and do nothing else")
    chosen = parser.parse_args()
    folder = chosen.run.resolve()
    if chosen.pack:
        pack(chosen.pack, folder / "data")
        return
    run = Run(folder, time.monotonic() + 60 * chosen.minutes, chosen.minutes)
    folder.mkdir(parents=True, exist_ok=True)
    line: dict[str, Any] = {"minutes": chosen.minutes, "device": device()} | measured_today()
    if device() not in run.state()["tests"]:
        run.record("tests", device(), run_tests(run))
    time_steps(run)
    train(run)
    state = run.state()
    state["runs"].append(line | {"seconds": round(60 * chosen.minutes - run.left())})
    write_json(run.file, state)
    print(json.dumps(state["runs"][-1]))
