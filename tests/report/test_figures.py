from pathlib import Path

import numpy as np
import pytest
from report_data import HOSTILE, drawn_problem, write_run

from bpnp.report.figures import plot_problem, recall_curve, save_figure


def points_of(axes: object, marker: str) -> np.ndarray:
    (line,) = (found for found in axes.get_lines() if found.get_marker() == marker and len(found.get_xdata()))  # type: ignore[attr-defined]
    return np.c_[line.get_data()]


def test_recall_curves_are_the_shares_of_pairs_within(tmp_path: Path) -> None:
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


def test_the_true_pose_reprojects_each_point_onto_its_match() -> None:
    planted = drawn_problem(3, "<b>$x_1$</b>")
    figure = plot_problem(planted)
    seen, projected = (points_of(figure.axes[1], marker) for marker in ("o", "x"))
    np.testing.assert_allclose(seen, planted.points2d)
    np.testing.assert_allclose(projected, planted.points2d, atol=1e-5)
    top, bottom = figure.axes[1].get_ylim()
    assert top > bottom
    with pytest.raises(ValueError, match=r"expected an estimate among \['ransac', 'pnp'\], got 'best'"):
        plot_problem(planted, estimate="best")
    assert figure.axes[1].get_title() == "reprojected by ransac"
    assert plot_problem(planted, estimate="pnp").axes[1].get_title() == "no pose"


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_figures_are_written_whole(tmp_path: Path, suffix: str) -> None:
    path = save_figure(plot_problem(drawn_problem(0, HOSTILE)), tmp_path / "new" / f"pair{suffix}")
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    heads = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    assert path.read_bytes().startswith(heads[suffix])
    with pytest.raises(ValueError, match=r"expected a file name that ends in .png, .svg, .pdf, got 'pair.jpg'"):
        save_figure(plot_problem(drawn_problem(0, "")), tmp_path / "pair.jpg")
