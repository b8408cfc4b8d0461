"""The wheel is complete: it is built, unpacked elsewhere, and used from outside the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from what git tracks, so that nothing of the checkout's caches gets in."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("needs a git checkout")
    for name in listed.stdout.splitlines():
        if name.startswith(("bpnp/", "pyproject", "README", "LICENSE")) and (ROOT / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "source" / name).write_bytes((ROOT / name).read_bytes())
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", "."]
    done = subprocess.run([*build, "./source"], cwd=folder, capture_output=True, text=True, check=False)
    if "BackendUnavailable" in done.stderr or "No module named pip" in done.stderr:
        pytest.skip("needs pip and setuptools")
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


def test_it_holds_what_is_used_and_no_more(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    for name in ("py.typed", "configs/quickstart.yaml", "configs/presets/debug.yaml", "weights/procedural-so3.ckpt",
                 "report/page/assets/page.html", "report/page/assets/page.js"):  # fmt: skip
        assert f"bpnp/{name}" in names
    assert any(name.endswith("LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"bpnp"}


def test_it_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "PYTHONSAFEPATH": "1"}

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = run("-c", "import bpnp; print(bpnp.__file__); bpnp.BPnPNet.from_pretrained('procedural-so3')")
    assert where.startswith(str(tmp_path / "site"))
    assert run("-m", "bpnp", "--version").startswith("bpnp 0.")
    assert "rounds: 8" in run("-m", "bpnp", "fit", "--config", "quickstart", "--print_config")
