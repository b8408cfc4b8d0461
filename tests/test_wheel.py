"""Wheel, sdist and editable install are complete: each is built, unpacked elsewhere, and used from outside the
checkout."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONFIGS = {str(file.relative_to(ROOT)): file.read_bytes() for file in (ROOT / "configs").rglob("*.yaml")}
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])('../built')"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What setuptools makes of the files that git tracks, so that nothing of the checkout's caches gets in."""
    pytest.importorskip("setuptools", reason="needs setuptools")
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
    for kind in ("sdist", "wheel", "editable"):
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
    for name in ("py.typed", "weights/procedural-so3.ckpt", "report/page/assets/page.html"):
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


def test_an_editable_install_sees_the_configurations_of_the_checkout(built: dict[str, Path], tmp_path: Path) -> None:
    zipfile.ZipFile(built["editable"]).extractall(tmp_path / "site")
    script = f"""
import site, sys
site.addsitedir({str(tmp_path / "site")!r})
sys.path.append({sysconfig.get_paths()["purelib"]!r})
from bpnp.files import config_names, packaged_config
sys.stdout.write(" ".join([packaged_config("quickstart"), *config_names()]))
"""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"PYTHONSAFEPATH": "1"}
    # With the libraries of the site-packages, but without their .pth files, and so their installation of the package.
    command = [sys.executable, "-S", "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    file, *names = done.stdout.split()
    assert file == str(built["editable"].parent / "source/bpnp/configs/quickstart.yaml")
    assert [f"configs/{name}.yaml" for name in names] == sorted(CONFIGS)


def test_it_works_outside_the_checkout(built: dict[str, Path], tmp_path: Path) -> None:
    zipfile.ZipFile(built["wheel"]).extractall(tmp_path / "site")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "PYTHONSAFEPATH": "1"}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done

    where = run("-c", "import bpnp; print(bpnp.__file__); bpnp.BPnPNet.from_pretrained('procedural-so3')").stdout
    assert where.startswith(str(tmp_path / "site"))
    assert run("-m", "bpnp", "--version").stdout.startswith("bpnp 0.")
    by_name = run("-m", "bpnp", "fit", "--config", "quickstart", "--print_config")
    assert "rounds: 8" in by_name.stdout
    assert "is used" not in by_name.stderr
    by_file = run("-m", "bpnp", "fit", "--config", "configs/quickstart.yaml", "--print_config")
    assert by_file.stdout == by_name.stdout
    assert f"the packaged {tmp_path}/site/bpnp/configs/quickstart.yaml is used" in by_file.stderr
