from pathlib import Path

import pytest
from small_data import SMALL_MESHES, SMALL_NET, write_mesh_tree

from bpnp.cli import main

MESHES = ["--data=bpnp.datamodules.MeshDataModule", *SMALL_MESHES]


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(command in text for command in ("fit", "validate", "test", "predict", "report"))


@pytest.mark.parametrize(
    ("part", "told"),
    [
        ("solver.help=bpnp.models.BPnPNet", "cost (b, m, n) and both masks to the assignment"),
        ("solver.transport.help=bpnp.layers.Sinkhorn", "entropy weight of the transport"),
    ],
)
def test_options_of_the_network_and_its_parts_are_explained(
    part: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["fit", "--model.solver=bpnp.models.BPnPNet", f"--model.{part}"])
    assert told in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bogus"], "invalid choice: 'bogus'"),
        (["fit"], "required: fit.data"),
        (["fit", *MESHES, "--model.learning_rat=3"], "unrecognized arguments: --model.learning_rat"),
        (["fit", *MESHES, "--model.learning_rate=fast"], "learning_rate"),
        (["fit", *MESHES, "--data.nonsense=3"], "Option 'nonsense' is not accepted"),
        (["fit", *MESHES, "--data.root=nowhere"], "expected a folder with <class>/{train,test}"),
        (["fit", *MESHES, "--config=nowhere.yaml"], "File does not exist"),
        (["fit", *MESHES, "--trainer.fast_dev_run=-1"], "fast_dev_run=-1 is not a valid configuration"),
        (["test", *MESHES, "--ckpt_path=nothing.ckpt"], "nothing.ckpt"),
        (["report", "nowhere"], "expected a results folder"),
    ],
)
def test_a_users_mistake_is_one_clear_error(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if arguments[:1] in (["fit"], ["test"]) and len(arguments) > 1:
        arguments = [*arguments, f"--trainer.default_root_dir={tmp_path}", f"--data.cache_dir={tmp_path}"]
    assert message in fails(arguments, capsys)


def test_an_unknown_key_in_a_file_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = tmp_path / "typo.yaml"
    config.write_text("model:\n  learning_rat: 1.0e-4\ndata: bpnp.datamodules.MeshDataModule\n")
    assert "learning_rat" in fails(["fit", f"--config={config}"], capsys)


def test_a_checkpoint_that_is_none_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(b"no checkpoint")
    root = [f"--trainer.default_root_dir={tmp_path}", f"--data.cache_dir={tmp_path}"]
    assert "broken.ckpt" in fails(["test", *MESHES, *root, *SMALL_NET, f"--ckpt_path={broken}"], capsys)


def test_fit_test_predict_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meshes = write_mesh_tree(tmp_path / "meshes")
    common = [*MESHES, *SMALL_NET, f"--data.root={meshes}", f"--data.cache_dir={tmp_path}/cache",
              f"--trainer.default_root_dir={tmp_path}/run", "--data.val_fraction=0.3"]  # fmt: skip
    main(["fit", *common, "--trainer.max_epochs=1"])
    assert {p.name for p in (tmp_path / "run" / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    logs = list((tmp_path / "run").rglob("metrics.csv"))
    assert "val/rotation_q2_deg" in logs[0].read_text().splitlines()[0]
    main(["test", *common, "--ckpt_path=last"])
    assert "━" in capsys.readouterr().out
    main(
        ["predict", *common, f"--ckpt_path={tmp_path}/run/checkpoints/best.ckpt", "--trainer.enable_progress_bar=false"]
    )
    assert "━" not in capsys.readouterr().out
    assert (tmp_path / "run" / "predict" / "poses.csv").is_file()
    capsys.readouterr()
    main(["report", f"{tmp_path}/run/test", "--paper=modelnet40"])
    table = capsys.readouterr().out
    assert "ransac" in table
    assert "pnp" in table
