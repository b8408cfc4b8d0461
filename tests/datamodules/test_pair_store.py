"""The packed store: what comes out is what went in, nothing is copied, and damage is noticed."""

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from bpnp.datamodules.loader import Pair, PairSource, pair_loader
from bpnp.datamodules.manifest import StoreError, is_store
from bpnp.datamodules.pair_store import PairStore, write_pairs
from bpnp.datamodules.store_source import StoreSource


def pairs(count: int = 12) -> list[tuple[str, Pair]]:
    """Pairs of 4 to 60 true pairs with clutter on both sides; the x of both points of a pair are equal."""
    result = []
    for i in range(count):
        rng = np.random.default_rng(i)
        k, free2d, free3d = rng.integers(4, 60), rng.integers(0, 40), rng.integers(0, 40)
        values = rng.random(k)
        points2d = np.column_stack([np.r_[values, -1 - rng.random(free2d)], rng.random(k + free2d)])
        points3d = np.column_stack([np.r_[values, 2 + rng.random(free3d)], rng.random((k + free3d, 2))])
        order = rng.permutation(len(points2d))
        match = np.r_[np.argsort(order)[:k], np.full(free3d, -1)]
        pose = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
        name = f"scène {i % 3}/{i}"
        pair = Pair(name, np.float32(points2d[order]), np.float32(points3d), *pose, match, float(i + 1))
        result.append((f"s{i % 3}", pair))
    return result


@pytest.fixture
def store(tmp_path: Path) -> PairStore:
    write_pairs(tmp_path / "store", pairs(), parameters={"clutter": 1.0}, skipped={"s9/1": "too few"})
    return PairStore(tmp_path / "store")


def same(a: Pair, b: Pair) -> bool:
    return a.name == b.name and a.focal == b.focal and all(
        np.array_equal(getattr(a, f), getattr(b, f))
        for f in ("points2d", "points3d", "match3d", "rotation", "translation")
    )  # fmt: skip


def test_round_trip(store: PairStore) -> None:
    assert len(store) == 12
    assert store.scenes == ("s0", "s1", "s2")
    assert store.parameters == {"clutter": 1.0}
    assert store.skipped == {"s9/1": "too few"}
    for i, (scene, pair) in enumerate(pairs()):
        assert same(store.pair(i), pair)
        assert store.scenes[store.scene[i]] == scene
        assert (store.count2d[i], store.count3d[i]) == (len(pair.points2d), len(pair.points3d))
        assert store.matched[i] == (pair.match3d >= 0).sum()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"match3d": np.array([0.0, 1.5, -1.0, 2.0])}, "`match3d` as integers.*float64 in 'a/1'; try .astype"),
        ({"match3d": np.array([0, 1, -1, 4])}, "`match3d` between -1 and 3, got -1 to 4 in 'a/1'"),
        ({"match3d": np.arange(3)}, r"`match3d` \(n,\), got .* in 'a/1'"),
        ({"points2d": np.full((4, 2), np.nan, "f4")}, "finite points, pose and focal.*'a/1'"),
        ({"translation": np.full(3, np.inf)}, "finite points, pose and focal.*'a/1'"),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path: Path, change: dict[str, np.ndarray], message: str) -> None:
    points = np.ones((4, 3), "f4")
    pair = Pair("a/1", points[:, :2], points, np.eye(3), np.zeros(3), np.arange(4), 1.0)
    vars(pair).update(change)  # past the type checks of the tests, which users do not have
    with pytest.raises(ValueError, match=message):
        write_pairs(tmp_path / "store", [("a", pair)], parameters={}, skipped={})
    assert list(tmp_path.iterdir()) == []


def test_the_origin_is_kept_and_turns_with_the_points(tmp_path: Path) -> None:
    """The pose in the scene, camera = R (p + origin) + t - R origin, is that of the pair however it is turned."""
    points = np.random.default_rng(0).normal(size=(6, 3)).astype("f4")
    origin, rotation = np.array([5e5, -3e6, 40.0]), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    pair = Pair("a/1", points[:, :2], points, rotation, np.ones(3), np.arange(6), 1.0, origin)
    write_pairs(tmp_path / "store", [("a", pair)], parameters={}, skipped={})
    store = PairStore(tmp_path / "store")
    assert np.array_equal(store.pair(0).origin, origin)
    turned = StoreSource(store, np.arange(1), rotate=True).pair(0, 0)
    assert not np.allclose(turned.origin, origin)
    np.testing.assert_allclose(turned.rotation @ turned.origin, rotation @ origin, rtol=1e-12)


