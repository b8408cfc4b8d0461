"""What bash completes after `eval "$(bpnp completion bash)"`."""

import shutil
import subprocess
from pathlib import Path

import pytest

from bpnp.cli import main

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["so"], "solve"),
        (["solve"], "solve"),
        (["solve", "--pri"], "--prior --prior_degrees --prior_distance"),
        (["solve", "--prior", "matcher-s"], "matcher-sfm"),
        (["solve", "--solver", "au"], "auto"),
        (["solve", "points2"], "points2d.csv"),
        (["fit", "--config", "qui"], "quickstart"),
        (["fit", "--trainer.max_e"], "--trainer.max_epochs"),
        (["prepare", "meg"], "megadepth"),
        (["prepare", "megadepth", "--min"], "--min_points"),
        (["test", "--ckpt_path", "procedural-e"], "procedural-euler"),
    ],
)
def test_words_are_completed(
    words: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "points2d.csv").touch()
    main(["completion", "bash"])
    call = f'COMP_WORDS=(bpnp {" ".join(words)}); COMP_CWORD={len(words)}; _bpnp; echo "${{COMPREPLY[*]}}"'
    ask = ["bash", "-c", capsys.readouterr().out + call]
    assert subprocess.run(ask, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip() == expected


def test_zsh_reads_the_completion_of_bash(capsys: pytest.CaptureFixture[str]) -> None:
    main(["completion", "zsh"])
    assert capsys.readouterr().out.startswith("autoload -U +X bashcompinit && bashcompinit\n_bpnp() {")
