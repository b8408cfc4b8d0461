"""`bpnp solve` on planted problems: files in, JSON, table and picture out; a mistake is one line."""

import io
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from planted import plant
from rich.console import Console

import bpnp
from bpnp import Solution
from bpnp.cli import main
from bpnp.commands.solving import solution_table
from bpnp.examples import load

PLANTED = plant(1, 40, seed=2)
X, P = PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy()
UP = ["--up_camera", "0", "-1", "0", "--up_scene", "0", "0", "1"]
CAMERA = ["--camera", "SIMPLE_PINHOLE,800,320,240"]


def write(folder: Path, points2d: np.ndarray = X, points3d: np.ndarray = P) -> list[str]:
    np.savetxt(folder / "x.csv", points2d, delimiter=",", header="x,y", comments="")
    np.save(folder / "p.npy", points3d)
    return [str(folder / "x.csv"), str(folder / "p.npy")]


def test_solve_writes_the_pose_the_json_and_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write(tmp_path, 800 * X + [320, 240])
    output, picture = tmp_path / "out" / "result.json", tmp_path / "out" / "result.png"
    main(["solve", *files, *CAMERA, "--output", str(output), "--picture", str(picture)])
    shown = capsys.readouterr().out
    assert "confident" in shown
    assert "40 of 40 (100.0 %)" in shown
    solution = Solution.from_json(output)
    np.testing.assert_allclose(solution.rotation, PLANTED.rotation[0], atol=1e-8)
    np.testing.assert_allclose(solution.translation, PLANTED.translation[0], atol=1e-8)
    assert solution.unit == "px"
    assert Image.open(picture).size[0] > 500
    main(["view", str(output), "--output", str(tmp_path / "view.png")])
    assert (tmp_path / "view.png").stat().st_size > 5000


def test_json_is_all_that_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["solve", *write(tmp_path), "--json", "--seed", "3", "--inlier_threshold", "0.01", "--time_limit", "60"])
    content = json.loads(capsys.readouterr().out)
    assert content["verdict"] == "confident"
    assert content["inlier_threshold"] == 0.01
    assert len(content["matches"]) == 40
    np.testing.assert_allclose(content["centre"], -PLANTED.rotation[0].mT @ PLANTED.translation[0], atol=1e-8)


