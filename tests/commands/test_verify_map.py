"""`bpnp verify MAP`: of a planted map the one image whose pose is wrong is doubtful, and no other."""

import csv
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from planted_model import PINHOLE, plant_model
from scipy.spatial.transform import Rotation

from bpnp import SceneMap
from bpnp.cli import main
from bpnp.examples import HOUSES_APART, WRONG_IMAGE, draw_map
from bpnp.maps.verified_map import VerifiedView, verify_map

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def houses(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, tuple[np.ndarray, np.ndarray]]]:
    folder = tmp_path_factory.mktemp("maps") / "houses"
    return folder, draw_map(folder)


def test_the_image_at_the_copy_of_its_building_is_the_only_doubtful_one(
    houses: tuple[Path, dict[str, tuple[np.ndarray, np.ndarray]]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth is where the images were drawn from, not what the model says."""
    folder, poses = houses
    model = SceneMap.from_colmap(folder)
    wrong = [
        view.name
        for view in model.views
        if np.linalg.norm(view.centre + poses[view.name][0].T @ poses[view.name][1]) > 1
    ]
    assert wrong == [WRONG_IMAGE]
    page, table = tmp_path / "page.html", tmp_path / "table.csv"
    main(["verify", str(folder), "--page", str(page), "--output", str(table), "--time_limit", "1000"])
    printed = capsys.readouterr().out
    assert "1 of 11 images is doubtful." in printed
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["verdict"] == "confident" for row in rows] == [False, *[True] * 10]
    assert rows[0]["name"] == WRONG_IMAGE
    assert rows[0]["verdict"] == "failed"
    centre = [float(rows[0][f"other_{axis}"]) for axis in "xyz"]
    rotation, translation = poses[WRONG_IMAGE]
    np.testing.assert_allclose(centre, -rotation.T @ translation, atol=0.2)  # where it was taken
    assert f"{WRONG_IMAGE}: A pose {HOUSES_APART:.0f} scene units and 0 deg away" in printed
    first, *others = re.findall(
        r'<th scope="row">(\S+)</th><td class="verdict"><span [^>]*></span>(\w+)', page.read_text()
    )
    assert first == (WRONG_IMAGE, "failed")
    assert dict(others) == dict.fromkeys(set(poses) - {WRONG_IMAGE}, "confident")


@pytest.mark.nightly
def test_json_has_a_record_for_each_image(
    houses: tuple[Path, dict[str, tuple[np.ndarray, np.ndarray]]], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:  # one image is wrong
        main(["verify", str(houses[0]), "--json", "--strict", "--seed", "1", "--time_limit", "1000"])
    assert stop.value.code == 1
    images = json.loads(capsys.readouterr().out)["images"]
    assert sorted(image["name"] for image in images) == sorted(houses[1])
    assert images[0]["name"] == WRONG_IMAGE
    assert images[0]["log10_false_alarms"] < -50  # it fits far better than chance, and yet it is wrong
    assert all(image["points"] > image["matches"] > 50 for image in images)


def test_an_image_is_judged_without_the_points_that_it_made(tmp_path: Path) -> None:
    """A turned view whose own points fit it exactly; no other view sees them."""
    truth = plant_model(tmp_path / "map", camera=PINHOLE, images=5, points=120, seen=80, clutter=10)
    model = pycolmap.Reconstruction(tmp_path / "map")
    rng, turn = np.random.default_rng(9), Rotation.from_euler("y", 8, degrees=True).as_matrix()
    rotation, shift = turn @ truth.rotations[0], truth.translations[0]
    own = rng.uniform(-0.5, 0.5, (60, 3))
    seen = own @ rotation.T + shift
    pixels = 520 * seen[:, :2] / seen[:, 2:] + [400, 300]
    model.add_image_with_trivial_frame(
        pycolmap.Image("turned.jpg", pixels, 1, 6), pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
    )
    for k, point in enumerate(own):
        model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(6, k)]))
    model.write_binary(tmp_path / "map")
    scene = SceneMap.from_colmap(tmp_path / "map")
    verified = verify_map(tmp_path / "map", scene, time_limit=math.inf)
    assert verified[0].name == "turned.jpg"
    assert (verified[0].verdict, [one.verdict for one in verified[1:]]) == ("failed", ["confident"] * 5)
    assert len(scene.points3d) == 180


@pytest.mark.nightly
def test_thousands_of_other_keypoints_do_not_refute_a_pose(tmp_path: Path) -> None:
    """One image at its place and the wrong one get 8,000 keypoints without a point: one in six pixels to each side."""
    draw_map(tmp_path / "drawn")
    pycolmap.Reconstruction(tmp_path / "drawn").write_text(tmp_path / "drawn")
    lines = (tmp_path / "drawn" / "images.txt").read_text().splitlines()
    rng = np.random.default_rng(3)
    for k, line in enumerate(lines):
        if line.endswith(("00.jpg", WRONG_IMAGE)):
            clutter = rng.uniform((0, 0), (640, 480), (8000, 2))
            lines[k + 1] += "".join(f" {x:.2f} {y:.2f} -1" for x, y in clutter)
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "images.txt").write_text("\n".join(lines) + "\n")
    for name in ("cameras", "points3D"):
        shutil.copy(tmp_path / "drawn" / f"{name}.txt", tmp_path / "map")
    verified = {one.name: one for one in verify_map(tmp_path / "map", SceneMap.from_colmap(tmp_path / "map"))}
    assert verified["00.jpg"].verdict == "ambiguous"  # no longer significant, and yet not refuted
    assert "Significant on the matched keypoints alone" in verified["00.jpg"].reason
    assert "not on all 8200 keypoints" in verified["00.jpg"].reason
    assert verified[WRONG_IMAGE].verdict in ("ambiguous", "failed")
    assert {name for name, one in verified.items() if one.doubtful} == {"00.jpg", WRONG_IMAGE}


def test_images_whose_points_hardly_another_one_sees_are_untested(tmp_path: Path) -> None:
    """A map of two images has no point that two others observe."""
    plant_model(tmp_path / "map", camera=PINHOLE, images=2)
    verified = verify_map(tmp_path / "map", SceneMap.from_colmap(tmp_path / "map"))
    assert [one.verdict for one in verified] == ["untested"] * 2
    assert "points that 2 or more views see" in verified[0].reason


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere does not exist; name points2d, points3d and a pose, or the folder of a COLMAP model"),
        (["file.csv"], "file.csv is a file; name points2d, points3d and a pose, or the folder of a COLMAP model"),
        (["empty"], "empty is no COLMAP model (cameras, images and points3D, all .bin or all .txt)"),
        (["scene"], "scene has no COLMAP model, but scene/0 has; try bpnp verify scene/0"),
        (["scene/0", "--output", "out.txt"], "--output is out.txt; name a file that ends in .json or .csv"),
        (["scene/0", "--page", "scene"], "--page is scene; name a file that ends in .html"),
        (["scene/0", "--as_it_is"], "--as_it_is has no effect on the images of a COLMAP model"),
        (["scene/0", "--camera", "PINHOLE,1,1,1,1"], "--camera has no effect on the images of a COLMAP model"),
        (["scene/0", "--time_limit", "0"], "--time_limit is 0"),
        (["file.csv", "file.csv", "--page", "a.html"], "--page needs the folder of a COLMAP model alone"),
    ],
)
def test_a_mistake_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: Callable[..., str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file.csv").write_text("1,2\n")
    Path("empty").mkdir()
    plant_model(Path("scene/0"), camera=PINHOLE)
    assert message in fails("verify", *arguments)


@pytest.mark.parametrize("option", ["--output", "--page"])
def test_an_unwritable_output_is_refused_before_the_work(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: Callable[..., str]
) -> None:
    monkeypatch.setattr("bpnp.maps.verified_map.verify_map", None)
    plant_model(tmp_path / "map", camera=PINHOLE)
    (tmp_path / "file").write_text("")
    output = tmp_path / "file" / ("table.csv" if option == "--output" else "page.html")
    message = fails("verify", str(tmp_path / "map"), option, str(output))
    assert f"{output} cannot be written: File exists; name a file in another folder" in message


def test_the_drawn_map_never_replaces_a_folder(houses: tuple[Path, dict[str, tuple[np.ndarray, np.ndarray]]]) -> None:
    with pytest.raises(ValueError, match=r"houses is not empty; name a new folder"):
        draw_map(houses[0])


def test_a_pipe_gets_a_line_for_each_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant_model(tmp_path, camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    main(["verify", str(tmp_path)])
    lines = [line for line in capsys.readouterr().err.splitlines() if line[1:3] == "/3"]
    assert [line.partition(": ")[0] for line in lines] == [f"{k + 1}/3 photo {k}.jpg" for k in range(3)]
    main(["verify", str(tmp_path), "--quiet"])
    assert capsys.readouterr() == ("", "")


def test_names_that_are_not_utf8_are_written(
    houses: tuple[Path, dict[str, tuple[np.ndarray, np.ndarray]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the folder in the page, and of the images in the table; the verdicts would be lost after the whole search."""

    def untested(folder: Path, scene: SceneMap, **_: object) -> list[VerifiedView]:
        return [VerifiedView(view.name, "untested", "caf\udce9 <b>") for view in scene.views]

    monkeypatch.setattr("bpnp.maps.verified_map.verify_map", untested)
    folder = tmp_path / "caf\udce9"
    shutil.copytree(houses[0], folder)
    page, table = tmp_path / "page.html", tmp_path / "table.csv"
    main(["verify", str(folder), "--page", str(page), "--output", str(table), "--quiet"])
    assert "<h1>Poses of the images of " in page.read_text()
    assert "caf? &lt;b&gt;" in page.read_text()
    assert table.read_bytes().count(b"caf\xe9 <b>") == 11
