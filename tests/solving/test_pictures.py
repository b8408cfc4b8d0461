"""A solution drawn, as a file that is drawn, and as a COLMAP model that pycolmap reads again."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from report_data import drawn_problem

import bpnp
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.examples import load
from bpnp.report import plot_problem
from bpnp.solving.pictures import solution_points
from bpnp.solving.problem import problem_from
from bpnp.solving.solution import Solution, SolutionStats
from bpnp.solving.sources import without_pose

EXAMPLE = load("mesh")
SOLUTION = bpnp.solve(EXAMPLE.points2d, EXAMPLE.points3d, EXAMPLE.camera)
OPENCV = ("OPENCV", (800.0, 810.0, 640.0, 480.0, -0.1, 0.02, 0.001, -0.001))


@pytest.mark.parametrize("camera", [EXAMPLE.camera, OPENCV, None])
def test_pycolmap_reads_a_complete_model(camera: Any, tmp_path: Path) -> None:
    points2d = EXAMPLE.points2d
    if camera is OPENCV:
        lens = pycolmap.Camera(model="OPENCV", params=list(OPENCV[1]))
        rays = np.c_[points2d, np.ones(len(points2d))] @ np.linalg.inv(EXAMPLE.camera).T
        points2d = np.asarray(lens.img_from_cam(rays))
    solution = bpnp.solve(points2d, EXAMPLE.points3d, camera) if camera is OPENCV else SOLUTION
    folder = solution.to_colmap(tmp_path / "model", camera=camera, name="photo.jpg", size=(1280, 960))
    model = pycolmap.Reconstruction(str(folder))
    (image,) = model.images.values()
    np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], solution.rotation, atol=1e-12)
    np.testing.assert_allclose(image.cam_from_world().translation, solution.translation, atol=1e-12)
    assert (image.name, image.num_points3D, model.num_points3D()) == ("photo.jpg", solution.inlier_count, 200)
    matched = {(i, image.points2D[i].point3D_id - 1) for i in range(200) if image.points2D[i].has_point3D()}
    assert matched == set(map(tuple, solution.matches.tolist()))
    if camera is not None:
        np.testing.assert_allclose([p.xy for p in image.points2D], points2d, atol=1e-3)
    for i, j in solution.matches.tolist():
        seen = model.cameras[1].img_from_cam(image.cam_from_world() * model.points3D[j + 1].xyz)
        error = np.linalg.norm(seen - image.points2D[i].xy)
        assert model.points3D[j + 1].error == pytest.approx(error, abs=1e-6)
        assert [(e.image_id, e.point2D_idx) for e in model.points3D[j + 1].track.elements] == [(1, i)]
    again = tmp_path / "binary"
    again.mkdir()
    model.write_binary(str(again))
    assert pycolmap.Reconstruction(str(again)).num_points3D() == 200


def test_a_solution_without_a_pose_cannot_be_exported(tmp_path: Path) -> None:
    problem = problem_from(np.random.default_rng(0).normal(size=(8, 2)), EXAMPLE.points3d, None)
    with pytest.raises(ValueError, match="expected a solution with a pose to export, got none: a reason"):
        without_pose(problem, "a reason", None).to_colmap(tmp_path / "model")
    assert not (tmp_path / "model").exists()


def solved(camera: Any = None) -> Solution:
    """Exact; of 12 points two are matched."""
    planted = drawn_problem(3, "x", 12)
    assert planted.pose is not None
    return Solution(
        rotation=planted.pose[0], translation=planted.pose[1], matches=np.array([[3, 3], [5, 5]]), inlier_count=2,
        inlier_ratio=0.5, reprojection_error=0.0, unit="px", verdict="ambiguous", reason="few", camera=camera,
        stats=SolutionStats(), points2d=planted.points2d.astype(float), points3d=planted.points3d.astype(float),
    )  # fmt: skip


def test_a_solution_is_drawn_with_its_matches_in_pixels_of_its_camera() -> None:
    camera = camera_from(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    for own, unit in ((None, "normalised coordinates"), (camera, "pixels")):
        solution = solved(own)
        figure = plot_problem(solution_points(solution))
        assert figure.get_suptitle() == "ambiguous: 2 matches (50 %), mean error 0 px\nfew"
        axes = figure.axes[1]
        assert axes.get_xlabel() == axes.get_ylabel() == unit
        (segments,) = axes.collections  # one a match, from the image point to the reprojected 3D point
        ends = np.stack(segments.get_segments())
        seen = solution.points2d if own is None else own.project(np.c_[solution.points2d, np.ones(12)])
        np.testing.assert_allclose(ends, np.repeat(seen[[3, 5], None], 2, 1), atol=1e-3)


def test_the_file_of_a_solution_is_drawn_and_broken_ones_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "castle.json"
    path.write_text(solved().to_json())
    main(["view", str(path)])
    assert (tmp_path / "views" / "castle.png").stat().st_size > 5000
    (tmp_path / "pictures").mkdir()
    content = json.loads(path.read_text())
    for text, message in (
        ("", "expected the JSON of a solution in"),
        ('{"images": []}', "the pictures of `bpnp localize` are in"),
        (json.dumps(content | {"points2d": [[1, 2, 3]]}), "expected the JSON of a solution in"),
        (json.dumps(content | {"matches": [[0, 99]]}), "expected `matches` of 12 2D and 12 3D points"),
    ):
        path.write_text(text)
        with pytest.raises(SystemExit):
            main(["view", str(path)])
        shown = " ".join(capsys.readouterr().err.split())
        assert message in shown
        assert "castle.json" in shown
