"""The restricted unpickler: what numpy writes comes back the same; nothing in a file is ever run."""

import collections
import datetime
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from bpnp.datamodules.authors import PickleError, load_pickle


def arrays() -> dict[str, object]:
    rng = np.random.default_rng(0)
    ragged = np.empty(2, object)
    ragged[0], ragged[1] = rng.random((2, 2)), [1, np.float32(2.5)]
    return {
        "p2d": {i: rng.random((i, 2)) for i in range(4)},
        "p3d": [rng.random((3, 4)).astype("f4").T, np.asfortranarray(rng.random((3, 5)))],
        "W_gt": (rng.permutation(5), np.arange(3, dtype=np.uint16), np.array([True, False])),
        "numbers": [np.float64(0.1), np.int32(-3), 7, 2.5, None, True, 10**30, "text", b"bytes", np.bool_(True)],
        "big endian": np.arange(4, dtype=">f8"),
        "scalar": np.array(3.5),
        "ragged": ragged,
        "sets": {1, 2},
        "same": [a := np.arange(3), a],
        "ordered": collections.OrderedDict(a=1),
    }


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        if not isinstance(b, np.ndarray) or a.shape != b.shape or a.dtype != b.dtype.newbyteorder(a.dtype.byteorder):
            return False
        return all(same(x, y) for x, y in zip(a.flat, b.flat, strict=True)) if a.dtype == object else (a == b).all()
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


@pytest.mark.parametrize("protocol", range(6))
def test_round_trip(tmp_path: Path, protocol: int) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(arrays(), protocol))
    assert same(arrays(), load_pickle(tmp_path / "x.pkl"))


def test_a_pickle_of_python_2_is_read(tmp_path: Path) -> None:
    """The pickle of Python 2 and its numpy for {0: np.array([1.0, 2.0])}: byte strings for names and contents."""
    raw = np.array([1.0, 200.0]).tobytes()
    text = (
        b"\x80\x02}q\x01K\x00cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\nq\x03K\x00\x85U\x01b\x87R"
        b"(K\x01K\x02\x85cnumpy\ndtype\nq\x04U\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff"
        b"K\x00tb\x89U" + bytes([len(raw)]) + raw + b"tbs."
    )
    (tmp_path / "x.pkl").write_bytes(text)
    assert same({0: np.array([1.0, 200.0])}, load_pickle(tmp_path / "x.pkl"))


class Call:
    """Pickles to a call of `function`."""

    def __init__(self, function: object, *args: object, state: object = None) -> None:
        self.function, self.args, self.state = function, args, state

    def __reduce__(self) -> tuple[object, ...]:
        return (self.function, self.args) if self.state is None else (self.function, self.args, self.state)


CALLS = {
    "os.system": (Call(os.system, "touch hacked"), "system"),
    "eval": (Call(eval, "__import__('os').system('touch hacked')"), "eval"),
    "getattr": (Call(getattr, "", "join"), "getattr"),
    "numpy.load": (Call(np.load, "x.npy"), "numpy.load"),
    "numpy.memmap": (Call(np.memmap, "hacked", "u1", "w+", 0, 4), "memmap"),
    "nested": ({"p2d": [(1, {"a": Call(os.system, "touch hacked")})]}, "system"),
    "in an array": (np.array([Call(os.system, "touch hacked")], object), "system"),
    "a module's class": (datetime.date(2020, 1, 1), "datetime"),
    "a type": (int, "int|long"),
    "a record type": (np.zeros(2, [("a", "f8"), ("b", "O")]), "type"),
    "a type in a type": (Call(np.dtype, ("i8", [("a", "O")])), "type"),
    "a text array": (np.array(["a"]), "type"),
    "a masked array": (np.ma.masked_array([1, 2], [0, 1]), "refused"),
}