def test_options_and_columns_reach_the_search_as_they_are_written(tmp_path: Path) -> None:
    """Pass all options to `solve`; their effects are tested in tests/search/test_options.py."""
    rng = np.random.default_rng(9)
    sides = np.column_stack([P, np.tile([0.0, 0, 1], (40, 1)), rng.integers(0, 2, 40)])
    colours, scores = np.empty((40, 1)), rng.uniform(0.1, 1, (40, 2))
    colours[PLANTED.match3d[0].numpy(), 0] = sides[:, 6]
    image = np.hstack([X, colours, scores[:, :1]])
    np.savetxt(tmp_path / "x.csv", image, delimiter=",", header="x,y,label,score", comments="")
    scene = np.hstack([sides, scores[:, 1:]])
    np.savetxt(tmp_path / "p.csv", scene, delimiter=",", header="x,y,z,nx,ny,nz,label,score", comments="")

    solution, rough = bpnp.solve(X, P), tmp_path / "rough.json"
    pose = np.diag([1.0, -1, -1]).tolist(), [1.0, 2.0, 3.0]
    rough.write_text(json.dumps(dict(zip(("rotation", "translation"), pose, strict=True))))
    asked = list[dict[str, Any]]()
    with pytest.MonkeyPatch.context() as patch:

        def noted(*points: Any, **options: Any) -> Solution:
            asked.append(options)
            return solution

        patch.setattr("bpnp.search.api.solve", noted)
        words = "--clutter 0.25 --seed 7 --solver search --time_limit 3 --inlier_threshold 0.1 --focal_error 0.2"
        words += f" --distortion --device cpu --prior {rough} --prior-degrees 6 --prior_distance 0.5"
        files = [str(tmp_path / "x.csv"), str(tmp_path / "p.csv")]
        main(["solve", *files, *words.split()])
        main(["solve", *files, *UP, "--up-degrees", "7", "--time-limit", "inf"])
        main(["solve", *files, *UP, "--up-degrees", "7", "--time_limit=inf"])
    options, upright, endless = asked
    assert upright["time_limit"] == endless["time_limit"] == math.inf
    np.testing.assert_array_equal(options["normals3d"], sides[:, 3:6])
    np.testing.assert_array_equal(options["labels3d"], sides[:, 6])
    np.testing.assert_array_equal(options["labels2d"], colours[:, 0])
    np.testing.assert_array_equal(np.stack([options["scores2d"], options["scores3d"]], 1), scores)
    prior = options["prior"]
    assert (np.array(prior.rotation).tolist(), np.array(prior.translation).tolist()) == pose
    assert (prior.rotation_sigma_deg, prior.translation_sigma) == (6, 0.5)
    assert [np.array(known).tolist() for known in upright["prior"]] == [[0, -1, 0], [0, 0, 1], 7]
    expected = {"clutter": 0.25, "seed": 7, "solver": "search", "time_limit": 3.0, "inlier_threshold": 0.1}
    expected |= {"focal_error": 0.2, "distortion": True, "device": "cpu"}
    assert {name: options[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda files: [*files, "--up_camera", "0", "-1", "x", "--up_scene", "0", "0", "1"],
            "word 3 of --up_camera is 'x'; a number is needed",
        ),
        (lambda files: files[::-1], "are the two files swapped?"),
        (lambda files: [files[0], "nowhere.npy"], "there is no file nowhere.npy"),
        (lambda files: [*files, *CAMERA], "look normalised"),
        (lambda files: [*files, "--camera", "PINHOLE,1"], "a PINHOLE camera has 4 parameters, not"),
        (lambda files: [*files, "--camera", "nonsense"], "--camera 'nonsense' is neither a file with a 3x3 matrix"),
        (lambda files: [*files, "--solver", "nothing.ckpt"], "nothing.ckpt"),
        (lambda files: [*files, "--prior", "nothing.json"], "nothing.json"),
        (lambda files: [*files, *UP[:4]], "give --up_camera and --up_scene together"),
        (lambda files: [*files, *UP[:4], *["--up_scene", "0", "0", "0"]], "--up_scene is 0 0 0; give a direction"),
        (lambda files: [*files, *UP, "--up_degrees", "0"], "error: --up_degrees is 0.0; it must be a positive number"),
        (lambda files: [*files, "--camera", "nope.csv"], "error: there is no file nope.csv, which --camera names\n"),
        (
            lambda files: [*files, *CAMERA, "--image_size", "640,480"],
            "error: --camera and --image_size exclude each other: --image_size is for an unknown focal length. For one "
            "that is known to a tenth give --camera and --focal_error 0.1\n",
        ),
        (lambda files: [*files, "--focal_error", "0.1"], "error: --focal_error needs the --camera whose focal length"),
        (lambda files: [*files, "--distortion"], "error: --distortion needs an --image_size, or a --focal_error with"),
        (lambda files: [*files, "--clutter", "2"], "error: --clutter is 2.0; it is a fraction"),
        (lambda files: [*files, "--solver", "serch"], 'error: --solver is \'serch\'; it is "auto", "search"'),
        (lambda files: [*files, "--seed", "x"], "error: --seed is 'x'; a whole number is needed\n"),
        (lambda files: [*files, *UP, "--prior", "a.json"], "give --prior, or --up_camera with --up_scene, not both"),
        (lambda files: [*files, "--image", "a.jpg"], "--image 'a.jpg' needs a COLMAP model as --camera"),
        (lambda files: [*files, "--photo", "a.jpg"], "--photo needs --picture and --camera"),
        (lambda files: [*files, "--surface", "100"], "--surface draws points from a mesh, and"),
        (lambda files: [*files, "--picture", "a.gif"], "--picture 'a.gif' has to end in .png, .jpg, .jpeg, .svg, .pdf"),
        (lambda files: [*files, "--output", str(Path(files[0]).parent)], " is a folder; give a file name to write to"),
    ],
)
def test_a_mistake_is_one_line(change: Any, message: str, tmp_path: Path, fails: Callable[..., str]) -> None:
    assert message in fails("solve", *change(write(tmp_path)))


