import contextlib
import inspect
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import docstring_parser
import pytest
from small_data import MESHES, SMALL_NET, write_mesh_tree

from bpnp.cli import COMMANDS, main
from bpnp.files import lock_folder

pytestmark = pytest.mark.slow


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--help"])
    text = capsys.readouterr().out
    listed = [line.split()[0] for line in text.splitlines() if re.match("  \\w", line)]
    assert listed == [*COMMANDS, "fit", "validate", "test", "predict"]
    assert "quickstart" in text
    assert max(map(len, text.splitlines())) <= 80


def write_to_closed_socket() -> None:
    one, other = socket.socketpair()
    other.close()
    with one:
        one.send(b"x")


def test_only_a_closed_standard_output_ends_a_command_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, "solve", write_to_closed_socket)
    monkeypatch.setitem(COMMANDS, "report", lambda: sys.stdout.write("a line") and None)
    read, write = os.pipe()
    with os.fdopen(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        with pytest.raises(BrokenPipeError):
            main(["solve"])
        main(["report"])
        os.close(read)
        with pytest.raises(SystemExit) as stop:
            main(["report"])
        assert stop.value.code == 0


def test_ctrl_c_within_the_import_of_a_library_is_no_error_of_the_library(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """pycolmap replaces the ImportError that pybind11 makes of Ctrl-C."""

    def interrupt() -> None:
        try:
            raise ImportError("initialization failed") from KeyboardInterrupt()
        except ImportError as error:
            raise RuntimeError("Cannot import the C++ backend") from error

    monkeypatch.setitem(COMMANDS, "solve", interrupt)
    with pytest.raises(SystemExit) as stop:
        main(["solve"])
    assert stop.value.code == 130
    assert capsys.readouterr().err == "bpnp: interrupted\n"


@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        ("solver.help=bpnp.models.BPnPNet", "cost (b, m, n) and both masks to the assignment"),
        ("solver.transport.help=bpnp.layers.Sinkhorn", "Weight of the entropy in the objective"),
    ],
)
def test_options_of_the_network_and_its_parts_are_explained(
    part: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["fit", "--model.solver=bpnp.models.BPnPNet", f"--model.{part}"])
    printed = capsys.readouterr().out
    assert sentence in " ".join(printed.split())
    assert len(printed.splitlines()) < 90
    assert "torch.nn" not in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["slove"], "'slove' is not a command; did you mean solve?"),
        (["bogus"], "'bogus' is not a command; try fit"),
        (["prepare", "megadpth", "."], "did you mean megadepth?"),
        (["prepare", "megadepth", ".", "--min_points=3"], "min_points"),
        (["localize", "--veiws=x"], "did you mean --views?"),
        (["fit", *MESHES, "--trainer.max_epoch=3"], "did you mean --trainer.max_epochs?"),
        (["fit"], "missing --data; try: bpnp fit --config quickstart, or bpnp fit --help"),
        (["table"], "missing --data, --methods; try: bpnp table --help"),
        (["solve", "points2d.csv"], "missing points3d; try: bpnp solve --help"),
        (["fit", *MESHES, "--model.learning_rat=3"], "unrecognized arguments: --model.learning_rat"),
        (
            ["fit", *MESHES, "--model.learning_rate=fast"],
            "Expected a <class 'float'>. Got value: fast\n",
        ),
        (["fit", *MESHES, "--data.nonsense=3"], "error: Parser key \"data\": Option 'nonsense' is not accepted\n"),
        (["fit", *MESHES, "--data.num_points=many"], "\"num_points\": Expected a <class 'int'>. Got value: many\n"),
        (["fit", *MESHES, "--data.batch_size=0"], "error: `batch_size` is 0; it must be 1 or more\n"),
        (["fit", *MESHES, "--data.seed=-1"], "error: `seed` is -1; it must be 0 or more\n"),
        (["fit", *MESHES, "--model.learning_rate=-1"], "error: `learning_rate` is -1.0; it must be 0 or more\n"),
        (["fit", *MESHES, "--model.pose_weight=-1"], "error: `pose_weight` is -1.0; it must be 0 or more\n"),
        (
            ["fit", *MESHES, "--trainer.accumulate_grad_batches=0"],
            "error: `accumulate_grad_batches` is 0; it must be 1 or more\n",
        ),
        (["fit", *MESHES, "--trainer.callbacks+=EarlyStopping"], 'Parser key "trainer.callbacks": missing --monitor\n'),
        (["fit", *MESHES, "--model.loss=torch.nn.Nothing"], "'torch.nn' has no attribute 'Nothing' "),
        (["fit", *MESHES, "--data.root=nowhere"], "nowhere is not a folder; a folder with <class>/{train,test}"),
        (
            ["fit", *MESHES, "--config=nowhere.yaml"],
            "'nowhere.yaml' is not a configuration file or the name of a packaged one",
        ),
        (
            ["fit", "--config", "quickstrat"],
            "'quickstrat' is not a configuration file or the name of a packaged one; did you mean quickstart?",
        ),
        (["fit", *MESHES, "--trainer.fast_dev_run=-1"], "fast_dev_run=-1 is not a valid configuration"),
        (["test", *MESHES, "--ckpt_path=nothing.ckpt"], "nothing.ckpt"),
        (["report", "nowhere"], "nowhere does not exist; give a folder that `bpnp test`"),
        (["help", "slove"], "'slove' is not a command; did you mean solve?"),
        (["table", "--data=quickstart", "--methods=search", "--limit=-1"], "--limit is -1; it must be 1 or more"),
        (
            ["view", "nowhere"],
            "nowhere does not exist; give the folder of a test or the JSON of a solution",
        ),
        (["view", __file__], "test_cli.py: this is not the JSON of a solution: Expecting value"),
        (["view", __file__, "3"], "is one solution, which has no problem '3'"),
        (
            ["report", "nowhere", "--paper", "modelnet"],
            "--paper is 'modelnet'; one of 'modelnet40', 'megadepth' is needed\n",
        ),
    ],
)
def test_a_users_mistake_is_one_clear_error(
    arguments: list[str], message: str, fails: Callable[..., str], tmp_path: Path
) -> None:
    if arguments[:1] in (["fit"], ["test"]) and len(arguments) > 1:
        arguments = [*arguments, f"--trainer.default_root_dir={tmp_path}", f"--data.cache_dir={tmp_path}"]
    assert message in fails(*arguments)