@pytest.mark.parametrize("name", CALLS)
def test_calls_are_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    value, message = CALLS[name]
    for protocol in (2, 4, 5):
        Path("x.pkl").write_bytes(pickle.dumps(value, protocol))
        with pytest.raises(PickleError, match=rf"x\.pkl: .*({message})"):
            load_pickle(Path("x.pkl"))
    assert not list(tmp_path.glob("hacked*"))


def state(shape: tuple, kind: object, content: object) -> Call:
    return Call(np.zeros(0).__reduce__()[0], np.ndarray, (0,), b"b", state=(1, shape, kind, False, content))


TAMPERED = {
    "more bytes than there are": state((1000,), np.dtype("f8"), bytes(8)),
    "fewer": state((1,), np.dtype("f8"), bytes(80)),
    "a negative shape": state((-1, -1), np.dtype("f8"), bytes(8)),
    "a huge shape": state((2**40, 2**40), np.dtype("f8"), bytes(8)),
    "pointers": state((1,), np.dtype("O"), bytes(8)),
    "a shape that is no tuple": state([1], np.dtype("f8"), bytes(8)),
    "no type": state((1,), "f8", bytes(8)),
    "a number type of objects": state((1,), np.dtype("f8"), [1.0]),
    "an array of a list": Call(np.zeros(0).__reduce__()[0], list, (0,), b"b"),
}


OPCODES = {
    "objects behind a number's type": b"cnumpy\ndtype\n(U\x02V8K\x00K\x01tR(K\x03U\x01|N(U\x01atp}NK\x08K\x01K\x00tb.",
    "another type's fields": b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<N(U\x01at}J\x08\0\0\0K\x01K\x00tb.",
    "a function's state": b"c_codecs\nencode\n}U\x04__k_K\x01sb.",
    "a function as a value": b"c_codecs\nencode\n.",
    "a new object of a function": b"c_codecs\nencode\n)\x81.",
    "an attribute by its path": b"\x80\x04\x8c\x05numpy\x8c\x0bdtype.names\x93.",
    "a persistent reference": b"\x80\x02U\x011Q.",
    "an extension": b"\x80\x02\x82\x01.",
    "an instance": b"(U\x0etouch hacked  ios\nsystem\n.",
    "an encoding with a search": b"c_codecs\nencode\n(X\x01\x00\x00\x00aX\x05\x00\x00\x00rot13tR.",
    "many bytes": b"\x80\x02cbuiltins\nbytes\nJ\xff\xff\xff\x7f\x85R.",
    "an unhashable key": b"}]K\x01s.",
    "a buffer from elsewhere": b"\x80\x05\x97.",
    "a promise of bytes": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0fabc.",
    "empty": b"",
    "text": b"404: Not Found",
    "html": b"<!DOCTYPE html>",
    "no end": pickle.dumps(np.arange(100))[:-40],
}


def test_strange_tampered_and_broken_pickles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for content in [*OPCODES.values(), *(pickle.dumps([tampered], 2) for tampered in TAMPERED.values())]:
        Path("x.pkl").write_bytes(content)
        with pytest.raises(PickleError, match=r"x\.pkl: ."):
            load_pickle(Path("x.pkl"))
    assert not Path("hacked").exists()


def test_random_damage_is_an_error_or_plain_data(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole = pickle.dumps({0: np.arange(20.0), 1: [np.float64(2)]}, 4)
    for _ in range(1000):
        content = bytearray(whole)
        for position in rng.integers(0, len(content), rng.integers(1, 4)):
            content[position] = rng.integers(256)
        (tmp_path / "x.pkl").write_bytes(content)
        try:
            value = load_pickle(tmp_path / "x.pkl")
        except PickleError:
            continue
        assert isinstance(value, (dict, list, tuple, np.ndarray))


def test_a_large_index_of_the_memo_takes_no_memory(tmp_path: Path) -> None:
    (tmp_path / "x.pkl").write_bytes(b"\x80\x04}r\xff\xff\xff\x7f.")  # an empty dict, kept under the index 2^31 - 1
    assert load_pickle(tmp_path / "x.pkl") == {}
