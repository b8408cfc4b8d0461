"""Training curves from logs whose values are known: the switch, a run that was resumed, what is drawn."""

import base64
import re
from pathlib import Path

import numpy as np
import pytest
from report_data import rows

from bpnp.cli import main
from bpnp.report import write_results
from bpnp.report.page import page_html
from bpnp.report.tables import lines_of, named_runs, read_runs
from bpnp.report.terminal import DARK, INKS, LIGHT
from bpnp.report.training_curves import lines_of_training, read_curves, switch_step, training_curves
from bpnp.report.training_run import training_folder

HEAD = "epoch,step,train/loss,train/correspondence_loss,train/rotation_loss,train/translation_loss,train/pose_loss"
VALIDATED = ",val/ransac/rotation_q2_deg,val/ransac/translation_q2\n"


def log(run: Path, version: int, steps: range, *, switch: int, level: float) -> None:
    """Losses of `level` / step; the pose loss from a step on; a validation every tenth step."""
    lines = [HEAD + VALIDATED]
    for step in steps:
        posed = f"{level / step},{2 * level / step},{3 * level / step}" if step >= switch else ",,"
        lines.append(f"0,{step},{level / step},{level / step},{posed},,\n")
        if step % 10 == 0:
            lines.append(f"0,{step},,,,,,{100 / step},{1 / step}\n")
    folder = run / "logs" / f"version_{version}"
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text("".join(lines))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """100 steps; the second log goes on from step 50, before the first one ended at 60; version 10 sorts after 2."""
    log(tmp_path, 2, range(1, 61), switch=80, level=1.0)
    log(tmp_path, 10, range(50, 101), switch=80, level=2.0)
    (tmp_path / "logs" / "version_11").mkdir()
    (tmp_path / "logs" / "version_11" / "metrics.csv").write_text("epoch,step,test/found\n0,100,1.0\n")
    return tmp_path


def test_a_resumed_training_is_one_curve(run: Path) -> None:
    curves = read_curves(run)
    assert curves["step"].tolist() == list(range(1, 101))
    expected = np.r_[1 / np.arange(1, 50), 2 / np.arange(50, 101)]
    np.testing.assert_allclose(curves["train/loss"], expected)
    assert curves["val/ransac/rotation_q2_deg"].dropna().tolist() == [100 / step for step in range(10, 101, 10)]


def test_the_switch_is_the_first_step_with_the_pose_loss(run: Path, tmp_path: Path) -> None:
    assert switch_step(read_curves(run)) == 80
    log(tmp_path / "never", 0, range(1, 20), switch=99, level=1.0)
    assert switch_step(read_curves(tmp_path / "never")) is None
    log(tmp_path / "always", 0, range(1, 20), switch=0, level=1.0)
    assert switch_step(read_curves(tmp_path / "always")) is None


def test_the_figure_shows_the_losses_the_validation_and_the_switch(run: Path) -> None:
    losses, rotation, translation = training_curves(run).axes
    labels = losses.get_legend_handles_labels()[1]
    assert labels == ["loss", "$L_c$", "$L_r$, radians", "$L_t$, scene units", "pose loss joins"]
    assert losses.lines[-1].get_xdata() == [80, 80]
    assert rotation.lines[0].get_ydata().tolist() == [100 / step for step in range(10, 101, 10)]
    assert translation.lines[0].get_ydata().tolist() == [1 / step for step in range(10, 101, 10)]


def log_of_two(run: Path) -> None:
    """Log in which the PnP layer stands before RANSAC, in alphabetical order as Lightning writes it."""
    names = [f"val/{name}/{error}" for name in ("pnp", "ransac") for error in ("rotation_q2_deg", "translation_q2")]
    lines = [f"step,train/loss,{','.join(names)}", *(f"{step},0.5,9,0.9,1,0.1" for step in (1, 2, 3))]
    (run / "logs" / "version_0").mkdir(parents=True)
    (run / "logs" / "version_0" / "metrics.csv").write_text("\n".join(lines))


def test_an_estimate_has_one_colour_in_the_training_and_in_the_tables(tmp_path: Path) -> None:
    for name in ("a", "b"):
        log_of_two(tmp_path / name)
        write_results(tmp_path / name / "test", rows(12, seed=1))
    folders, runs = named_runs([tmp_path / "a", tmp_path / "b"]), read_runs([tmp_path / "a", tmp_path / "b"])
    colours = {(line.run, line.estimate): LIGHT[line.colour] for line in lines_of(runs)}
    for name in ("a", "b"):
        lines = lines_of_training((tmp_path / name).absolute(), folders, runs)
        for axes in training_curves(tmp_path / name, lines).axes[1:]:
            drawn = {(name, str(line.get_label())): line.get_color() for line in axes.lines}
            assert drawn == {(name, estimate): colours[name, estimate] for estimate in ("ransac", "pnp")}
    alone = training_curves(tmp_path / "a").axes[1]
    assert {str(line.get_label()): line.get_color() for line in alone.lines} == dict(
        zip(("ransac", "pnp"), LIGHT, strict=False)
    )


