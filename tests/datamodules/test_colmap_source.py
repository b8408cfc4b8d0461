"""The problems of COLMAP images: exact geometry, clutter that is none, and digits far from the origin."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from planted import seen
from planted_model import plant_model
from scipy.spatial.transform import Rotation

from bpnp.datamodules.augment import Augmentation, augment
from bpnp.datamodules.colmap.module import ColmapSource
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.datamodules.keyed_random import row_keys
from bpnp.datamodules.problem import Problem, ProblemSource
from bpnp.datamodules.store import StoreError


def source(folder: Path, **options) -> ColmapSource:
    if not folder.exists():
        plant_model(folder)
    return ColmapSource([read_reconstruction(folder, name="castle")], **options)


def residuals(problem: Problem) -> np.ndarray:
    """Distance of each match's 3D point, projected, to its 2D point."""
    projected = seen(problem.points3d[: problem.matched], problem.rotation, problem.translation)
    return np.linalg.norm(projected - problem.points2d[: problem.matched], axis=-1)


def test_an_image_is_its_keypoints_and_the_points_it_sees(tmp_path: Path) -> None:
    truth = plant_model(tmp_path / "m")
    problems = source(tmp_path / "m")
    assert isinstance(problems, ProblemSource)
    assert problems.batch(torch.arange(3), 0).ids == tuple(f"castle/photo {i}.jpg" for i in range(3))
    for i in range(3):
        problem = problems.problem(i)
        assert residuals(problem).max() < 1e-6
        np.testing.assert_allclose(problem.rotation, truth.rotations[i], atol=1e-12)
        np.testing.assert_allclose(problem.translation, truth.translations[i], atol=1e-12)
        np.testing.assert_allclose(problem.points3d, truth.points3d[truth.seen[i]], atol=1e-6)
        assert (problem.points2d.dtype, problem.points3d.dtype, problem.focal) == (np.float32, np.float32, 510.0)


@pytest.mark.parametrize(
    ("clutter", "extra2d", "extra3d"), [(0.25, 10, 10), (1.0, 12, 20), (0.0, 0, 0), (float("inf"), 12, 20)]
)
def test_clutter_is_drawn_from_keypoints_and_points_without_a_match(
    clutter: float, extra2d: int, extra3d: int, tmp_path: Path
) -> None:
    """12 keypoints have no point and 20 of the 60 points are not seen: no more can be had."""
    truth = plant_model(tmp_path / "m")
    problems = source(tmp_path / "m", clutter=clutter)
    problem = problems.problem(1)
    assert [len(problem.points2d), len(problem.points3d), problem.matched] == [40 + extra2d, 40 + extra3d, 40]
    assert [int(count[1]) for count in problems.counts] == [40, 40 + extra2d, 40 + extra3d]
    assert residuals(problem).max() < 1e-6
    unseen = np.delete(truth.points3d, truth.seen[1], axis=0).astype(np.float32)
    drawn = {tuple(point) for point in problem.points3d[40:]}
    assert len(drawn) == extra3d
    assert drawn <= {tuple(point) for point in unseen}
    distance = np.linalg.norm(problem.points2d[40:, None] - truth.points2d[1], axis=-1)
    assert extra2d == 0 or distance.min() > 1e-5


def test_a_scene_far_from_its_origin_keeps_its_digits_and_its_frame(tmp_path: Path, caplog) -> None:
    """At 5e6 units float32 steps by half a unit, as large as the scene."""
    truth = plant_model(tmp_path / "m", origin=5e6)
    problems = source(tmp_path / "m")
    assert "3 of 3 images of castle see points that are far" in caplog.text
    index = torch.arange(3)
    turned = augment(problems.batch(index, 0), Augmentation(rotate=True), row_keys(index, 0))
    for i in range(3):
        problem = problems.problem(i)
        assert residuals(problem).max() < 1e-6
        assert np.abs(problem.translation).max() < 10
        np.testing.assert_allclose(
            problem.translation - problem.rotation @ problem.origin, truth.translations[i], atol=1e-8
        )
        rotation, translation, origin = (getattr(turned, f)[i].numpy() for f in ("rotation", "translation", "origin"))
        turn = rotation.T @ truth.rotations[i]
        np.testing.assert_allclose(turn @ problem.origin, origin, rtol=1e-12)
        np.testing.assert_allclose(translation - rotation @ origin, truth.translations[i], atol=1e-8)
        assert np.linalg.norm(turn - np.eye(3)) > 0.1


def test_images_with_too_few_points_are_skipped_and_counted(tmp_path: Path) -> None:
    plant_model(tmp_path / "few", images=2, seen=5)
    plant_model(tmp_path / "many", seen=6)
    scenes = [read_reconstruction(tmp_path / name) for name in ("few", "many")]
    with pytest.warns(UserWarning, match="skipped 2 of 5 problems of few, many: fewer than 6 matches"):
        problems = ColmapSource(scenes, min_points=6)
    assert len(problems.images) == 3
    with pytest.raises(StoreError, match="none of the 5 problems in few, many has 7 or more matches"):
        ColmapSource(scenes, min_points=7)
    with pytest.raises(ValueError, match="`clutter` is -0.1; it must be 0 or more"):
        ColmapSource(scenes, clutter=-0.1)


def test_y_down_turns_a_scene_by_its_other_photos_alone(tmp_path: Path) -> None:
    """The map is turned; the tested photo, which is on its side, does not change the direction."""
    plant_model(tmp_path / "m")
    scene = read_reconstruction(tmp_path / "m", name="castle")
    turn = Rotation.from_euler("zx", [70, 20], degrees=True).as_matrix()
    upright = [Rotation.from_euler("yx", [90 * k, 5], degrees=True).as_matrix() for k in range(3)]
    images = [replace(image, rotation=one @ turn) for image, one in zip(scene.images, upright, strict=True)]
    on_its_side = replace(
        images[0], rotation=Rotation.from_euler("z", 90, degrees=True).as_matrix() @ images[0].rotation
    )
    found = []
    for first in (images[0], on_its_side):
        turned = replace(scene, points3d=scene.points3d @ turn, images=(first, *images[1:]))
        problem = ColmapSource([turned], y_down=True).problem(0)
        plain = ColmapSource([turned]).problem(0)
        in_camera = [p.points3d @ p.rotation.T + p.translation for p in (problem, plain)]
        np.testing.assert_allclose(*in_camera, atol=1e-5)
        found.append(problem.points3d)
    np.testing.assert_allclose(*found, atol=1e-6)
    vertical = ColmapSource([turned], y_down=True).problem(0).rotation @ [0, 1, 0]
    down = on_its_side.rotation @ turn.T @ [0, 1, 0]
    assert np.degrees(np.arccos(vertical @ down)) < 5


def test_y_down_leaves_a_map_without_a_common_direction(tmp_path: Path) -> None:
    plant_model(tmp_path / "m")
    scene = read_reconstruction(tmp_path / "m", name="castle")
    images = (*scene.images, scene.images[0])
    rolled = [Rotation.from_euler("z", 90 * k, degrees=True).as_matrix() for k in range(4)]
    mixed = replace(scene, images=tuple(replace(i, rotation=r) for i, r in zip(images, rolled, strict=True)))
    np.testing.assert_array_equal(ColmapSource([mixed], y_down=True).problem(0).rotation, rolled[0])
    alone = replace(scene, images=scene.images[:1])
    np.testing.assert_array_equal(ColmapSource([alone], y_down=True).problem(0).rotation, scene.images[0].rotation)
