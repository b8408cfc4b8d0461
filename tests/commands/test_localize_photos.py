"""`bpnp localize`: photos that are taken out of their map are found again; bad ones do not stop others."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from matplotlib.transforms import BboxBase
from PIL import Image
from planted import degrees_between
from planted_model import HEIGHT, WIDTH, plant_model
from rich.console import Console
from scipy.spatial.transform import Rotation

import bpnp
from bpnp import SceneMap, Solution
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.examples import load
from bpnp.maps import many_photos
from bpnp.maps.photos import photo_files

pytestmark = pytest.mark.slow

CAMERA = "PINHOLE,1379.7,1382.1,760.3,503.4"


@pytest.fixture(scope="module")
def place(shared_data: Path) -> tuple[Path, Path]:
    return shared_data / "colmap/fountain-P11/sparse/0", shared_data / "photos/fountain-P11"


def test_photos_left_out_of_their_map_are_found_and_a_broken_one_is_named(
    place: tuple[Path, Path], tmp_path: Path, fails: Callable[..., str]
) -> None:
    model, photos = place
    folder, output = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    for name in ("0004.jpg", "0006.jpg"):
        shutil.copy(photos / name, folder / name)
    (folder / "0009.jpg").write_text("no photo")
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0004.jpg 0003.jpg\n0004.jpg 0005.jpg\n0006.jpg 0005.jpg\n0006.jpg 0007.jpg\n")
    command = ["localize", str(model), str(folder), "--camera", CAMERA, "--views", str(pairs), "--output", str(output)]
    assert "1 of 3 photos could not be tried, such as 0009.jpg" in fails(*command, "--leave-one-out")

    scene = SceneMap.from_colmap(model)
    lines = [line.split() for line in (output / "poses.txt").read_text().splitlines() if not line.startswith("#")]
    assert [line[0] for line in lines] == ["0004.jpg", "0006.jpg"]
    for name, *numbers in lines:
        w, x, y, z, *translation = map(float, numbers)
        (view,) = scene.named([name])
        rotation = Rotation.from_quat([x, y, z, w])
        assert (rotation * Rotation.from_matrix(view.rotation).inv()).magnitude() < np.radians(1)
        centre = -rotation.as_matrix().T @ translation
        assert (
            np.linalg.norm(centre - view.centre)
            < 0.05 * np.linalg.norm(scene.points3d[view.points] - centre, axis=1).min()
        )
        solution = Solution.from_json(output / "solutions" / f"{name}.json")
        assert solution.view in ("0003.jpg", "0005.jpg", "0007.jpg")
        assert set(solution.matched_point_ids.tolist()) <= set(scene.point_ids.tolist())
        assert (output / "pictures" / f"{name}.png").stat().st_size > 20000
        error = json.loads((output / "results.json").read_text())["photos"][name]["error_to_map"]
        angle = (rotation * Rotation.from_matrix(view.rotation).inv()).magnitude()
        assert error["rotation_deg"] == pytest.approx(np.degrees(angle), rel=1e-3)
        assert error["centre"] == pytest.approx(np.linalg.norm(centre - view.centre), rel=1e-3)

    before = (output / "solutions/0004.jpg.json").stat().st_mtime_ns
    fails(*command, "--leave-one-out")
    assert (output / "solutions/0004.jpg.json").stat().st_mtime_ns == before
    # A photo whose file is no photo any more keeps no pose.
    (folder / "0004.jpg").write_text("no photo")
    assert "2 of 3 photos could not be tried" in fails(*command, "--leave-one-out")
    assert [line.split()[0] for line in (output / "poses.txt").read_text().splitlines()[1:]] == ["0006.jpg"]


def test_bad_input_is_one_clear_error(place: tuple[Path, Path], tmp_path: Path, fails: Callable[..., str]) -> None:
    model, photos = place
    out = ("--output", str(tmp_path / "out"))
    assert "missing map, photos" in fails("localize")
    assert "missing photos" in fails("localize", str(model), *out)
    assert "a.jpg does not exist; give a photo" in fails("localize", str(model), "a.jpg", *out)
    Image.new("RGB", (64, 48)).save(tmp_path / "plain.jpg")
    plain = ("localize", str(model), str(tmp_path / "plain.jpg"))
    # What no photo can be localised with is said once, before the first photo.
    for wrong_arguments, message in (
        (("--camera", "PINHOLE,1"), "a PINHOLE camera has 4 parameters, not [1.0]"),
        (("--keypoints", "nothing.h5"), "--keypoints nothing.h5 does not exist; give"),
        (("--solver", "nothing"), "name of packaged weights"),
        (("--model", str(model)), "nrecognized arguments: --model"),
        (("--time_limit", "-1"), "--time_limit is -1.0; it must be a positive number"),
        (("--views", "nothing.txt"), "--views needs a text file of lines `photo view`"),
        (("--output", str(tmp_path / "plain.jpg")), ": it is a file, or lies in one"),
    ):
        error = fails(*plain, *out, *wrong_arguments)
        assert message in error
        assert "could not be tried" not in error
        assert not (tmp_path / "out").exists()
    for swapped in (tmp_path / "plain.jpg", photos):
        error = fails("localize", str(swapped), str(model), *out)
        assert error.rstrip().endswith(f"MAP {swapped} is no folder of a COLMAP model; are MAP and PHOTO swapped?")
    assert f"MAP {plain[2]} is no folder of a COLMAP model\n" in fails("localize", plain[2], plain[2], *out)
    error = fails(*plain, *out)
    assert "no keypoints were found in" in error
    assert "no camera of the map fits" in fails(*plain, "--camera", str(model), *out)
    for size, parameters in (("128 x 96", "128,96,80,64,48"), ("64 x 36", "64,36,80,32,18")):
        error = fails(*plain, "--camera", f"SIMPLE_PINHOLE,{parameters}", *out)
        assert f"plain.jpg has 64 x 48 pixels, but its camera {size}" in error
    pairs = tmp_path / "pairs.txt"
    known = ("--camera", CAMERA, "--views", str(pairs), "--output", str(tmp_path / "views"))
    for line, message in (
        ("0004.jpg nowhere.jpg", "the map has no views nowhere.jpg"),
        ("0005.jpg 0003.jpg", "the file of views names no view for 0004.jpg"),
    ):
        pairs.write_text(f"{line}\n")
        assert message in fails("localize", str(model), str(photos / "0004.jpg"), *known)
    assert json.loads((tmp_path / "views/results.json").read_text())["photos"] == {}


def test_photos_in_folders_within_are_named_by_their_path_and_results_are_no_photos(tmp_path: Path) -> None:
    for name in ("day/0004.jpg", "night/0004.jpg", "pictures/0005.jpg", "solutions/views/0005.png"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    results = [tmp_path / "pictures", tmp_path / "solutions"]
    assert list(photo_files([tmp_path], besides=results)) == ["day/0004.jpg", "night/0004.jpg"]
    picture = tmp_path / "pictures/0005.jpg"  # by itself it is a photo, wherever it lies
    assert photo_files([picture], besides=results) == {"0005.jpg": picture}
    with pytest.raises(ValueError, match=r"there are no photos outside .*pictures and .*solutions; give"):
        photo_files([tmp_path / "pictures"], besides=results)


def test_photos_in_linked_folders_are_found(tmp_path: Path) -> None:
    for name in ("photos/0004.jpg", "elsewhere/0005.jpg", "photos/folder.jpg/notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "photos/day").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere/back").symlink_to(tmp_path / "photos")
    assert list(photo_files([tmp_path / "photos"])) == ["0004.jpg", "day/0005.jpg"]


@pytest.fixture(scope="module")
def mesh_solution() -> bpnp.Solution:
    example = load("mesh")
    return bpnp.solve(example.points2d, example.points3d, example.camera)


@pytest.fixture
def command(tmp_path: Path, mesh_solution: bpnp.Solution, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """`bpnp localize` of a.png, with the same solution for every photo."""
    plant_model(tmp_path / "map")
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png")
    monkeypatch.setattr(SceneMap, "localize_photo", lambda *_, **__: mesh_solution)
    monkeypatch.chdir(tmp_path)
    return ["localize", "map", "a.png", "--camera", "SIMPLE_PINHOLE,80,32,24", "--output", "out"]


@pytest.mark.parametrize("verdict", ["confident", "ambiguous", "failed"])
def test_the_exit_status_is_the_verdict_with_strict(
    verdict: Any, command: list[str], mesh_solution: bpnp.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = replace(mesh_solution, verdict=verdict)
    monkeypatch.setattr(SceneMap, "localize_photo", lambda *_, **__: found)
    main([*command, "--no_pictures", "--quiet"])
    with pytest.raises(SystemExit) if verdict != "confident" else nullcontext() as stop:
        main([*command, "--no_pictures", "--quiet", "--strict"])
    assert stop is None or stop.value.code == 1


def test_a_solution_without_a_picture_is_kept_and_drawn_by_the_next_run(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = Path("out/pictures/a.png")

    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("no room")

    with monkeypatch.context() as broken:
        broken.setattr(many_photos, "localized_picture", fail)
        main(command)
    shown = capsys.readouterr().out
    assert "no picture of a.png: no room\nwrote poses.txt, results.json, solutions/ in out\n" in shown
    assert "a.png" in Path("out/poses.txt").read_text()
    main([*command, "--no_pictures"])
    assert not picture.exists()
    main(command)
    shown = capsys.readouterr().out
    assert "kept 1 of 1 photos" in shown
    assert shown.endswith("wrote poses.txt, results.json, solutions/, pictures/ in out\n")
    drawn = picture.read_bytes()
    main([*command, "--seed", "3"])
    assert "solved again, with other options: a.png" in capsys.readouterr().out
    assert picture.read_bytes() == drawn
    monkeypatch.setattr(SceneMap, "localize_photo", fail)
    with pytest.raises(SystemExit):
        main([*command, "--seed", "4"])
    assert "solved again" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["poses.txt", "results.json"])
def test_a_file_of_another_program_is_not_replaced_by_the_results(
    name: str, command: list[str], fails: Callable[..., str]
) -> None:
    main([*command, "--no_pictures"])
    main([*command, "--no_pictures"])  # the results of a run are replaced by those of the next
    Path("out", name).write_text("a.png 1 0 0 0 0 0 4\n")
    assert f"out/{name} is no result of `bpnp localize` and would be replaced; use" in fails(*command, "--seed", "3")
    assert Path("out", name).read_text() == "a.png 1 0 0 0 0 0 4\n"


def test_a_photo_is_not_replaced_by_its_picture(command: list[str], fails: Callable[..., str]) -> None:
    Path("pictures").mkdir()
    photo = Path("a.png").rename("pictures/a.png")
    before = photo.read_bytes()
    words = ["pictures/a.png" if word == "a.png" else "." if word == "out" else word for word in command]
    assert "pictures/a.png would be replaced by the picture of a result; use another folder" in fails(*words)
    assert photo.read_bytes() == before


def test_a_name_with_spaces_is_read_from_the_line_of_its_pose(tmp_path: Path) -> None:
    name, numbers = " IMG 12 (2).jpg", [1.0, 0.0, 0.0, 0.0, 0.1, -2.0, 3e-5]
    record = dict.fromkeys(many_photos.REPORTED) | {"verdict": "confident", "rotation": np.eye(3).tolist()}
    record |= {"translation": numbers[4:], "made_with": {"map": "m"}}
    many_photos.SolutionFolder(tmp_path, "m", {name: record}).write()
    _, line = (tmp_path / "poses.txt").read_text().splitlines()
    assert [line.rsplit(" ", 7)[0], *map(float, line.rsplit(" ", 7)[1:])] == [name, *numbers]


@pytest.mark.parametrize("name", ["#1.jpg", "a\nb.jpg"])
def test_a_name_that_is_no_line_of_poses_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match=r"^the photo '.*' begins with # or has a line break in its name; rename the"):
        photo_files([tmp_path])


@pytest.mark.parametrize("folder", [True, False])
def test_a_file_name_that_is_not_utf8_is_kept_as_it_is(folder: bool, command: list[str]) -> None:
    name = os.fsdecode(b"caf\xe9.png")
    Path("photos").mkdir()
    Path("a.png").rename(Path("photos", name))
    photo = "photos" if folder else f"photos/{name}"
    main([photo if word == "a.png" else word for word in command] + ["--quiet"])
    assert Path("out/pictures", name).is_file()
    assert b"\ncaf\xe9.png " in Path("out/poses.txt").read_bytes()


def test_ctrl_c_while_a_picture_is_drawn_ends_the_run_and_keeps_the_photo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Matplotlib's C++ code converts boxes by this method and takes any exception in it for a box that is invalid."""
    converted = BboxBase.__array__

    def interrupted(self: BboxBase, *arguments: Any, **options: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return converted(self, *arguments, **options)

    plant_model(tmp_path / "map")
    for name in "ab":
        Image.new("RGB", (64, 48)).save(tmp_path / f"{name}.png")
    example = load("mesh")
    solution = bpnp.solve(example.points2d, example.points3d, example.camera)
    monkeypatch.setattr(SceneMap, "localize_photo", lambda *_, **__: solution)
    monkeypatch.setattr(BboxBase, "__array__", interrupted)
    files = [str(tmp_path / part) for part in ("map", "a.png", "b.png")]
    with pytest.raises(SystemExit) as stop:
        main(["localize", *files, "--camera", "SIMPLE_PINHOLE,80,32,24", "--output", str(tmp_path / "out")])
    assert stop.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1] == "bpnp: interrupted; run it again to continue"
    kept = (path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*.*"))
    assert sorted(map(str, kept)) == ["pictures/a.png", "poses.txt", "results.json", "solutions/a.png.json"]
    assert "a.png" in (tmp_path / "out/poses.txt").read_text()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.nightly
def test_a_rough_focal_length_and_distortion_are_found(tmp_path: Path, fails: Callable[..., str]) -> None:
    pinhole = ("PINHOLE", [520.0, 520.0, WIDTH / 2, HEIGHT / 2])
    truth = plant_model(tmp_path / "map", camera=pinhole, images=2, points=140, seen=90, clutter=0)
    lens = camera_from(("SIMPLE_RADIAL", (520.0, WIDTH / 2, HEIGHT / 2, -0.2)))
    pixels = lens.project(np.c_[truth.points2d[0], np.ones(90)])
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "new.png")
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file["new.png/keypoints"] = pixels - 0.5  # OpenCV's pixels
    command = ["localize", str(tmp_path / "map"), str(tmp_path / "new.png"), "--no_pictures", "--solver", "search"]
    command += ["--camera", f"SIMPLE_PINHOLE,550,{WIDTH / 2},{HEIGHT / 2}", "--output", str(tmp_path / "out")]
    command += ["--keypoints", str(tmp_path / "features.h5")]
    found = []
    for options in ([], ["--focal_error", "0.1"], ["--focal_error", "0.1", "--distortion"]):
        main([*command, *options])
        found.append(Solution.from_json(tmp_path / "out/solutions/new.png.json"))
    assert found[0].focal_length == 550  # a camera that is given is never changed
    for solution in found[1:]:
        assert solution.focal_length == pytest.approx(520, rel=0.01)
        assert degrees_between(solution.rotation, truth.rotations[0]) < 0.1
    assert "--focal_error is 2.0; it is a fraction of the focal length" in fails(*command, "--focal_error", "2")
    assert "--distortion needs" in fails(*command, "--distortion")


