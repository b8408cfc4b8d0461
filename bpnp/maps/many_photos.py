"""Localisation of many photos in a map, and the folder of their solutions, which a later run continues.

A solution is identified by the content of all its inputs, not by their names. A photo, a map or a file of views with
new content under the same name is a new input.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.argument_types import short_repr
from bpnp.bounded_files import open_input, parse_json, read_json, read_text
from bpnp.cameras import camera_from, camera_to_json
from bpnp.datamodules.colmap.model_files import FILES, model_format
from bpnp.files import delay_interrupts, fingerprint, write_text
from bpnp.maps.localized_picture import localized_picture
from bpnp.maps.photos import photo_keypoints
from bpnp.maps.scene_map import PHOTO_TIME_LIMIT, UNKNOWN, SceneMap
from bpnp.report.figure_files import save_figure
from bpnp.report.images import read_photo
from bpnp.search.arguments import seconds_from
from bpnp.search.solution import Solution
from bpnp.search.verdict.decide import Verdict

CHANGES = {"photo": "another photo", "map": "another map", "views": "other views", "keypoints": "other keypoints"}
MADE_WITH = "made_with"  # key in a solution's file, added to the fields of the solution
REPORTED: tuple[str, ...] = ("verdict", "reason", "view", "inlier_count", "reprojection_error", "inlier_threshold")
REPORTED += ("log10_false_alarms", "seconds", "rotation", "translation", "camera", "focal_length", "focal_length_std")
REPORTED += (MADE_WITH,)
NUMBERS: tuple[str, ...] = ("inlier_count", "reprojection_error", "inlier_threshold", "log10_false_alarms", "seconds")
NUMBERS += ("focal_length", "focal_length_std")
INPUTS_OF_ALL = ("photo", "map", "camera_from", "leave_one_out")  # entries of MADE_WITH that are used by name
ERROR = "error_to_map"  # key for a photo that was left out of the map
# A name may have spaces: the last seven words of a line are the numbers.
POSES_HEADER = "# NAME, QW, QX, QY, QZ, TX, TY, TZ (COLMAP's cam_from_world)\n"
Record = dict[str, Any]  # entry of a photo in results.json


@dataclass(frozen=True)
class PhotoTask:
    """File of one photo in a run of many, with all that its solution depends on; a `Photo` has the keypoints."""

    name: str
    photo: Path
    arguments: Mapping[str, Any]  # arguments of `SceneMap.localize_photo`
    made_with: Mapping[str, Any]  # fingerprints of all inputs of the solution


Attempt = tuple[PhotoTask, Solution | str]  # a photo, and its solution or an error message


def photo_task(
    scene: SceneMap,
    name: str,
    photo: Path,
    *,
    map_content: str = "",
    camera: Any = None,
    views: Mapping[str, Sequence[str]] | None = None,
    keypoints: Path | None = None,
    leave_one_out: bool = False,
    solver: str = "auto",
    **search: Any,
) -> PhotoTask:
    """Build the task of a photo from the arguments of `SceneMap.localize_photo` and the views to try, by photo name.

    `leave_one_out` removes the photo, a view of the map, from the map; its default camera is then that of another view.
    Raise ValueError if the photo, its camera, its keypoints or its views are invalid.
    """
    photo_content, source = content_of(photo), "--camera"
    if camera is None or isinstance(camera, SceneMap):
        others = tuple(view for view in scene.views if view.name != name) if leave_one_out else scene.views
        camera, source = (camera or replace(scene, views=others)).camera_for(photo, exif=camera is None)
    lens = UNKNOWN if camera is None or isinstance(camera, str) else camera_to_json(camera_from(camera))
    source = "unknown focal length" if lens == UNKNOWN else source
    shown = None if views is None else list(views.get(name, ()))
    if shown is not None and not shown:
        raise ValueError(f"the file of views names no view for {name}; add one, or leave out --views")
    points_content = "detected"
    if keypoints is not None:
        keypoints = keypoints.absolute()
        points = photo_keypoints(photo, keypoints, name)
        points_content = fingerprint([points.pixels.tolist(), points.scores.tolist()])
    limit = seconds_from(search.get("time_limit"), PHOTO_TIME_LIMIT)
    shared = {"views": shown, **search}
    made_with = {
        "photo": photo_content,
        "map": map_content,
        "keypoints": points_content,
        "camera": fingerprint(lens),
        "camera_from": source,
        "solver": content_of(Path(solver)) if Path(solver).is_file() else solver,
        "leave_one_out": leave_one_out,
    }
    made_with |= shared | ({} if math.isfinite(limit) else {"time_limit": "none"})  # JSON has no infinity
    arguments = {"camera": lens, "keypoints": keypoints, "name": name, "solver": solver, **shared, "time_limit": limit}
    arguments["ignore_orientation"] = bool(search.get("ignore_orientation"))
    given = {key: value for key, value in arguments.items() if value is not None}
    return PhotoTask(name, photo.absolute(), given, made_with)


def attempt(scene: SceneMap, task: PhotoTask) -> Solution | str:
    """Return the solution of a photo, or the error message."""
    try:
        searched = scene.without([task.name]) if task.made_with["leave_one_out"] else scene
        return searched.localize_photo(task.photo, **task.arguments)
    except (ValueError, OSError) as error:
        return str(error)


def attempts(scene: SceneMap, tasks: Iterable[PhotoTask]) -> Iterator[Attempt]:
    """Return an iterator over the results of the photos, one after the other."""
    return ((task, attempt(scene, task)) for task in tasks)


@dataclass
class RunSummary:
    """What a run of `localize_photos` did with each photo; the solutions are in the `SolutionFolder`."""

    kept: list[str] = field(default_factory=list)  # names of photos whose earlier solution is still valid
    again: dict[str, str] = field(default_factory=dict)  # reasons why photos were solved again, by name
    errors: dict[str, str] = field(default_factory=dict)  # error messages of photos that could not be tried, by name
    # Error messages of pictures that could not be drawn, by the name of the photo.
    not_drawn: dict[str, str] = field(default_factory=dict)


def localize_photos(
    scene: SceneMap,
    files: Mapping[str, Path],
    folder: "SolutionFolder",
    *,
    attempts: Callable[[SceneMap, Iterable[PhotoTask]], Iterable[Attempt]] = attempts,
    pictures: bool = True,
    done: Callable[[str], None] = lambda name: None,
    **options: Any,
) -> RunSummary:
    """Localise photos into a folder; solutions there with the same inputs and options (`photo_task`) are kept.

    A solution is written before its picture is drawn. A kept solution without a picture is drawn. Each task is built
    just before it runs, since a photo may be replaced in the meantime. `done` gets a short message for each photo.
    Raise ValueError if a picture in the folder would replace a photo.
    """
    outcome = RunSummary()
    places = {folder.picture(name).resolve() for name in files}
    if replaced := next((photo for photo in files.values() if photo.resolve() in places), None):
        raise ValueError(f"{replaced} would be replaced by the picture of a result; use another folder for the results")

    def describe_failure(name: str, photo: Path, error: Exception) -> None:
        outcome.errors[name] = str(error)
        outcome.again.pop(name, None)
        folder.forget_replaced(name, photo)
        done(f"{name}: could not be tried")

    def draw(task: PhotoTask) -> None:
        if not pictures or folder.picture(task.name).is_file():
            return
        try:
            with delay_interrupts():  # matplotlib takes Ctrl-C for an invalid box
                folder.draw(task, scene)
        except (ValueError, OSError) as error:
            outcome.not_drawn[task.name] = str(error)

    def tasks() -> Iterator[PhotoTask]:
        for name, photo in files.items():
            try:
                task = photo_task(scene, name, photo, map_content=folder.map_content, **options)
            except (ValueError, OSError) as error:
                describe_failure(name, photo, error)
                continue
            changes = folder.changes(task)
            if changes == []:
                outcome.kept.append(name)
                draw(task)
                done(f"{name}: kept, {folder.records[name]['verdict']}")
                continue
            if changes:
                outcome.again[name] = ", ".join(dict.fromkeys(CHANGES.get(key, "other options") for key in changes))
            yield task

    try:
        for task, solution in attempts(scene, tasks()):
            try:
                with delay_interrupts():
                    folder.keep(task, solution)
                    draw(task)
                done(f"{task.name}: {folder.records[task.name]['verdict']}")
            except (ValueError, OSError) as error:
                describe_failure(task.name, task.photo, error)
    finally:
        folder.compare(scene)
        folder.write()
    return outcome


def read_views(path: str | Path) -> dict[str, list[str]]:
    """Read the views to try for each photo from a text file of lines `photo view`, as hloc writes retrieval pairs."""
    try:
        lines = read_text(Path(path)).splitlines()
    except (OSError, ValueError) as error:
        raise ValueError(f"--views needs a text file of lines `photo view`: {error}") from error
    views: dict[str, list[str]] = {}
    for number, line in enumerate(lines, 1):
        if not (names := line.split()):
            continue
        if len(names) != 2:
            raise ValueError(
                f"line {number} of {path} is {line!r}; a line has two names without spaces, of a photo and a view"
            )
        views.setdefault(names[0], []).append(names[1])
    return views


def content_of(*files: Path) -> str:
    """Return the sizes and a hash of the content of files."""
    digest, sizes = hashlib.blake2b(digest_size=16), []
    for file in files:
        with open_input(file, pipes=False) as content:
            digest.update(hashlib.file_digest(content, "blake2b").digest())
        sizes.append(str(file.stat().st_size))
    return f"{'+'.join(sizes)} bytes, {digest.hexdigest()}"


def content_of_map(folder: Path) -> str:
    """Return the sizes and a hash of the content of the files of a COLMAP model; nothing for an incomplete one."""
    suffix = model_format(folder)
    return "" if suffix is None else content_of(*(folder / f"{name}.{suffix}" for name in FILES))


def results_json(map_content: str, photos: Mapping[str, Record]) -> str:
    """Return the content of results.json."""
    return json.dumps({"map": map_content, "photos": photos}, indent=1)


def _record(content: Any) -> Record:
    """Return the entry of results.json of a solution's file; raise ValueError if a field is missing or damaged."""
    if not isinstance(content, dict):
        raise ValueError(f"it holds {short_repr(content)}")
    try:
        record: Record = {key: content[key] for key in REPORTED}
        missing = [key for key in INPUTS_OF_ALL if key not in dict(record[MADE_WITH])]
        rotation, translation = (np.asarray(record[key], np.float64) for key in ("rotation", "translation"))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        reason = f"its field {error} is missing" if isinstance(error, KeyError) else f"a field is damaged: {error}"
        raise ValueError(reason) from error
    if missing:
        raise ValueError(f"its field {MADE_WITH!r} has no {missing[0]!r}")
    if record["verdict"] not in get_args(Verdict):
        raise ValueError(f"its verdict is {record['verdict']!r:.40}")
    has_pose = rotation.shape == (3, 3) and translation.shape == (3,) and np.isfinite([*rotation, translation]).all()
    is_empty = record["rotation"] is None and record["translation"] is None and record["verdict"] == "failed"
    if not is_empty and not (has_pose and np.linalg.det(rotation) > 0):
        raise ValueError(f"its pose is {short_repr((record['rotation'], record['translation']))}")
    for name in NUMBERS:
        if record[name] is not None and not isinstance(record[name], (int, float)):
            raise ValueError(f"its {name} is {record[name]!r:.40} instead of a number")
    return record | {ERROR: None}


