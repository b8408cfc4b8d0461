import os
import signal
from pathlib import Path

import lightning  # noqa: F401, its log handler keeps the stderr of its first import, which a test would close
import pytest
import torch

MARKS = pytest.StashKey[dict[str, frozenset[str]]]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the marks of all tests that were collected, before `-m` removes some."""
    config.stash[MARKS] = {item.nodeid: frozenset(mark.name for mark in item.iter_markers()) for item in items}


@pytest.fixture(scope="session")
def marks(pytestconfig: pytest.Config) -> dict[str, frozenset[str]]:
    """Names of the marks of each collected test."""
    return pytestconfig.stash[MARKS]


@pytest.fixture(autouse=True, scope="session")
def _interrupts() -> None:
    """Let Ctrl-C interrupt where the shell of a background job has switched it off."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real meshes and COLMAP models. Skipped where absent, unless BPNP_REQUIRE_SHARED_DATA is set."""
    root = Path(os.environ.get("BPNP_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        message = f"no data folder at {root}; set BPNP_SHARED_DATA"
        if os.environ.get("BPNP_REQUIRE_SHARED_DATA"):
            pytest.fail(message)
        pytest.skip(message)
    return root
