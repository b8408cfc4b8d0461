"""`bpnp localize` keeps a result in its output folder only if photo, map, views, keypoints and options are unchanged;
the planted poses are the answer."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from planted_model import HEIGHT, PINHOLE, WIDTH, Planted, plant_keypoints, plant_model
from scipy.spatial.transform import Rotation

from bpnp import SceneMap, Solution
from bpnp.cameras import camera_from
from bpnp.cli import main
from bpnp.maps.many_photos import PhotoTask, SolutionFolder, attempt, photo_task

pytestmark = pytest.mark.slow


@dataclass
class Place:
    """A map, photos without content named by the view near which they were taken, and the database of keypoints."""

    folder: Path
    truth: Planted

    def run(self, *photos: str, more: tuple[str, ...] = ()) -> None:
        main(self.command(*photos, more=more))

    def command(self, *photos: str, more: tuple[str, ...] = ()) -> list[str]:
        files = [str(self.folder / photo) for photo in photos]
        keypoints, output = str(self.folder / "database.db"), str(self.folder / "out")
        fixed = ["--keypoints", keypoints, "--output", output, "--no-pictures", "--solver", "search"]
        return ["localize", str(self.folder / "map"), *files, *fixed, *more]

    def poses(self) -> dict[str, np.ndarray]:
        """Rotations of poses.txt by photo."""
        lines = (self.folder / "out/poses.txt").read_text().splitlines()
        rows = [line.split() for line in lines if not line.startswith("#")]
        return {row[0]: Rotation.from_quat(np.roll(np.array(row[1:5], float), -1)).as_matrix() for row in rows}

    def is_right(self, photo: str, view: int) -> bool:
        return bool(np.allclose(self.poses()[photo], self.truth.rotations[view], atol=5e-3))

    def write(self, views: dict[str, int]) -> None:
        """Write the database again: the photo was taken at this view of the map."""
        plant_keypoints(self.folder / "database.db", self.truth, views)


def shot(path: Path, shade: int) -> None:
    Image.new("L", (WIDTH, HEIGHT), shade).save(path)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    truth = plant_model(tmp_path / "map", camera=PINHOLE, images=3, points=140, seen=90, clutter=15)
    made = Place(tmp_path, truth)
    made.write({"a.png": 0, "b.png": 1})
    shot(tmp_path / "a.png", 0)
    shot(tmp_path / "b.png", 1)
    return made


def test_an_unchanged_photo_is_kept_and_reported(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    place.run("a.png", "b.png")
    assert place.is_right("a.png", 0)
    assert place.is_right("b.png", 1)
    file = place.folder / "out/solutions/a.png.json"
    before, poses = file.stat().st_mtime_ns, (place.folder / "out/poses.txt").read_text()
    shown = " ".join(capsys.readouterr().out.split())
    assert "kept 2" not in shown
    # What the columns mean is said, once.
    assert shown.count("error px: mean distance between matched keypoints and their projected points") == 1
    assert shown.count("log10 false: log10 of the number of false alarms") == 1
    place.run("a.png", "b.png")
    assert "kept 2 of 2 photos, solved before with the same content and options" in capsys.readouterr().out
    assert file.stat().st_mtime_ns == before
    file.write_text(file.read_text()[:1000])  # not whole, whatever results.json has of it
    place.run("a.png", "b.png")
    assert "kept 1 of 2 photos" in capsys.readouterr().out
    (place.folder / "out/results.json").unlink()
    place.run("a.png", "b.png")
    assert "kept 2 of 2 photos" in capsys.readouterr().out
    assert (place.folder / "out/poses.txt").read_text() == poses


def overwritten(place: Place) -> dict[str, int]:
    """Move a file over another one, like a camera that writes frame.jpg."""
    shot(place.folder / "a.png", 7)
    return {"a.png": 0}


def taken_elsewhere(place: Place) -> dict[str, int]:
    """Its keypoints were extracted again, too."""
    shot(place.folder / "a.png", 7)
    place.write({"a.png": 2, "b.png": 1})
    return {"a.png": 2, "b.png": 1}


def rebuilt(place: Place) -> dict[str, int]:
    """A map in another frame, in which the other photo's pose means nothing."""
    place.truth = plant_model(place.folder / "map", camera=PINHOLE, images=3, points=140, seen=90, clutter=15, seed=5)
    place.write({"a.png": 0})
    return {"a.png": 0}


