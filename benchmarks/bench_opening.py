"""Opening a map: CPU seconds and peak memory of `SceneMap.from_colmap`, and of the first photo, without and with index.

    python -m benchmarks opening --points 10000 100000 1000000

Maps are drawn: places of 1,000 points that ten views see, as COLMAP's binary files in --folder, which is emptied. Each
row is a process of its own; opening counts what the first photo would compute.
"""

import multiprocessing
import resource
import shutil
import time
from pathlib import Path

import numpy as np
from record import parser
from scipy.spatial.transform import Rotation

import bpnp

SEEN, TRACK = 1000, 10  # points of a place, views that see them
FOCAL, WIDTH, HEIGHT = 700.0, 800, 600


def write_map(folder: Path, count: int) -> None:
    """A COLMAP model of so many points, and what a view of its last place sees: photo.npy."""
    rng, places = np.random.default_rng(count), count // SEEN
    folder.mkdir(parents=True)
    lens = np.array([FOCAL, WIDTH / 2, HEIGHT / 2]).tobytes()
    head = np.uint64(1).tobytes() + np.array([1, 0], "<i4").tobytes() + np.array([WIDTH, HEIGHT], "<u8").tobytes()
    (folder / "cameras.bin").write_bytes(head + lens)
    fields = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    points = np.zeros((places, SEEN), np.dtype([*fields, ("track", "<u4", (TRACK, 2))]))
    points["id"], points["length"] = np.arange(1, count + 1).reshape(places, SEEN), TRACK
    keypoints = np.zeros(SEEN, np.dtype([("xy", "<f8", 2), ("id", "<i8")]))
    with (folder / "images.bin").open("wb") as file:
        file.write(np.uint64(places * TRACK).tobytes())
        for number in range(places * TRACK):
            place, k = divmod(number, TRACK)
            if k == 0:
                own, middle = rng.uniform(-1, 1, (SEEN, 3)) * [1, 1, 0.2], rng.uniform(0, 50 * places ** (1 / 3), 3)
                points["xyz"][place] = own + middle
            turn, shift = Rotation.from_rotvec(0.2 * rng.standard_normal(3)), np.array([0, 0, rng.uniform(3, 4)])
            camera = turn.apply(own) + shift
            keypoints["xy"] = FOCAL * camera[:, :2] / camera[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            keypoints["id"] = points["id"][place]
            points["track"][place, :, k] = np.column_stack([np.full(SEEN, number + 1), np.arange(SEEN)])
            pose = np.r_[turn.as_quat(scalar_first=True), shift - turn.apply(middle)].tobytes()
            file.write(np.uint32(number + 1).tobytes() + pose + np.uint32(1).tobytes() + f"{number}.jpg\0".encode())
            file.write(np.uint64(SEEN).tobytes() + keypoints.tobytes())
    (folder / "points3D.bin").write_bytes(np.uint64(count).tobytes() + points.tobytes())
    chosen = rng.permutation(SEEN)[: SEEN // 2]
    np.save(folder / "photo.npy", keypoints["xy"][chosen] + 0.5 * rng.standard_normal((len(chosen), 2)))


def opened(folder: Path) -> None:
    """Print seconds and memory of this process."""
    bpnp.warm_up()
    begun = time.process_time()
    scene = bpnp.SceneMap.from_colmap(folder)
    known = len(scene.cones.axes), len(scene.pictures.reaches)  # what the first photo would compute
    assert known == (len(scene.points3d), len(scene.views))
    middle, memory = time.process_time(), peak()
    found = scene.localize(np.load(folder / "photo.npy"), ("SIMPLE_PINHOLE", (FOCAL, WIDTH / 2, HEIGHT / 2)))
    after = time.process_time()
    print(
        f"{scene}: opened in {middle - begun:.2f} CPU s, {memory:.2f} GB; first photo {after - middle:.2f} CPU s, "
        f"{peak():.2f} GB, {found.verdict}",
        flush=True,
    )


def peak() -> float:
    """Memory of this process, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--points", type=int, nargs="+", default=[10**4, 10**5, 10**6])
    options.add_argument("--folder", type=Path, default=Path("runs/opening"))
    chosen = options.parse_args()
    for count in chosen.points:
        shutil.rmtree(chosen.folder, ignore_errors=True)
        write_map(chosen.folder, count)
        for _ in range(2):
            process = multiprocessing.get_context("spawn").Process(target=opened, args=(chosen.folder,))
            process.start()
            process.join()
