"""The data store: what comes out is what went in, nothing is copied, and damage is noticed."""

import json
import os
import resource
import zlib
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from bpnp.datamodules.store import (
    JobResult,
    Recipe,
    Store,
    StoreError,
    is_store,
    new_store,
    open_or_prepare,
    open_store,
)
from bpnp.files import fingerprint

pytestmark = pytest.mark.slow

WIDTHS = {"flat": 2, "deep": 3}


def rows() -> list[tuple[str, dict[str, np.ndarray], float]]:
    """Name, points of either column, and one number, of 12 rows of 0 to 40 points."""
    result = []
    for i in range(12):
        rng = np.random.default_rng(i)
        points = {name: rng.random((rng.integers(0, 40), width)).astype("f4") for name, width in WIDTHS.items()}
        result.append((f"scène {'x' * i}/{i}", points, float(i)))
    return result


@pytest.fixture
def store(tmp_path: Path) -> Store:
    with new_store(tmp_path / "store", "toy", WIDTHS) as writer:
        for name, points, number in rows():
            writer.add(name, points, {"number": number, "scene": f"s{number}"})
        writer.parameters["clutter"] = 1.0
        writer.skipped["s9/1"] = "too few"
    return open_store(tmp_path / "store", "toy")


def test_round_trip(store: Store) -> None:
    assert len(store) == 12
    for i, (name, points, number) in enumerate(rows()):
        assert (store.name(i), store.columns["number"][i]) == (name, number)
        for key, values in store.row(i).items():
            np.testing.assert_array_equal(values, points[key])
            assert store.counts(key)[i] == len(values)
    assert (store.parameters, store.skipped) == ({"clutter": 1.0}, {"s9/1": "too few"})
    for path in store.folder.glob("*.npy"):
        np.load(path)  # a column is a plain .npy file


COLUMNS = ["flat", "deep", "flat_start", "deep_start", "number", "scene", "name"]


@pytest.mark.parametrize("name", [*(f"{column}.npy" for column in COLUMNS), "manifest.json"])
@pytest.mark.parametrize("damage", ["cut", "long", "gone", "flip", "header"])
def test_damage_is_one_clear_error(store: Store, name: str, damage: str) -> None:
    path = store.folder / name
    content = bytearray(path.read_bytes())
    content[3 if damage == "header" else -1] ^= 1
    changed = {"cut": content[:-1], "long": content + b"0"}.get(damage, content)
    os.unlink(path)
    if damage != "gone":
        path.write_bytes(changed)
    with pytest.raises(StoreError, match=str(store.folder)):
        open_store(store.folder, "toy")


def test_a_broken_or_edited_manifest_and_another_kind_are_noticed(store: Store) -> None:
    with pytest.raises(StoreError, match=r"holds toy in format \d, not other in format \d; use the other data module"):
        open_store(store.folder, "other")
    path = store.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    for content in ("", "{}", "[]", "null", "not json", '{"checksum": 1}', json.dumps(manifest | {"rows": 13})):
        path.write_text(content)
        with pytest.raises(StoreError, match="edited" if "13" in content else str(store.folder)):
            open_store(store.folder, "toy")


@pytest.mark.parametrize("part", ["bulk", "columns", "files"])
def test_a_manifest_that_names_a_file_elsewhere_is_refused(store: Store, part: str) -> None:
    """The other file is a whole column, and the manifest has its checksum."""
    path = store.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    content = (store.folder / "number.npy").read_bytes()
    (store.folder.parent / "x.npy").write_bytes(content)
    if part == "files":
        manifest["files"]["../x.npy"] = [len(content), zlib.crc32(content)]
    else:
        manifest[part].append("../x")
        manifest["files"] |= {"../x.npy": [len(content), zlib.crc32(content)]}
        manifest["files"] |= {"../x_start.npy": [1, 1]} if part == "bulk" else {}
    del manifest["checksum"]
    path.write_text(json.dumps(manifest | {"checksum": fingerprint(manifest)}))
    with pytest.raises(StoreError, match="names files other than the columns in its folder"):
        open_store(store.folder, "toy")


def test_a_failed_write_leaves_nothing(tmp_path: Path, store: Store) -> None:
    def stopped() -> None:
        with new_store(tmp_path / "other", "toy", WIDTHS) as writer:
            writer.add("a", rows()[0][1], {})
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        stopped()
    with pytest.raises(StoreError, match="exists"), new_store(store.folder, "toy", WIDTHS):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["store"]
    assert is_store(store.folder)
    assert not is_store(tmp_path)


def test_a_full_disk_is_one_error_that_names_the_store(tmp_path: Path) -> None:
    """No SIGBUS and nothing left."""
    store, (soft, hard) = tmp_path / "disk" / "store", resource.getrlimit(resource.RLIMIT_FSIZE)
    store.parent.mkdir()

    def fill() -> None:
        with new_store(store, "toy", {"points": 3}) as writer:
            for i in range(400):
                writer.add(str(i), {"points": np.ones((2048, 3))}, {"radius": 1.0})

    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, hard))
    try:
        with pytest.raises(OSError, match=f"File too large: '{store}'"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(store.parent.iterdir()) == []


def one_row(number: int) -> JobResult:
    return [(str(number), {"points": np.full((3, 3), number)}, {})], {}


def toy_recipe() -> tuple[Recipe, Mock]:
    """A recipe of two rows, and the count of its jobs."""
    work = Mock(side_effect=one_row)
    return Recipe("toy", {"points": 3}, {"of": "here"}, [(1,), (2,)], work, "row", "here"), work


def test_a_damaged_store_that_another_process_has_mended_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, work = toy_recipe()
    made = open_or_prepare(recipe, "toy", str(tmp_path)).folder
    (made / "points.npy").write_bytes(b"")

    def noticed(*arguments: object) -> Store:
        """Let another process mend the store after this one has found it damaged."""
        try:
            return open_store(*arguments)
        except StoreError:
            monkeypatch.setattr("bpnp.datamodules.store.open_store", open_store)
            open_or_prepare(recipe, "toy", str(tmp_path))
            raise

    monkeypatch.setattr("bpnp.datamodules.store.open_store", noticed)
    with pytest.warns(UserWarning, match="is damaged .*; making it again") as warned:
        store = open_or_prepare(recipe, "toy", str(tmp_path))
    assert store.row(1)["points"].tolist() == [[2.0] * 3] * 3
    assert work.call_count == 2 * 2
    assert len(warned) == 1
    assert list(tmp_path.iterdir()) == [made]


def test_a_store_of_another_format_is_refused_with_the_advice_to_prepare_it_again(tmp_path: Path) -> None:
    manifest = {"format": 3, "kind": "problems", "rows": 0, "bulk": [], "columns": {}, "checksum": 0}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="holds problems in format 3, not problems in format 4; .*prepare it again"):
        open_store(tmp_path, "problems")


def test_versions_of_two_formats_share_a_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, work = toy_recipe()
    folders = []
    for version in (4, 5, 4, 5):
        monkeypatch.setattr("bpnp.datamodules.store.FORMAT", version)
        folders.append(open_or_prepare(recipe, "toy", str(tmp_path)).folder)
    assert folders[:2] == folders[2:]
    assert work.call_count == 2 * 2
