from collections.abc import Callable

import pytest

from bpnp.cli import main


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command with a user's mistake: exit status 2, and one clear line on stderr, which is returned."""

    def run(*arguments: str) -> str:
        with pytest.raises(SystemExit) as stop:
            main(list(arguments))
        assert stop.value.code == 2
        error = capsys.readouterr().err
        assert "Traceback" not in error
        assert sum(line.startswith("bpnp: error: ") for line in error.splitlines()) == 1
        assert error.splitlines()[-1].startswith("bpnp: error: ")
        return error

    return run
