import os
import sys
from collections.abc import Iterator
from pathlib import Path

import lightning  # noqa: F401, its log handler keeps the stderr of its first import, which a test would close
import pytest
import torch


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def wandb_session(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A W&B session of the test alone: wandb reads WANDB_MODE once a process, and Lightning's logger sets it."""
    monkeypatch.setenv("WANDB_MODE", "")  # so that it is unset again, whoever sets it
    monkeypatch.delenv("WANDB_MODE")
    _end_wandb_session()
    yield
    _end_wandb_session()


def _end_wandb_session() -> None:
    if "wandb" in sys.modules:
        sys.modules["wandb"].teardown()


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
