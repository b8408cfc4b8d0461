import os
from pathlib import Path

import lightning  # noqa: F401, its log handler keeps the stderr of its first import, which a test would close
import pytest
import torch


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