def test_pixels_without_a_camera_are_told_the_options(tmp_path: Path, fails: Callable[..., str]) -> None:
    said = fails("solve", *write(tmp_path, 800 * X + [320, 240]))
    assert said.endswith("; they look like pixels; try --camera, or --image_size if the focal length is unknown\n")


def test_the_exit_status_is_the_verdict_with_strict(tmp_path: Path) -> None:
    """Four points never fix a pose alone, and points of an unrelated image fit only by chance."""
    (tmp_path / "few").mkdir()
    (tmp_path / "none").mkdir()
    rng = np.random.default_rng(0)
    few = write(tmp_path / "few", X[PLANTED.match3d[0].argsort()[:4]], P[:4])
    unrelated = write(tmp_path / "none", rng.uniform(-0.3, 0.3, (12, 2)), P[:12])
    main(["solve", *write(tmp_path), "--strict", "--quiet"])
    for files in (few, unrelated):
        main(["solve", *files, "--quiet"])
        with pytest.raises(SystemExit) as stop:
            main(["solve", *files, "--strict", "--quiet", "--output", str(tmp_path / "s.json")])
        assert stop.value.code == 1
        assert Solution.from_json(tmp_path / "s.json").verdict != "confident"


def test_the_camera_in_the_json_has_the_size_of_its_images_or_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write(tmp_path, 800 * X + [320, 240])
    Image.new("RGB", (640, 480)).save(tmp_path / "photo.png")
    with_photo = [*CAMERA, "--photo", str(tmp_path / "photo.png"), "--picture", str(tmp_path / "p.png")]
    sized = ["--camera", "SIMPLE_PINHOLE,1280,960,800,320,240"]
    for options, size in ((CAMERA, (None, None)), (with_photo, (640, 480)), (sized, (1280, 960))):
        main(["solve", *files, *options, "--json"])
        solution = Solution.from_json(text := capsys.readouterr().out)
        camera = json.loads(text)["camera"]
        assert (camera["width"], camera["height"]) == size
        assert solution.focal_length == 800
        assert bpnp.solve(800 * X + [320, 240], P, camera).verdict == "confident"


def test_verbose_prints_the_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    files = write(tmp_path, rng.uniform(-0.3, 0.3, (12, 2)), P[:12])
    main(["solve", *files])
    assert " inliers, log10 NFA " in (printed := capsys.readouterr().out)
    assert "likelihood" not in printed
    main(["solve", *files, "--verbose", "--output", str(tmp_path / "s.json")])
    printed = " ".join(capsys.readouterr().out.split())
    for candidate in Solution.from_json(tmp_path / "s.json").candidates[:4]:
        assert f"log10 NFA {candidate.log10_false_alarms:.1f}, mean log-likelihood {candidate.score:.3f}" in printed


