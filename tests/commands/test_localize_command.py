"""`bpnp localize` on planted and real COLMAP models: the model's own poses are the answer."""

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from planted_model import plant_model

from bpnp.cli import main
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.localization.from_models import image_source, localize_image, turned_pair


def run(model: Path, output: Path, *more: str) -> list[dict]:
    main(["localize", "--model", str(model), "--output", str(output), *more])
    return json.loads((output / "results.json").read_text())["images"]


@pytest.mark.parametrize("origin", [0.0, 1e5])
def test_every_image_is_where_the_model_has_it(
    origin: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = plant_model(tmp_path / "sparse" / "0", origin=origin)
    found = run(tmp_path / "sparse" / "0", tmp_path / "out")
    for i, image in enumerate(found):
        assert (image["image"], image["verdict"], image["right_matches"]) == (f"photo {i}.jpg", "confident", 1.0)
        np.testing.assert_allclose(image["rotation"], truth.rotations[i], atol=1e-5)
        centre = -np.transpose(image["rotation"]) @ image["translation"]
        np.testing.assert_allclose(centre, -truth.rotations[i].T @ truth.translations[i], atol=1e-4)
        assert image["rotation_error_deg"] < 1e-3
        assert image["centre_error"] < 1e-4
        assert (tmp_path / "out" / "pictures" / f"photo_{i}.jpg.png").stat().st_size > 5000
    shown = capsys.readouterr().out
    assert "3 images: 100.0 % under 1 deg" in shown
    assert "confident and wrong: 0" in shown


def test_images_txt_is_read_by_colmap(tmp_path: Path) -> None:
    """With the model's cameras beside it pycolmap has to find the planted poses; a model inside it is ignored."""
    truth = plant_model(tmp_path / "model", text=True)
    plant_model(tmp_path / "model" / "first", seed=1)
    run(tmp_path / "model", tmp_path / "out", "--no-pictures")
    (tmp_path / "out" / "cameras.txt").write_bytes((tmp_path / "model" / "cameras.txt").read_bytes())
    (tmp_path / "out" / "points3D.txt").write_text("# none\n")
    model = pycolmap.Reconstruction(tmp_path / "out")
    assert model.num_images() == 3
    for image in model.images.values():
        i = image.image_id - 1
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), truth.rotations[i], atol=1e-6)
        np.testing.assert_allclose(image.cam_from_world().translation, truth.translations[i], atol=1e-5)


def test_a_scene_is_its_only_model_and_of_several_one_is_asked_for(tmp_path: Path, fails: Callable[..., str]) -> None:
    truth = plant_model(tmp_path / "scene" / "sparse" / "0")
    image, *_ = run(tmp_path / "scene", tmp_path / "out", "--no-pictures")
    np.testing.assert_allclose(image["rotation"], truth.rotations[0], atol=1e-5)
    plant_model(tmp_path / "scene" / "sparse" / "1")
    error = fails("localize", "--model", f"{tmp_path}/scene", "--output", f"{tmp_path}/out")
    assert f"expected one COLMAP model as --model, got 2 below {tmp_path}/scene; try {tmp_path}/scene/sparse/0" in error


def test_one_image_by_its_name_and_clutter(tmp_path: Path) -> None:
    plant_model(tmp_path / "model", points=120, seen=60, clutter=20)
    (image,) = run(tmp_path / "model", tmp_path / "out", "--no-pictures", "--image", "photo 1.jpg")
    assert (image["count2d"], image["count3d"]) == (60, 60)
    (image,) = run(
        tmp_path / "model", tmp_path / "out", "--no-pictures", "--image", "1.jpg", "--points", "clutter", "--clutter",
        "0.1",
    )  # fmt: skip
    assert (image["count2d"], image["count3d"]) == (66, 66)
    assert image["rotation_error_deg"] < 0.1
    scene = read_reconstruction(tmp_path / "model")
    everything = turned_pair(image_source(scene, "photo 1.jpg", "all", 0.0, 0), 0)
    assert (int(everything.count2d), int(everything.count3d)) == (80, 120)


def test_a_solution_is_in_pixels_of_the_undistorted_photo(tmp_path: Path) -> None:
    truth = plant_model(tmp_path)  # a camera with fx, fy, cx, cy = 520, 500, 405, 290
    solution = localize_image(image_source(read_reconstruction(tmp_path), "photo 1.jpg", "seen", 0.0, 0), 0).solution
    pixels = solution.camera.project(np.column_stack([solution.points2d, np.ones(40)]))
    expected = truth.points2d[1] * [520, 500] + [405, 290]
    np.testing.assert_allclose(sorted(pixels.tolist()), sorted(expected.tolist()), atol=1e-3)


def test_the_scene_is_turned_before_it_is_solved(tmp_path: Path) -> None:
    truth = plant_model(tmp_path)
    poses = [
        turned_pair(image_source(read_reconstruction(tmp_path), "all", "seen", 0.0, seed), 0).rotation[0].numpy()
        for seed in (0, 1)
    ]
    gaps = [np.linalg.norm(a - b) for a, b in ((poses[0], poses[1]), *((pose, truth.rotations[0]) for pose in poses))]
    assert min(gaps) > 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "nowhere"], "nowhere"),
        (
            ["--model", "model", "--image", "photo 9.jpg"],
            "one image of model, got 'photo 9.jpg'; try one of photo 0.jpg",
        ),
        (["--model", "model", "--image", "photo"], "got 'photo'; try one of photo 0.jpg, photo 1.jpg"),
        (["--model", "model", "--points", "clutter", "--clutter", "-1"], "`clutter` of 0 or more"),
        (["--model", "model", "--solver", "nothing.ckpt"], "nothing.ckpt"),
    ],
)
def test_a_mistake_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant_model(tmp_path / "model")
    monkeypatch.chdir(tmp_path)
    assert message in fails("localize", *arguments)


def test_an_interruption_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant_model(tmp_path / "model")
    from bpnp.localization import from_models as command

    solve, calls = command.solve, []

    def interrupted(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return solve(*arguments, **options)

    monkeypatch.setattr(command, "solve", interrupted)
    with pytest.raises(SystemExit) as stop:
        run(tmp_path / "model", tmp_path / "out", "--no-pictures")
    assert stop.value.code == 130
    assert len(json.loads((tmp_path / "out" / "results.json").read_text())["images"]) == 2


def test_a_real_photo(shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = shared_data / "colmap" / "fountain-P11" / "sparse" / "0"
    name = read_reconstruction(scene).images[4].name
    with caplog.at_level(logging.WARNING):
        (image,) = run(scene, tmp_path, "--image", name)
    assert image["verdict"] == "confident"
    assert image["rotation_error_deg"] < 0.05
    assert image["right_matches"] > 0.85
    assert len(list((tmp_path / "pictures").iterdir())) == 1
