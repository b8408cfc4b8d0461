import os
import threading
from pathlib import Path

import pytest

from bpnp.files import check_outputs, lock_folder, write_text


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    """As for devices, such as /dev/null and /dev/stdout, which root could replace by a file."""
    pipe, read = tmp_path / "pipe", list[str]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    assert write_text(pipe, "a pose\n") == pipe
    assert pipe.is_fifo()
    reader.join(60)
    assert read == ["a pose\n"]
    assert list(tmp_path.iterdir()) == [pipe]


def test_outputs_that_cannot_be_written_are_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    check_outputs([None, tmp_path / "new" / "r.json", Path(os.devnull)], [None, file, tmp_path])
    assert (tmp_path / "new").is_dir()
    for outputs, message in (
        ([tmp_path], "is a folder; give a file name to write to"),
        ([file], "file is an input and would be overwritten; name another file"),
        ([tmp_path / "a", tmp_path / "new" / ".." / "a"], "is the file of two outputs; name another file"),
        ([file / "a"], "a cannot be written: File exists; name a file in another folder"),
        ([file / "b" / "a"], "a cannot be written: Not a directory; name a file in another folder"),
    ):
        with pytest.raises(ValueError, match=message):
            check_outputs(outputs, [file])
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)  # permissions do not hold for root
    with pytest.raises(ValueError, match="c cannot be written: no permission; name a file in another folder"):
        check_outputs([tmp_path / "c"])


def test_a_folder_that_cannot_be_created_is_not_tried_forever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in /proc, where each new folder is missing at once."""
    tried: list[Path] = []

    def vanish(folder: Path, **_: object) -> None:
        tried.append(folder)
        assert len(tried) < 1000
        raise FileNotFoundError(folder)

    monkeypatch.setattr(Path, "mkdir", vanish)
    with (
        pytest.raises(ValueError, match="cannot create the folder .*nowhere; name another one"),
        lock_folder(tmp_path / "nowhere", wait=True),
    ):
        pass