def test_an_unwritable_output_is_refused_before_the_search(
    tmp_path: Path, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bpnp.search.api.solve", None)
    (tmp_path / "file").write_text("")
    assert "file" in fails("solve", *write(tmp_path), "--output", str(tmp_path / "file" / "r.json"))


@pytest.mark.slow
def test_a_colmap_model_is_scene_and_camera_and_the_photo_lies_under_the_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = load("mesh")
    solution = bpnp.solve(example.points2d, example.points3d, example.camera)
    model = solution.to_colmap(tmp_path / "map", camera=example.camera, size=(1280, 960))
    # A detector's rows: x, y, scale, angle.
    np.savetxt(tmp_path / "keypoints.txt", np.c_[example.points2d, np.ones((200, 2))])
    Image.fromarray(np.full((960, 1280, 3), 200, np.uint8)).save(tmp_path / "photo.png")
    for scene, camera in ((model, model), (model / "points3D.txt", model / "cameras.txt")):
        files = [str(tmp_path / "keypoints.txt"), str(scene), "--camera", str(camera)]
        drawn = ["--picture", str(tmp_path / "p.png"), "--photo", str(tmp_path / "photo.png")]
        main(["solve", *files, *drawn, "--colmap", str(tmp_path / "found"), "--output", str(tmp_path / "s.json")])
        found = Solution.from_json(tmp_path / "s.json")
        assert example.rotation_error_deg(found.rotation) < 0.2
        assert (tmp_path / "p.png").stat().st_size > 20_000
        lines = (tmp_path / "found" / "images.txt").read_text().splitlines()
        assert next(line for line in lines if not line.startswith("#")).endswith(" 1 photo.png")
        shutil.rmtree(tmp_path / "found")
    assert "wrote" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--output", "--picture"])
def test_an_input_is_not_overwritten(
    option: str, tmp_path: Path, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bpnp.search.api.solve", None)
    files = write(tmp_path)
    Image.new("RGB", (640, 480)).save(tmp_path / "photo.png")
    replaced = files[0] if option == "--output" else str(tmp_path / "photo.png")
    photo = [] if option == "--output" else ["--photo", replaced, *CAMERA]
    message = fails("solve", *files, *photo, option, replaced)
    assert f"{replaced} is an input and would be overwritten; name another file" in message


def test_a_folder_with_files_is_refused_before_the_search(
    tmp_path: Path, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(["solve", *write(tmp_path), "--colmap", str(tmp_path / "out"), "--quiet"])
    before = (tmp_path / "out/images.txt").read_text()
    monkeypatch.setattr("bpnp.search.api.solve", None)
    message = fails("solve", *write(tmp_path), "--colmap", str(tmp_path / "out"))
    assert message == f"bpnp: error: {tmp_path / 'out'} exists and would be replaced; name a new folder\n"
    assert (tmp_path / "out/images.txt").read_text() == before


def test_quiet_prints_nothing_and_writes_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["solve", *write(tmp_path), "--quiet", "--output", str(tmp_path / "r.json")])
    assert capsys.readouterr() == ("", "")
    main(["verify", *write(tmp_path), str(tmp_path / "r.json"), "--quiet", "--json"])
    printed = capsys.readouterr()
    assert json.loads(printed.out)["verdict"] == "confident"
    assert printed.err == ""


def test_coordinates_have_fixed_decimals_and_the_points_are_counted() -> None:
    """Such as those of UTM, in metres."""
    solution = bpnp.solve(X, P)
    east = replace(solution, rotation=np.eye(3), translation=-np.array([500000.25, 5123456.789, 301.5]))
    normals = {"normals3d": P, "labels2d": None, "labels3d": None}
    console = Console(width=100, record=True)
    console.print(solution_table(east, normals))
    for text in (console.export_text(), repr(east)):
        numbers = {tuple(line.split()[-3:]) for line in text.splitlines()}
        assert ("500000.250", "5123456.789", "301.500") in numbers
        assert ("-500000.250", "-5123456.789", "-301.500") in numbers
        assert "e+" not in text
    console.print(solution_table(east, normals))
    assert "40 image points, 40 scene points with normals" in console.export_text()


@pytest.mark.slow
def test_with_the_size_of_the_image_the_focal_length_is_estimated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = load("mesh")
    files = write(tmp_path, example.points2d, example.points3d)
    main(["solve", *files, "--image_size", "1280,960", "--time_limit", "300", "--solver", "search", "--json"])
    solution = Solution.from_json(capsys.readouterr().out)
    assert example.rotation_error_deg(solution.rotation) < 0.5
    assert solution.focal_length == pytest.approx(example.camera[0, 0], rel=0.05)


def test_two_outputs_in_one_file_are_refused(
    tmp_path: Path, fails: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bpnp.search.api.solve", None)
    same = str(tmp_path / "a.png")
    message = fails("solve", *write(tmp_path), "--output", same, "--picture", str(tmp_path / "." / "a.png"))
    assert f"{same} is the file of two outputs; name another file for one of them" in message


def test_the_next_candidate_has_its_angle_and_its_false_alarms() -> None:
    """Two equal halves: turned by 180 degrees, the object looks the same."""
    half = np.random.default_rng(1).normal(size=(8, 3))
    scene = np.concatenate([half, half * [-1, -1, 1]])
    seen = scene @ PLANTED.rotation[0].numpy().T + [0, 0, 6]
    solution = bpnp.solve(seen[:, :2] / seen[:, 2:], scene, solver="search")
    text = io.StringIO()
    Console(file=text, width=120).print(solution_table(solution))
    other = solution.candidates[1]
    line = f"180 deg away: 16 inliers, log10 NFA {other.log10_false_alarms:.1f}"
    assert line in text.getvalue()
