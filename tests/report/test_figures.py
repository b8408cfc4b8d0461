from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from PIL import Image
from report_data import HOSTILE, drawn_problem, planted, write_run

from bpnp import Pose, Prediction, SolveStats
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.report import write_results
from bpnp.report.figure_files import save_figure
from bpnp.report.figures import plot_photo, plot_problem, recall_curve
from bpnp.report.points import points_from, write_points
from bpnp.report.results import rows_from
from bpnp.report.terminal import DARK, INKS, LIGHT


def points_of(axes: object, marker: str) -> np.ndarray:
    (line,) = (found for found in axes.get_lines() if found.get_marker() == marker and len(found.get_xdata()))  # type: ignore[attr-defined]
    return np.c_[line.get_data()]


def test_recall_curves_are_the_fractions_of_problems_within_each_error(tmp_path: Path) -> None:
    results = write_run(tmp_path, 60, 0)
    figure = recall_curve({"run": results})
    assert [line.get_label() for line in figure.axes[0].get_lines()] == ["ransac", "pnp"]
    for number, estimate in enumerate(("ransac", "pnp")):
        rows = [row for row in results.rows if row.estimate == estimate]
        rotation = np.array([row.rotation_error_deg for row in rows])
        translation = np.array([row.translation_error for row in rows])
        reprojection = np.array([row.reprojection_error_deg for row in rows])
        joint = np.where(translation <= 0.5, rotation, np.inf)
        for axes, errors in zip(
            figure.axes, (rotation, translation, joint, reprojection[~np.isnan(reprojection)]), strict=True
        ):
            x, y = axes.get_lines()[number].get_data()
            assert np.asarray(x)[-1] == axes.get_xlim()[1]
            np.testing.assert_allclose(y, [(errors <= limit).mean() for limit in np.asarray(x)])


def test_recall_curves_show_the_quartiles_that_the_paper_prints(tmp_path: Path) -> None:
    """Table 1: Lc Lp R has 3.33, 8.09 and 15.8 degrees, and 0.04, 0.08 and 0.16."""
    figure = recall_curve({"run": write_run(tmp_path, 9, 0)}, paper="modelnet40")
    for axes, printed in zip(
        figure.axes, ([3.33, 8.09, 15.8], [0.04, 0.08, 0.16], None, [0.28, 0.52, 1.01]), strict=True
    ):
        lines = {str(line.get_label()): line.get_data() for line in axes.get_lines()}
        assert ("paper: Lc Lp R" in lines) == (printed is not None)
        if printed is not None:
            x, y = lines["paper: Lc Lp R"]
            assert (list(np.asarray(x)), list(np.asarray(y))) == (printed, [0.25, 0.5, 0.75])
    assert len(recall_curve({"run": write_run(tmp_path, 9, 0)}).axes[0].get_lines()) == 2