def test_a_store_may_be_empty(tmp_path: Path) -> None:
    write_pairs(tmp_path / "none", [], parameters={}, skipped={"s0": "bad"})
    assert len(PairStore(tmp_path / "none")) == 0


def test_nothing_is_copied_for_a_reader_or_a_worker(store: PairStore) -> None:
    a, b = store.pair(3).points3d, store.pair(3).points3d
    assert np.shares_memory(a, b)
    assert not a.flags.writeable
    sent = pickle.dumps(store)
    assert len(sent) < 500
    assert same(pickle.loads(sent).pair(5), store.pair(5))


def test_a_source_draws_subsets_and_clutter(store: PairStore) -> None:
    source = StoreSource(store, np.arange(12), max_points=20, clutter=0.5, fresh=True)
    assert isinstance(source, PairSource)
    for i in range(12):
        pair = source.pair(i, 4)
        kept = min(20, store.matched[i])
        true = pair.match3d >= 0
        assert true.sum() == kept
        assert (pair.points3d[true, 0] == pair.points2d[pair.match3d[true], 0]).all()
        assert (pair.points3d[~true, 0] >= 2).all()
        assert (pair.points2d[:, 0] < 0).sum() == min(round(0.5 * kept), store.count2d[i] - store.matched[i])
        assert max(len(pair.points2d), len(pair.points3d)) == source.sizes[i]
        assert same(pair, source.pair(i, 4))
    assert not same(source.pair(0, 0), source.pair(0, 1))


def test_rotation_keeps_the_camera_coordinates(store: PairStore) -> None:
    straight, turned = (StoreSource(store, np.arange(12), rotate=r).pair(2, 0) for r in (False, True))
    expected = straight.points3d @ straight.rotation.T + straight.translation
    assert turned.points3d @ turned.rotation.T + turned.translation == pytest.approx(expected, abs=1e-5)
    assert not np.allclose(turned.points3d, straight.points3d)


def test_small_pairs_are_left_out(store: PairStore) -> None:
    with pytest.warns(UserWarning, match=r"skipped \d+ of 12 pairs"):
        source = StoreSource(store, np.arange(12), min_points=30)
    assert len(source.sizes) + source.skipped == 12
    assert {source.pair(i, 0).name for i in range(len(source.sizes))} == {
        pair.name for _, pair in pairs() if (pair.match3d >= 0).sum() >= 30
    }
    with pytest.raises(StoreError, match="min_points"):
        StoreSource(store, np.arange(12), min_points=100)


@pytest.mark.parametrize("num_workers", [0, 2])
def test_every_pair_is_served_once(store: PairStore, num_workers: int) -> None:
    source = StoreSource(store, np.arange(12))
    loader = pair_loader(source, batch_size=4, shuffle=False, seed=0, num_workers=num_workers)
    assert sorted(i for batch in loader for i in batch.ids) == sorted(pair.name for _, pair in pairs())


@pytest.mark.parametrize("name", ["index.bin", "names.bin", "points2d.bin", "points3d.bin", "match3d.bin"])
@pytest.mark.parametrize("damage", ["cut", "long", "gone", "flip"])
def test_damage_is_one_clear_error(store: PairStore, name: str, damage: str) -> None:
    path = store.folder / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    changed = {"cut": content[:-1], "long": content + b"0", "flip": content, "gone": b""}[damage]
    os.unlink(path)
    if damage != "gone":
        path.write_bytes(changed)
    with pytest.raises(StoreError, match=str(store.folder)):
        [PairStore(store.folder).pair(i) for i in range(12)]


@pytest.mark.parametrize("content", ["", "{}", "[]", "null", "not json", '{"digest": 1}'])
def test_a_broken_manifest_is_one_clear_error(store: PairStore, content: str) -> None:
    (store.folder / "manifest.json").write_text(content)
    with pytest.raises(StoreError, match=str(store.folder)):
        PairStore(store.folder)


def test_an_edited_manifest_is_noticed(store: PairStore) -> None:
    path = store.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    assert manifest["counts"]["pairs"] == 12
    manifest["scenes"]["s0"] += 1
    path.write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="edited"):
        PairStore(store.folder)


def test_a_failed_write_leaves_nothing(tmp_path: Path, store: PairStore) -> None:
    def broken() -> object:
        yield from pairs(3)
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_pairs(tmp_path / "other", broken(), parameters={}, skipped={})
    with pytest.raises(StoreError, match="exists"):
        write_pairs(store.folder, pairs(), parameters={}, skipped={})
    assert [p.name for p in tmp_path.iterdir()] == ["store"]
    assert is_store(store.folder)
    assert not is_store(tmp_path)
