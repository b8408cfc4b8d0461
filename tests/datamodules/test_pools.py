"""The cache of surface samples: it notices what is broken, leaves out what is bad, and leaves nothing half-written."""

import json
import multiprocessing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bpnp.datamodules.meshes.pools import SurfacePools, open_pools
from bpnp.datamodules.meshes.surfaces import MeshError

NAMES = ["a", "b", "c"]


def samples_of(i: int) -> np.ndarray:
    return np.random.default_rng(i).normal(size=(5, 3))


class Counted:
    """Samples of three meshes; counts how often it is asked, and refuses the meshes in `bad`."""

    def __init__(self, *bad: int) -> None:
        self.calls, self.bad = 0, bad

    def __call__(self, i: int) -> np.ndarray:
        self.calls += 1
        if i in self.bad:
            raise MeshError(f"{NAMES[i]}.off: expected better")
        return samples_of(i)


def pools(folder: Path, sample: Callable[[int], np.ndarray], **inputs: int) -> SurfacePools:
    return open_pools(folder, label="toy", inputs=inputs, names=NAMES, sample=sample, pool_size=5)


def check(opened: SurfacePools) -> None:
    assert opened.names == tuple(NAMES)
    expected = np.stack([samples_of(i) for i in range(3)])
    np.testing.assert_array_equal(opened.points, expected.astype(np.float32))
    assert opened.radius == np.linalg.norm(expected, axis=-1).max()


def only(folder: Path, suffix: str) -> Path:
    (path,) = folder.glob(f"*{suffix}")
    return path


def test_built_once_and_again_when_the_inputs_change(tmp_path: Path) -> None:
    sample = Counted()
    check(pools(tmp_path, sample))
    check(pools(tmp_path, sample))
    assert sample.calls == 3
    check(pools(tmp_path, sample, mtime=1))
    assert sample.calls == 6
    assert len(list(tmp_path.iterdir())) == 4


def truncate(folder: Path) -> None:
    path = only(folder, ".npy")
    path.write_bytes(path.read_bytes()[:-7])


def flip(suffix: str, position: int) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        content = bytearray(only(folder, suffix).read_bytes())
        content[position] ^= 1
        only(folder, suffix).write_bytes(bytes(content))

    return damage


def change(**fields: object) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        manifest = json.loads(only(folder, ".json").read_text())
        only(folder, ".json").write_text(json.dumps(manifest | fields))

    return damage


DAMAGES = {
    "truncated": truncate,
    "a byte of the samples": flip(".npy", -20),
    "a byte of the header": flip(".npy", 3),
    "a byte of the manifest": flip(".json", 0),
    "another name": change(names=["a", "b", "d"]),
    "another key": change(key="0"),
    "no samples": lambda folder: only(folder, ".npy").unlink(),
    "no manifest": lambda folder: only(folder, ".json").write_text("{}"),
    "no object": lambda folder: only(folder, ".json").write_text("7"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_broken_cache_is_noticed_and_built_again(tmp_path: Path, damage: str) -> None:
    sample = Counted()
    pools(tmp_path, sample)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    DAMAGES[damage](tmp_path)
    with pytest.warns(UserWarning, match=r"toy-\w+\.npy is broken .*; building it again"):
        check(pools(tmp_path, sample))
    assert sample.calls == 6
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_bad_meshes_are_left_out_with_one_warning(tmp_path: Path) -> None:
    for _ in range(2):  # built, then opened
        with pytest.warns(UserWarning, match=r"left out 1 of 3 meshes.*b\.off: expected better") as warned:
            opened = pools(tmp_path, Counted(1))
        assert len(warned) == 1
        assert opened.names == ("a", "c")
        np.testing.assert_array_equal(opened.points, np.stack([samples_of(0), samples_of(2)]).astype(np.float32))


def fail(error: type[BaseException]) -> Callable[[int], np.ndarray]:
    def sample(i: int) -> np.ndarray:
        if i == 2:
            raise error
        return samples_of(i)

    return sample


def test_nothing_is_left_of_a_build_that_fails(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"one usable mesh in toy, got 3 bad ones; the first: a\.off: expected better"):
        pools(tmp_path, Counted(0, 1, 2))
    for error in (KeyboardInterrupt, OSError):
        with pytest.raises(error):
            pools(tmp_path, fail(error))
    assert list(tmp_path.iterdir()) == []


def test_two_processes_may_build_at_once(tmp_path: Path) -> None:
    def build(barrier: multiprocessing.Barrier) -> None:
        def sample(i: int) -> np.ndarray:
            barrier.wait(timeout=30)
            return samples_of(i)

        check(pools(tmp_path, sample))

    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(2)
    processes = [context.Process(target=build, args=(barrier,)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    assert len(list(tmp_path.iterdir())) == 2
    check(pools(tmp_path, fail(AssertionError)))
