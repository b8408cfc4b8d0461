import os
import threading
from pathlib import Path

from bpnp.files import write_text


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