@dataclass
class SolutionFolder:
    """Folder with solutions/<photo>.json for each photo, and results.json and poses.txt for all.

    A results.json or poses.txt that is no result of `bpnp localize` is a ValueError, so that it is not replaced.
    """

    path: Path
    map_content: str  # fingerprint of the files of the map, whose frame the poses are in
    records: dict[str, Record] = field(default_factory=dict)  # entries of results.json, by photo
    # What is wrong with each file of a solution that is not in results.json, by photo.
    damaged: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Beginnings of the files for all photos, which no other program writes.
        results_beginning, _, _ = results_json("", {}).partition('""')
        for name, beginning in (("results.json", results_beginning), ("poses.txt", POSES_HEADER)):
            file = self.path / name
            if not file.is_file():
                continue
            with file.open("rb") as content:
                if content.read(len(beginning.encode())) != beginning.encode():
                    raise ValueError(
                        f"{file} is no result of `bpnp localize` and would be replaced; use another folder"
                    )
        folder = self.path / "solutions"
        for file in sorted(folder.rglob("*.json")):
            name = file.relative_to(folder).as_posix().removesuffix(".json")
            try:
                self.records[name] = _record(read_json(file))
            except (OSError, ValueError) as error:
                self.damaged[name] = str(error)

    def changes(self, task: PhotoTask) -> list[str] | None:
        """Return the names of the inputs that have changed since the photo's solution; None if there is no solution."""
        if task.name not in self.records:
            return None
        before = self.records[task.name][MADE_WITH]
        return [key for key, value in task.made_with.items() if before.get(key) != value]

    def keep(self, task: PhotoTask, solution: Solution | str) -> None:
        """Write a solution and the fingerprints of its inputs, and delete the picture of an earlier one.

        An error message in place of a solution is raised as a ValueError.
        """
        if isinstance(solution, str):
            raise ValueError(solution)
        self.picture(task.name).unlink(missing_ok=True)
        text = f'{solution.to_json()[:-1]}, "{MADE_WITH}": {json.dumps(task.made_with)}}}'
        write_text(self._file("solutions", task.name, "json"), text + "\n")
        self.records[task.name] = _record(parse_json(text))
        self.damaged.pop(task.name, None)

    def draw(self, task: PhotoTask, scene: SceneMap) -> None:
        """Draw the picture of a photo from its solution; raise ValueError if one of them cannot be read."""
        solution = Solution.from_json(self._file("solutions", task.name, "json"))
        figure = localized_picture(scene, solution, photo=read_photo(task.photo), title=task.name)
        save_figure(figure, self.picture(task.name))

    def forget_replaced(self, name: str, photo: Path) -> None:
        """Delete the solution and the picture of a photo if they belong to another photo of that name."""
        try:
            content = content_of(photo)
        except (OSError, ValueError):
            return
        if name in self.records and self.records[name][MADE_WITH]["photo"] != content:
            del self.records[name]
            self._file("solutions", name, "json").unlink()
            self.picture(name).unlink(missing_ok=True)

    def picture(self, name: str) -> Path:
        """Return the path of a photo's picture, a PNG file with the photo's name."""
        return self._file("pictures", name.removesuffix(".png"), "png")

    def compare(self, scene: SceneMap) -> None:
        """Add the error relative to the map's pose to each photo that was left out of this map."""
        for name, record in self.records.items():
            comparable = record["rotation"] is not None and name in scene.view_numbers
            if comparable and record[MADE_WITH]["leave_one_out"] and record[MADE_WITH]["map"] == self.map_content:
                (view,), rotation = scene.named([name]), np.array(record["rotation"])
                degrees = np.degrees(Rotation.from_matrix(rotation @ view.rotation.T).magnitude())
                shift = np.linalg.norm(rotation.T @ record["translation"] + view.centre)
                record[ERROR] = {"rotation_deg": float(degrees), "centre": float(shift)}

    def of_other_maps(self) -> list[str]:
        """Return the photos with solutions in another map, whose poses are in another frame."""
        return [name for name, record in self.records.items() if record[MADE_WITH]["map"] != self.map_content]

    def write(self) -> None:
        """Write results.json, and poses.txt with a line for each confident photo of this map, from all runs."""
        photos = dict(sorted(self.records.items()))
        write_text(self.path / "results.json", results_json(self.map_content, photos) + "\n")
        others = self.of_other_maps()
        lines = [POSES_HEADER]
        for name, record in photos.items():
            if record["verdict"] == "confident" and name not in others:
                x, y, z, w = Rotation.from_matrix(record["rotation"]).as_quat(canonical=True).tolist()
                lines.append(f"{name} {' '.join(map(repr, (w, x, y, z, *record['translation'])))}\n")
        write_text(self.path / "poses.txt", "".join(lines), errors="surrogateescape")  # keeps names of photos

    def _file(self, folder: str, name: str, suffix: str) -> Path:
        return self.path / folder / f"{name}.{suffix}"