def lab(colours: Iterable[str]) -> np.ndarray:
    """CIE Lab of sRGB colours, white point D65, from the definition (IEC 61966-2-1 and CIE 15)."""
    rgb = np.array([to_rgb(colour) for colour in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    matrix = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    xyz = linear @ np.transpose(matrix) / [0.95047, 1, 1.08883]
    x, y, z = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


@pytest.mark.parametrize(("palette", "scheme"), [(LIGHT, 0), (DARK, 1)])
def test_no_estimate_has_nearly_the_colour_of_another_or_of_the_true_pose(
    palette: tuple[str, ...], scheme: int
) -> None:
    np.testing.assert_allclose(lab(["#ffffff", "#ff0000"]), [[100, 0, 0], [53.24, 80.09, 67.2]], atol=0.02)
    colours = lab([*palette, INKS["text"][scheme]])
    apart = np.linalg.norm(colours[:, None] - colours, axis=-1)
    assert apart[~np.eye(len(colours), dtype=bool)].min() >= 27


def test_the_eighth_camera_of_a_scene_is_not_the_true_one() -> None:
    problem = drawn_problem(3, "eight")
    names = [f"run {i}" for i in range(8)]
    many = replace(problem, estimates=dict.fromkeys(names, problem.estimates["ransac"]))
    (axes,) = (axes for axes in plot_problem(many).axes if axes.name == "3d")
    colours = {str(line.get_label()): line.get_color() for line in axes.get_lines()}
    assert set(colours) == {"true pose", *names}
    apart = np.linalg.norm(lab(colours[name] for name in names) - lab([colours["true pose"]]), axis=-1)
    assert apart.min() >= 27


def test_each_axis_of_a_drawn_problem_has_a_label() -> None:
    scene, image = plot_problem(drawn_problem(3, "labels")).axes
    labels = (scene.get_xlabel(), scene.get_ylabel(), scene.get_zlabel())  # type: ignore[attr-defined]
    assert labels == ("right, scene units", "forward", "up")
    assert (image.get_xlabel(), image.get_ylabel()) == ("normalised coordinates", "normalised coordinates")


def test_the_true_pose_reprojects_each_point_onto_its_match() -> None:
    planted = drawn_problem(3, "<b>$x_1$</b>")
    figure = plot_problem(planted)
    seen, projected = (points_of(figure.axes[1], marker) for marker in ("o", "x"))
    np.testing.assert_allclose(seen, planted.points2d)
    np.testing.assert_allclose(projected, planted.points2d, atol=1e-5)
    top, bottom = figure.axes[1].get_ylim()
    assert top > bottom
    with pytest.raises(ValueError, match=r"there is no estimate 'best'; the estimates are \['ransac', 'pnp'\]"):
        plot_problem(planted, estimate="best")
    assert figure.axes[1].get_title() == "reprojected by ransac"
    assert plot_problem(planted, estimate="pnp").axes[1].get_title() == "no pose"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_figures_are_written_whole(tmp_path: Path, suffix: str) -> None:
    path = save_figure(plot_problem(drawn_problem(0, HOSTILE)), tmp_path / "new" / f"pair{suffix}")
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    heads = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    assert path.read_bytes().startswith(heads[suffix])
    with pytest.raises(ValueError, match=r"the file name 'pair.gif' has to end in .png, .jpg, .jpeg, .svg, .pdf"):
        save_figure(plot_problem(drawn_problem(0, "")), tmp_path / "pair.gif")


def test_a_photo_shows_the_points_where_the_camera_projects_them(tmp_path: Path) -> None:
    """Pixels by hand, K (R p + t) / z, of two estimates; `bpnp view --photo` writes the picture."""
    batch = planted((30,), clutter=4)
    matrix = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])
    stats = SolveStats.of(torch.tensor([True]))
    true = Pose(batch.rotation, batch.translation, stats)
    moved = Pose(batch.rotation, batch.translation + torch.tensor([0.3, 0.0, 0.0]), stats)
    prediction = Prediction(poses={"pnp": true, "search": moved})
    (problem,) = points_from(prediction, batch)
    photo = np.full((480, 640, 3), 200, np.uint8)
    figure = plot_photo(replace(problem, camera=camera_from(matrix)), photo)
    titles = [axes.get_title() for axes in figure.axes]
    assert [title.split(":")[0] for title in titles] == ["pnp", "search"]
    assert titles[1].endswith(" deg, 0.300")  # the translation is moved by 0.3
    for axes, pose in zip(figure.axes, (true, moved), strict=True):
        crosses = next(line for line in axes.lines if line.get_marker() == "x")
        camera = problem.points3d @ pose.rotation[0].numpy().T + pose.translation[0].numpy()
        pixels = (camera / camera[:, 2:]) @ matrix.T
        np.testing.assert_allclose(crosses.get_xydata(), pixels[:, :2], atol=0.6)  # of half a pixel's offset at most
        assert crosses.get_path_effects(), "an edge, since a photo may have the colour of the crosses"
    write_results(tmp_path / "test", rows_from(prediction, batch, 1.0))
    write_points(tmp_path / "test", [problem])
    Image.fromarray(photo).save(tmp_path / "photo.png")
    np.savetxt(tmp_path / "K.txt", matrix)
    arguments = ["--photo", str(tmp_path / "photo.png"), "--output", str(tmp_path / "view.png")]
    main(["view", str(tmp_path), *arguments, "--camera", str(tmp_path / "K.txt")])
    assert (tmp_path / "view.png").stat().st_size > 5000
    with pytest.raises(SystemExit):
        main(["view", str(tmp_path), *arguments])
    before = (tmp_path / "photo.png").read_bytes()
    with pytest.raises(SystemExit):  # the photo would be replaced
        main(["view", str(tmp_path), *arguments[:3], arguments[1], "--camera", str(tmp_path / "K.txt")])
    assert (tmp_path / "photo.png").read_bytes() == before