HASHES = {k: f"{k}b5d5c3712955042212316173ccf37{k}.jpg" for k in range(3)}


def test_each_photo_has_one_row_of_80_characters() -> None:
    """With the focal length that was found and the error against the map, and names of 36 characters."""
    from bpnp.commands.localizing import _table

    record = {
        "verdict": "confident", "view": HASHES[0], "inlier_count": 1170, "focal_length": 1381.6,
        "focal_length_std": 2.5, "reprojection_error": 0.325, "log10_false_alarms": -1981.0,
        "seconds": 13.8,
        "error_to_map": {"rotation_deg": 0.0213, "centre": 1234.5},
    }  # fmt: skip
    failed = record | {"verdict": "failed", "reprojection_error": None, "log10_false_alarms": None}
    console = Console(width=80, record=True)
    console.print(_table({HASHES[1]: record, HASHES[2]: failed, "a.jpg": record | {"view": "b.jpg"}}, 80))
    text = console.export_text()
    lines = text.splitlines()
    assert len(lines) == 2 + 1 + 3, text
    assert max(map(len, lines)) <= 80
    first, second, third = (line.split() for line in lines[-3:])
    assert (first[0][:4], first[0][-4:], first[2][:4], first[2][-4:]) == ("1b5d", ".jpg", "0b5d", ".jpg")
    assert first[1] == "confident"
    assert first[3:] == ["1170", "1382", "0.325", "0.0213", "1234", "-1981", "13.8"]
    assert second[3:] == ["-", "-", "-", "-", "-", "-", "13.8"]  # the pose is a guess
    assert third[:3] == ["a.jpg", "confident", "b.jpg"]