def test_the_legends_of_the_training_are_above_its_curves(run: Path) -> None:
    figure = training_curves(run)
    figure.draw_without_rendering()
    for axes in figure.axes:
        legend = axes.get_legend()
        assert legend is not None
        assert legend.get_window_extent().y0 >= axes.get_window_extent().y1


def test_the_picture_of_the_training_has_the_colours_of_both_schemes(run: Path) -> None:
    """Each colour of the light scheme is followed by that of the dark one, and nothing is white."""
    write_results(run / "test", rows(12, seed=1))
    (encoded,) = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page_html([run]))
    svg = base64.b64decode(encoded).decode()
    pairs = set(re.findall(r"light-dark\((#\w+), (#\w+)\)", svg))
    assert {(LIGHT[0], DARK[0]), INKS["text"], INKS["quiet"]} <= pairs <= set(INKS.values())
    rest = re.sub(r"light-dark\([^)]*\)", "", svg)
    assert not [ink for ink in ("#ffffff", "#000000", *LIGHT) if ink in rest]
    assert 'style="color-scheme: light dark"' in svg


@pytest.mark.slow
def test_the_report_draws_the_training_of_a_test(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_results(run / "test", rows(12, seed=1))
    assert training_folder(run / "test") == training_folder(run) == run.absolute()
    main(["report", str(run), "--curves", str(run / "curves.png"), "--html", str(run / "page.html")])
    assert (run / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert 'src="data:image/svg+xml;base64,' in (run / "page.html").read_text()
    printed = capsys.readouterr().out
    assert "Medians and recall with 95 % intervals" in printed


def test_a_validation_after_the_training_changes_no_curve(run: Path) -> None:
    """`bpnp validate` logs to a folder of its own, at step 0."""
    before = read_curves(run)
    (run / "logs" / "version_12").mkdir()
    (run / "logs" / "version_12" / "metrics.csv").write_text("epoch,step,val/correspondence_loss\n0,0,0.5\n")
    assert read_curves(run).equals(before)


def test_a_folder_with_tests_alone_has_no_training(tmp_path: Path) -> None:
    """`bpnp test` logs to a folder of its own too, of the packaged weights for example."""
    (tmp_path / "logs" / "version_0").mkdir(parents=True)
    (tmp_path / "logs" / "version_0" / "metrics.csv").write_text("epoch,step,test/pose_error\n0,0,0.5\n")
    write_results(tmp_path / "test", rows(12, seed=1), settings={"checkpoint": "procedural-so3"})
    assert training_folder(tmp_path) is None
    assert "<h2>Training</h2>" not in page_html([tmp_path])


def test_packaged_weights_have_not_the_training_of_the_folder_that_they_are_tested_in(run: Path) -> None:
    write_results(run / "test", rows(12, seed=1), settings={"checkpoint": "procedural-so3"})
    assert "<h2>Training</h2>" not in page_html([run])
    write_results(run / "test", rows(12, seed=1), settings={"checkpoint": "runs/gone/checkpoints/last.ckpt"})
    assert "<h2>Training</h2>" in page_html([run])


def test_a_training_with_two_tests_is_drawn_once(run: Path) -> None:
    for name in ("before", "after"):
        write_results(run / name, rows(12, seed=1))
    page = page_html([run / "before", run / "after"])
    assert page.count('src="data:image/svg+xml;base64,') == 1
    assert "<figcaption>before, after</figcaption>" in page


def test_a_page_without_a_training_has_no_section_for_it_and_curves_are_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "test", rows(12, seed=1))
    assert "<h2>Training</h2>" not in page_html([tmp_path])
    with pytest.raises(SystemExit):
        main(["report", str(tmp_path), "--curves", str(tmp_path / "curves.png")])
    assert "have no logs of a training; give the folder of a run" in capsys.readouterr().err


def test_the_curves_of_a_training_without_a_test_are_no_error(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["report", str(run), "--curves", str(run / "curves.png")])
    assert (run / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out == f"wrote {run / 'curves.png'}\nthe run has no test yet, so there are no tables\n"
    with pytest.raises(SystemExit):
        main(["report", str(run), "--curves", str(run / "curves.png"), "--html", str(run / "page.html")])
    assert "has no summary.json; run `bpnp test` first" in capsys.readouterr().err
