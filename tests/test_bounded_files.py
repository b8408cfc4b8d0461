"""Files that claim more than they hold, or have no end, are refused in one sentence before they take memory."""

import contextlib
import io
import os
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.lib import format as npy

from bpnp import bounded_files
from bpnp.bounded_files import (
    MOST_TEXT,
    file_inside,
    parse_npy,
    read_bytes,
    read_json,
    read_npy,
    read_npz,
    read_yaml,
)

NUMBERS = np.random.default_rng(0).normal(size=(20, 3))
# Ten lists of ten of the list before: ten billion values in 500 bytes.
BOMB = "l0: &l0 [1]\n" + "".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 10)}]\n" for i in range(1, 11))


def array_file(shape: tuple[int, ...], descr: str = "<f8", body: bytes = bytes(480)) -> bytes:
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return file.getvalue() + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            array_file((10**12, 3)),
            r"states float64 of shape \(1000000000000, 3\), 24000000000000 bytes, .* at most 480",
        ),
        (array_file((5 * 10**8, 3)), "12000000000 bytes"),
        (array_file((61, 1)), "488 bytes, and there are at most 480"),
        (array_file((-1, 3)), r"states the shape \(-1, 3\)"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{" + b"(" * 9000, "no .npy file"),
        (b"\x93NUMPY\x01\x00", "no .npy file"),
        (b"", "no .npy file"),
    ],
)
def test_an_array_that_is_larger_than_its_file_is_refused_without_memory(content: bytes, message: str) -> None:
    tracemalloc.start()
    with pytest.raises(ValueError, match=message):
        parse_npy(content)
    assert tracemalloc.get_traced_memory()[1] < 10**6
    tracemalloc.stop()


def test_arrays_of_objects_and_records_are_refused_and_plain_ones_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for values in (NUMBERS, np.asfortranarray(NUMBERS), NUMBERS.astype(">f4"), NUMBERS[:0], np.arange(3)):
        np.save(path, values)
        np.testing.assert_array_equal(read_npy(path), values)
    np.save(path, np.array([None, {}], object))
    with pytest.raises(ValueError, match="a.npy: it holds Python objects, which are not read"):
        read_npy(path)
    np.save(path, np.zeros(2, [("x", float), ("y", float)]))
    with pytest.raises(ValueError, match="it holds records with the fields x, y; save rows of numbers"):
        read_npy(path)


def test_an_archive_is_read_unless_it_is_larger_than_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, a=NUMBERS, b=np.arange(4))
    arrays = read_npz(path)
    np.testing.assert_array_equal(arrays["a"], NUMBERS)
    np.testing.assert_array_equal(arrays["b"], [0, 1, 2, 3])
    np.savez_compressed(path, a=np.zeros(10**7))
    with pytest.raises(ValueError, match="its arrays are compressed"):
        read_npz(path)


def test_what_has_no_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_files, "PIPE_SECONDS", 0.0)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link.csv").symlink_to("/dev/zero")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(10**13)
    for path, message in (
        (Path("/dev/zero"), "/dev/zero is a device; give a file"),
        (tmp_path / "link.csv", "link.csv is a device"),
        (tmp_path, "is a folder; give a file"),
        (tmp_path / "pipe", "no program writes to the pipe .*pipe; start the one that does, or give a file"),
        (tmp_path / "large", "large has more than the 128 MiB that are read of such a file"),
    ):
        with pytest.raises(ValueError, match=message):
            read_bytes(path)
    assert MOST_TEXT == 128 * 2**20


def test_a_pipe_is_read_up_to_its_bound(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)

    def write(size: int) -> None:
        with contextlib.suppress(BrokenPipeError):
            pipe.write_bytes(b"x" * size)

    for size in (10, 100_000, 300_000):
        writer = threading.Thread(target=write, args=(size,))
        writer.start()
        if size < 200_000:
            assert read_bytes(pipe, most=200_000) == b"x" * size
        else:
            with pytest.raises(ValueError, match="pipe has more than the"):
                read_bytes(pipe, most=200_000)
        writer.join()


def test_memory_is_bounded() -> None:
    """A process with 2 GiB of addresses refuses them all by name."""
    code = """
import resource, sys
from pathlib import Path
from bpnp.bounded_files import read_bytes
resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))
for name in ("/dev/zero", "/dev/random", "/dev/stdin"):
    try:
        read_bytes(Path(name))
    except ValueError as error:
        print(error)
"""
    with subprocess.Popen(["cat", "/dev/zero"], stdout=subprocess.PIPE) as endless:
        done = subprocess.run([sys.executable, "-c", code], stdin=endless.stdout, capture_output=True, text=True)
        endless.kill()
    assert done.stdout.splitlines() == [
        "/dev/zero is a device; give a file",
        "/dev/random is a device; give a file",
        "/dev/stdin has more than the 128 MiB that are read of such a file; give a smaller one",
    ], done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "it has more than 100000 values, aliases"),
        ("a: &a [*a]", r"the alias \*a stands for itself"),
        ("a: " + "[" * 100_000, "it is nested more than 100 deep"),  # libyaml ends the process
        ("a: [1", "did not find expected"),
    ],
)
def test_yaml_that_grows_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"a.yaml is not YAML: .*{message}"):
        read_yaml(tmp_path / "a.yaml")


def test_yaml_with_anchors_is_read(tmp_path: Path) -> None:
    text = "base: &base {a: 1, b: [2, 3]}\nother:\n  <<: *base\n  c: 4\nlist: [*base, *base]\n"
    (tmp_path / "a.yaml").write_text(text)
    assert read_yaml(tmp_path / "a.yaml") == yaml.safe_load(text)


def test_json_that_is_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text('{"a": [1, 2.5]}')
    assert read_json(tmp_path / "a.json") == {"a": [1, 2.5]}


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    assert file_inside(tmp_path, "a/b c.jpg") == tmp_path / "a" / "b c.jpg"
    for name in ("../x", "a/../../x", "/etc/passwd", "..", "", "..\\x", "a\0b", "\\\\host\\x"):
        assert file_inside(tmp_path, name) is None