def test_a_closed_pipe_is_no_error() -> None:
    """The pipe is closed as in `bpnp --help | head -1`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "bpnp", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    _, error = process.communicate(timeout=60)
    assert error == ""
    assert process.returncode == 0


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--version", "-V"):
        main([option])
        assert capsys.readouterr().out == f"bpnp {version('bpnp')}\n"


@pytest.mark.parametrize("words", [[], ["solve"], ["prepare"], ["prepare", "megadepth"], ["fit"], ["test"]])
def test_help_is_a_command_too(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for arguments in ([*words, "--help"], ["help", *words]):
        with contextlib.suppress(SystemExit):
            main(arguments)
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1] != ""


def test_verbose_adds_the_traceback_of_a_mistake(capsys: pytest.CaptureFixture[str], fails: Callable[..., str]) -> None:
    short = fails("localize", "nowhere", "a.jpg", "--focal_error", "7")
    assert short == "bpnp: error: --focal_error is 7.0; it is a fraction of the focal length, above 0 and below 1\n"
    for words in (["--verbose", "localize"], ["localize", "--verbose"]):
        with pytest.raises(SystemExit) as stop:
            main([*words, "nowhere", "a.jpg", "--focal_error", "7"])
        assert stop.value.code == 2
        long = capsys.readouterr().err
        assert long.startswith("Traceback")
        assert long.endswith(short)


@pytest.mark.parametrize("name", [*COMMANDS, "prepare megadepth"])
def test_help_explains_every_option(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.suppress(SystemExit):
        main([*name.split(), "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: bpnp {name}")
    command = COMMANDS.get(name)
    if callable(command):
        options = [p.name for p in inspect.signature(command).parameters.values() if p.name != "overrides"]
        documented = {parameter.arg_name for parameter in docstring_parser.parse(command.__doc__ or "").params}
        assert documented == set(options)
        assert all(option in text for option in options)


def test_a_printed_configuration_and_that_of_a_run_can_be_used_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = f"--trainer.default_root_dir={tmp_path}/run"
    small = ["--data.train_problems=2", "--data.train_shapes=2", "--data.val_shapes=2", f"--data.cache_dir={tmp_path}"]
    with contextlib.suppress(SystemExit):
        main(
            [
                "fit",
                "--config=quickstart",
                *small,
                root,
                "--trainer.max_epochs=1",
                "--pose_loss.start_epoch=0",
                "--print_config",
            ]
        )
    printed = tmp_path / "printed.yaml"
    printed.write_text(capsys.readouterr().out)
    main(["fit", f"--config={printed}", "--trainer.limit_train_batches=1", "--trainer.limit_val_batches=1"])
    (kept,) = (tmp_path / "run").rglob("config.yaml")
    copy = tmp_path / "again.yaml"
    copy.write_text(kept.read_text())
    main(["fit", f"--config={copy}", f"--trainer.default_root_dir={tmp_path}/again"])
    assert (tmp_path / "again" / "checkpoints" / "last.ckpt").is_file()


def test_another_script_named_lightning_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["fit", "--help"])
    assert capsys.readouterr().err == ""
    (tmp_path / "lightning_sdk.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    main(["fit", "--help"])
    assert capsys.readouterr().err.startswith("bpnp: lightning-sdk is installed, which has a script named `lightning`")


def test_a_fit_in_a_folder_in_use_is_refused(tmp_path: Path, fails: Callable[..., str]) -> None:
    arguments = ["fit", *MESHES, f"--trainer.default_root_dir={tmp_path}", f"--data.cache_dir={tmp_path}"]
    with lock_folder(tmp_path):
        assert "another process writes to" in fails(*arguments)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("model:\n  learning_rat: 1.0e-4\ndata: bpnp.datamodules.MeshDataModule\n", "learning_rat"),
        ("", ".*wrong.yaml has no options such as `model:` and `data:`; its content is None"),
        ("model: [1", ".*wrong.yaml is not YAML: while parsing a flow sequence"),
    ],
)
def test_a_broken_configuration_is_named(content: str, message: str, fails: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text(content)
    assert re.search(message, fails("fit", f"--config={tmp_path}/wrong.yaml"))


def test_training_test_and_report_work_in_sequence(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    fails: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    meshes = write_mesh_tree(tmp_path / "meshes")
    common = [
        *MESHES,
        *SMALL_NET,
        f"--data.root={meshes}",
        f"--data.cache_dir={tmp_path}/cache",
        f"--trainer.default_root_dir={tmp_path}/run",
        "--data.val_fraction=0.3",
    ]
    main(["fit", *common, "--trainer.max_epochs=1"])
    assert {p.name for p in (tmp_path / "run" / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    assert {p.name for p in (tmp_path / "run").iterdir()} == {"checkpoints", "logs"}
    logs = list((tmp_path / "run").rglob("metrics.csv"))
    assert "val/ransac/rotation_q2_deg" in logs[0].read_text().splitlines()[0]
    monkeypatch.setenv("FORCE_COLOR", "1")  # for a terminal
    monkeypatch.setenv("TERM", "xterm")
    main(["test", *common, "--ckpt_path=last"])
    assert "━" in capsys.readouterr().out
    caplog.set_level("INFO")
    main(["test", *common, f"--ckpt_path={tmp_path}/run/checkpoints/best.ckpt", "--trainer.enable_progress_bar=false"])
    assert f"the results of {tmp_path}/run/checkpoints/last.ckpt in {tmp_path}/run/test are replaced" in caplog.messages
    assert "━" not in capsys.readouterr().out
    trained = (tmp_path / "run" / "test" / "summary.json").read_bytes()
    assert "best.ckpt, which a test without --ckpt_path would replace; use --ckpt_path last" in fails("test", *common)
    assert (tmp_path / "run" / "test" / "summary.json").read_bytes() == trained
    main(["test", *common, f"--results.folder={tmp_path}/run/untrained"])
    assert (tmp_path / "run" / "untrained" / "summary.json").is_file()
    capsys.readouterr()
    main(["report", f"{tmp_path}/run/test", "--paper=modelnet40"])
    table = capsys.readouterr().out
    assert "ransac" in table
    assert "pnp" in table


def test_a_warning_is_one_line() -> None:
    code = "import warnings; from bpnp import cli; cli._run = lambda *_, **__: warnings.warn('two\\nlines'); cli.main()"
    shown = subprocess.run([sys.executable, "-c", code, "solve"], capture_output=True, text=True, check=True)
    assert (shown.stdout, shown.stderr) == ("", "bpnp: warning: two lines\n")


@pytest.mark.nightly
def test_a_test_of_other_weights_or_data_says_what_it_replaces(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    common = [*MESHES, f"--data.cache_dir={tmp_path}", f"--trainer.default_root_dir={tmp_path}/run"]
    common += ["--trainer.enable_progress_bar=false", "--trainer.limit_test_batches=1"]
    weights = "--model.weights=procedural-so3"
    main(["test", *common, weights])
    main(["test", *common, weights])
    assert "are replaced" not in caplog.text
    main(["test", *common, weights, "--data.seed=3"])
    assert "the results of procedural-so3 with other options of the data in" in caplog.text
    main(["test", *common, "--model.weights=paper-lc"])
    assert caplog.text.count("are replaced") == 2
    assert f"the results of procedural-so3 in {tmp_path}/run/test are replaced" in caplog.messages
    settings = json.loads((tmp_path / "run" / "test" / "summary.json").read_bytes())["settings"]
    assert (settings["checkpoint"], settings["weights"]) == (None, "paper-lc")
    main(["test", *common])
    assert f"the results of paper-lc in {tmp_path}/run/test are replaced" in caplog.messages


def test_a_data_set_is_prepared_with_one_process_for_each_cpu_of_a_cluster_job() -> None:
    code = (
        "import os\n"
        "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "os.cpu_count = lambda: 128\n"
        "from bpnp.commands.preparing import PROCESSES\n"
        "print(PROCESSES)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.split() == ["1"]