@pytest.mark.parametrize(
    ("change", "more", "reason"),
    [
        (overwritten, (), "with another photo: a.png"),
        (taken_elsewhere, (), "with another photo, other keypoints: a.png"),
        (rebuilt, (), "with another map, other keypoints: a.png"),
        (None, ("--seed", "3"), "with other options: a.png"),
    ],
)
def test_a_photo_is_solved_again_where_anything_is_another(
    change: Callable[[Place], dict[str, int]] | None, more: tuple[str, ...], reason: str, place: Place,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    place.run("a.png", "b.png")
    views = {} if change is None else change(place)
    place.run("a.png", more=more)
    shown = capsys.readouterr().out
    assert f"solved again, {reason}" in shown
    assert all(place.is_right(photo, view) for photo, view in views.items())
    assert ("not in poses.txt: 1 solutions in another map, such as b.png" in shown) == (change is rebuilt)
    assert list(place.poses()) == (["a.png"] if change is rebuilt else ["a.png", "b.png"])
    content = json.loads((place.folder / "out/results.json").read_text())["photos"]
    assert content["a.png"]["made_with"]["seed"] == (3 if more else 0)


def test_an_edited_file_of_views_is_another_one_for_the_photos_whose_lines_changed(place: Place) -> None:
    scene = SceneMap.from_colmap(place.folder / "map")

    def task(name: str, *views: str) -> PhotoTask:
        options = {"camera": PINHOLE, "keypoints": place.folder / "database.db", "solver": "search", "seed": 0}
        lines = {"a.png": views, "b.png": ["photo 1.jpg"]}
        return photo_task(scene, name, place.folder / name, map_content="this", views=lines, **options)

    folder = SolutionFolder(place.folder / "out", "this")
    for name in ("a.png", "b.png"):
        solution = attempt(scene, task(name, "photo 2.jpg"))
        assert isinstance(solution, Solution)
        folder.keep(task(name, "photo 2.jpg"), solution)
    again = SolutionFolder(place.folder / "out", "this")
    assert again.changes(task("a.png", "photo 2.jpg")) == []
    assert again.changes(task("a.png", "photo 0.jpg")) == ["views"]
    assert again.changes(task("b.png", "photo 0.jpg")) == []


def test_a_photo_that_is_left_out_of_its_map_does_not_get_its_own_camera(place: Place) -> None:
    """No other view has its size, so that without it nothing is known of its focal length."""
    scene = SceneMap.from_colmap(place.folder / "map")
    own = camera_from(("PINHOLE", 2 * WIDTH, HEIGHT, [700, 700, WIDTH, HEIGHT / 2]))
    scene = replace(scene, views=(replace(scene.views[0], camera=own), *scene.views[1:]))
    photo = place.folder / "photo 0.jpg"
    Image.new("L", (2 * WIDTH, HEIGHT)).save(photo)
    sources = {
        left_out: photo_task(scene, photo.name, photo, leave_one_out=left_out).made_with["camera_from"]
        for left_out in (False, True)
    }
    assert sources == {False: "view photo 0.jpg of the map", True: "unknown focal length"}
    of_the_map = photo_task(scene, photo.name, photo, leave_one_out=True, camera=scene)
    assert of_the_map.arguments["camera"]["params"][0] == 700


@pytest.mark.parametrize(("limit", "kept", "used"), [(None, None, 60.0), (7, 7, 7.0), (math.inf, "none", math.inf)])
def test_the_time_limit_of_a_photo_is_that_of_a_map_unless_given(
    limit: float | None, kept: object, used: float, place: Place
) -> None:
    """`null`, written by earlier runs without a limit, is kept; a file is strict JSON."""
    scene = SceneMap.from_colmap(place.folder / "map")
    options = {"camera": PINHOLE, "keypoints": place.folder / "database.db", "time_limit": limit}
    task = photo_task(scene, "a.png", place.folder / "a.png", **options)
    assert (task.made_with["time_limit"], task.arguments["time_limit"]) == (kept, used)
    json.dumps(task.made_with, allow_nan=False)


def test_poses_are_those_of_all_runs_also_after_a_photo_that_failed(place: Place, fails: Callable[..., str]) -> None:
    place.run("a.png")
    place.run("b.png", more=("--time-limit", "60"))
    assert list(place.poses()) == ["a.png", "b.png"]
    (place.folder / "c.png").write_text("no photo")
    assert "c.png" in fails(*place.command("c.png"))
    assert list(place.poses()) == ["a.png", "b.png"]
    content = json.loads((place.folder / "out/results.json").read_text())["photos"]
    assert sorted(content) == ["a.png", "b.png"]
    made = content["b.png"]["made_with"]
    assert (made["solver"], made["time_limit"], made["camera_from"]) == ("search", 60.0, "view photo 0.jpg of the map")
    assert content["b.png"]["verdict"] == "confident"
    assert content["b.png"]["inlier_threshold"] > 0
    unwritable = place.folder / "out/solutions/b.png.json"
    unwritable.unlink()
    unwritable.mkdir()
    with pytest.raises(SystemExit):
        place.run("b.png")
    assert list(place.poses()) == ["a.png"]


def test_a_folder_and_an_underscore_are_different_photos(place: Place) -> None:
    (place.folder / "photos/cam").mkdir(parents=True)
    shot(place.folder / "photos/cam/1.png", 3)
    shot(place.folder / "photos/cam_1.png", 4)
    place.write({"cam/1.png": 0, "cam_1.png": 1})
    command = place.command("photos")
    command.remove("--no-pictures")
    main(command)
    assert place.is_right("cam/1.png", 0)
    assert place.is_right("cam_1.png", 1)
    pictures = (place.folder / "out/pictures").rglob("*.png")
    names = [path.relative_to(place.folder / "out/pictures").as_posix() for path in pictures]
    assert sorted(names) == ["cam/1.png", "cam_1.png"]


def test_the_camera_of_views_of_the_same_size_is_taken_and_named(
    place: Place, capsys: pytest.CaptureFixture[str], fails: Callable[..., str]
) -> None:
    place.run("a.png")
    assert "camera: view photo 0.jpg of the map (1)" in capsys.readouterr().out
    scene = SceneMap.from_colmap(place.folder / "map")
    solution = scene.localize_photo(place.folder / "a.png", keypoints=place.folder / "database.db", solver="search")
    np.testing.assert_allclose(solution.rotation, place.poses()["a.png"], atol=1e-12)
    assert solution.camera.focal == 520
    Image.new("L", (WIDTH // 2, HEIGHT // 2)).save(place.folder / "half.png")
    assert scene.camera_for(place.folder / "half.png") == (None, "unknown focal length")
    assert "no keypoints of half.png" in fails(*place.command("half.png"))
    for keypoint_source in ("MAP", str(place.folder / "map"), str(place.folder / "map/cameras.bin")):
        camera, source = scene.camera_for(place.folder / "half.png", exif=False)
        assert (camera.focal, source) == (260, "view photo 0.jpg of the map")
        assert "no keypoints of half.png" in fails(*place.command("half.png", more=("--camera", keypoint_source)))


def test_a_focal_length_is_found_with_the_pose(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    """The photo's camera is unknown; views of the same size have the true focal length."""
    place.run("a.png")
    before = place.poses()["a.png"]
    place.run("a.png", more=("--camera", "unknown"))
    assert "solved again, with other options: a.png" in capsys.readouterr().out
    np.testing.assert_allclose(place.poses()["a.png"], before, atol=2e-3)
    solution = Solution.from_json(place.folder / "out/solutions/a.png.json")
    assert abs(solution.focal_length - 520) < 4 * solution.focal_length_std < 50


def test_json_is_all_that_is_printed_and_a_pipe_gets_a_line_for_each_photo(
    place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    place.run("a.png", "b.png", more=("--json",))
    printed = capsys.readouterr()
    content = json.loads(printed.out)
    assert list(content["photos"]) == ["a.png", "b.png"]
    assert content["photos"]["a.png"]["verdict"] == "confident"
    lines = printed.err.splitlines()
    assert [line for line in lines if line[:3] in ("1/2", "2/2")] == ["1/2 a.png: confident", "2/2 b.png: confident"]
    place.run("a.png", "b.png", more=("--quiet",))
    assert capsys.readouterr() == ("", "")
    place.run("a.png", more=("--quiet", "--json"))
    printed = capsys.readouterr()
    assert list(json.loads(printed.out)["photos"]) == ["a.png"]
    assert printed.err == ""


def test_a_damaged_solution_is_one_line_and_the_others_are_localized(
    place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file of a photo that is solved again is replaced; that of another photo, here a view of the map, is named."""
    first, second = "photo 0.jpg", "photo 1.jpg"
    place.write({first: 0, second: 1})
    for name in (first, second):
        shot(place.folder / name, 0)
    place.run(first, second)
    solutions = place.folder / "out/solutions"
    text = (solutions / f"{first}.json").read_text()
    whole = json.loads(text)
    damages = {
        "its field 'rotation' is missing": {key: value for key, value in whole.items() if key != "rotation"},
        "its field 'made_with' has no 'leave_one_out'": whole
        | {"made_with": {"photo": "", "map": "", "camera_from": ""}},
        "its pose is": whole | {"rotation": [[1, 0], [0, 1]]},
        "its inlier_count is 'many' instead of a number": whole | {"inlier_count": "many"},
        "its verdict is None": whole | {"verdict": None},
        "it holds []": [],
    }
    capsys.readouterr()
    for reason, content in damages.items():
        (solutions / f"{first}.json").write_text(json.dumps(content))
        place.run(second)
        shown = " ".join(capsys.readouterr().out.split())
        assert f"not in results.json: solutions/{first}.json, since {reason}" in shown
        assert [*json.loads((place.folder / "out/results.json").read_text())["photos"]] == [second]
    (solutions / f"{first}.json").write_text("[" * 100_000)
    place.run(first, second)
    assert "not in results.json" not in capsys.readouterr().out
    again = json.loads((solutions / f"{first}.json").read_text())
    np.testing.assert_allclose(again["rotation"], whole["rotation"], atol=1e-9)
