"""A command as a user starts it: no variable of threads or of this package, another folder, no terminal."""

import os
import subprocess
import sys
from pathlib import Path

OURS = ("OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "BPNP_", "PYTEST_", "COV_", "PYTHON", "THP_")
BPNP = (sys.executable, "-m", "bpnp")


def plain_environment() -> dict[str, str]:
    """Return the environment without variables that change threads, caches or imports."""
    return {name: value for name, value in os.environ.items() if not name.startswith(OURS)}


def run_in(folder: Path, *command: str, environment: dict[str, str] | None = None) -> str:
    """Run a command in a folder without a terminal; return its output, and fail with it unless it succeeds."""
    environment = plain_environment() if environment is None else environment
    done = subprocess.run(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr
