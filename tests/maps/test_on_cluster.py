"""Photos on a cluster of two processes have the solutions of one process, also if a worker is killed in between."""

import os
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster, Worker
from PIL import Image
from planted_model import HEIGHT, PINHOLE, WIDTH, plant_keypoints, plant_model

from bpnp import SceneMap, Solution
from bpnp.cli import main
from bpnp.maps.many_photos import PhotoTask, attempts, photo_task
from bpnp.maps.on_cluster import attempts_on_cluster
from bpnp.maps.photos import photo_files

pytestmark = pytest.mark.nightly

PHOTOS = 6
VIEWS = {f"new{k}.png": [f"photo {k % 3}.jpg"] for k in range(PHOTOS)}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A map, photos without content, and the database with their keypoints; photo k was taken near view k modulo 3."""
    folder = tmp_path_factory.mktemp("place")
    truth = plant_model(folder / "map", camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    (folder / "photos").mkdir()
    for k in range(PHOTOS):
        Image.new("L", (WIDTH, HEIGHT)).save(folder / "photos" / f"new{k}.png")
    plant_keypoints(folder / "database.db", truth, {f"new{k}.png": k % 3 for k in range(PHOTOS)})
    return folder / "map", folder / "photos", folder / "database.db"


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as own:
        yield own


def tasks(place: tuple[Path, Path, Path], scene: SceneMap, **options: Any) -> list[PhotoTask]:
    _, photos, database = place
    chosen = {"camera": PINHOLE, "keypoints": database, "seed": 0, "time_limit": None, **options}
    return [photo_task(scene, name, photo, **chosen) for name, photo in photo_files([photos]).items()]


def test_a_lost_worker_loses_nothing(place: tuple[Path, Path, Path], cluster: LocalCluster) -> None:
    scene = SceneMap.from_colmap(place[0])
    photos = tasks(place, scene, views=VIEWS)
    photos.append(replace(photos[0], name="lost.png", photo=place[1] / "lost.png"))
    alone = {task.name: solution for task, solution in attempts(scene, photos)}

    with Client(cluster) as client:
        workers = client.run(os.getpid)
        found = attempts_on_cluster(scene, photos, cluster.scheduler_address)
        results = {task.name: solution for task, solution in [next(found)]}
        os.kill(min(workers.values()), signal.SIGKILL)
        results |= {task.name: solution for task, solution in found}
        assert set(client.run(os.getpid).values()) != set(workers.values())

    assert set(results) == set(alone) == {task.name for task in photos}
    assert "cannot read the photo" in str(results.pop("lost.png"))
    for name, solution in results.items():
        assert isinstance(solution, Solution)
        assert solution.verdict == "confident"
        np.testing.assert_array_equal(solution.rotation, alone[name].rotation)
        np.testing.assert_array_equal(solution.matches, alone[name].matches)


def test_a_run_that_is_stopped_leaves_no_map_on_the_workers(
    place: tuple[Path, Path, Path], cluster: LocalCluster
) -> None:
    scene = SceneMap.from_colmap(place[0])
    found = attempts_on_cluster(scene, tasks(place, scene, views=VIEWS), cluster.scheduler_address)
    with Client(cluster) as client:
        next(found)
        assert all(client.run(maps_of).values())
        found.close()  # type: ignore[attr-defined]
        assert not any(client.run(maps_of).values())


def maps_of(dask_worker: Worker) -> list[str]:
    return [name for name in dask_worker.plugins if name.startswith("bpnp-")]


def test_processes_started_here_are_ended(place: tuple[Path, Path, Path]) -> None:
    before = set(psutil.Process().children(recursive=True))
    scene = SceneMap.from_colmap(place[0])
    lost = replace(tasks(place, scene)[0], name="lost.png", photo=place[1] / "lost.png")
    ((task, reason),) = attempts_on_cluster(scene, [lost], "1")
    assert (task.name, "cannot read the photo" in str(reason)) == ("lost.png", True)
    left = [" ".join(each.cmdline()) for each in set(psutil.Process().children(recursive=True)) - before]
    # Python's own tracker of shared memory is started with the first process and lives as long as this one.
    assert [words for words in left if "multiprocessing.resource_tracker" not in words] == []


def test_the_command_takes_a_cluster(place: tuple[Path, Path, Path], cluster: LocalCluster, tmp_path: Path) -> None:
    model, photos, database = map(str, place)
    command = ["localize", model, photos, "--camera", "PINHOLE,520,520,400,300", "--keypoints", database]
    main([*command, "--output", str(tmp_path), "--no_pictures", "--cluster", cluster.scheduler_address])
    lines = (tmp_path / "poses.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines if not line.startswith("#")] == list(VIEWS)


@pytest.mark.parametrize("cluster_name", ["0", "nowhere", "tcp://["])
def test_no_scheduler_is_one_clear_error(place: tuple[Path, Path, Path], cluster_name: str) -> None:
    scene = SceneMap.from_colmap(place[0])
    with pytest.raises(ValueError, match=f"--cluster is {re.escape(cluster_name)}[;,]"):
        next(attempts_on_cluster(scene, tasks(place, scene), cluster_name))
