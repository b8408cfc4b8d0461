"""Wheel and sdist are complete; `make wheel` installs the wheel and uses it outside the checkout."""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[1]
CONFIGS = {str(file.relative_to(ROOT)): file.read_bytes() for file in (ROOT / "configs").rglob("*.yaml")}
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])('../built')"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build sdist and wheel from the files that git tracks, without the checkout's caches."""
    folder = tmp_path_factory.mktemp("distributions")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("needs a git checkout")
    for name in listed.stdout.splitlines():
        copy, file = folder / "source" / name, ROOT / name
        if name.startswith(("bpnp/", "bpnp", "configs/", "pyproject", "README", "LICENSE")) and file.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            if file.is_symlink():
                copy.symlink_to(file.readlink())
            else:
                copy.write_bytes(file.read_bytes())
    found = {}
    for kind in ("sdist", "wheel"):
        (folder / "built").mkdir()
        command = [sys.executable, "-c", BUILD, f"build_{kind}"]
        done = subprocess.run(command, cwd=folder / "source", capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        (made,) = (folder / "built").iterdir()
        found[kind] = made.rename(folder / f"{kind}-{made.name}")
        (folder / "built").rmdir()
    return found


def test_the_wheel_holds_what_is_used_and_no_more(built: dict[str, Path]) -> None:
    names = zipfile.ZipFile(built["wheel"]).namelist()
    for name in (
        "py.typed",
        "__init__.pyi",
        "report/__init__.pyi",
        "weights/procedural-so3.ckpt",
        "report/assets/page.html",
    ):
        assert f"bpnp/{name}" in names
    assert any(name.endswith("LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"bpnp"}


def test_wheel_and_sdist_hold_the_same_configurations_as_the_checkout(built: dict[str, Path]) -> None:
    assert "configs/quickstart.yaml" in CONFIGS
    wheel = zipfile.ZipFile(built["wheel"])
    in_wheel = {name: wheel.read(name) for name in wheel.namelist() if name.endswith(".yaml")}
    assert in_wheel == {f"bpnp/{name}": content for name, content in CONFIGS.items()}
    in_sdist = {}
    with tarfile.open(built["sdist"]) as sdist:
        for member in sdist.getmembers():
            if member.name.endswith(".yaml") and (content := sdist.extractfile(member)) is not None:
                in_sdist[member.name.partition("/")[2]] = content.read()
    assert {name: content for name, content in in_sdist.items() if name.startswith("bpnp/")} == in_wheel
