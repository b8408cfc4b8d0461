"""Many photos in a map: what each is localised with, and the folder of their solutions, which a later run goes on with.

A solution is known by the content of all that it was made with, not by names: a photo, a map or a file of views that
was replaced under its name is another one.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bpnp.cameras import camera_from, camera_to_json
from bpnp.datamodules.colmap.model_files import FILES, model_format
from bpnp.files import delay_interrupts, fingerprint, write_text
from bpnp.maps.localized_picture import localized_picture
from bpnp.maps.photos import photo_keypoints
from bpnp.maps.scene_map import UNKNOWN, SceneMap
from bpnp.report.images import read_photo, save_figure
from bpnp.solving.solution import Solution

CHANGES = {"photo": "another photo", "map": "another map", "views": "other views", "keypoints": "other keypoints"}
MADE_WITH = "made_with"  # beside the fields of a solution in its file
REPORTED: tuple[str, ...] = ("verdict", "reason", "view", "inlier_count", "reprojection_error", "inlier_threshold")
REPORTED += ("log10_false_alarms", "seconds", "rotation", "translation", "camera", "focal_length", "focal_length_std")
REPORTED += (MADE_WITH,)
ERROR = "error_to_map"  # of a photo that was left out of the map
POSES_HEADER = "# NAME, QW, QX, QY, QZ, TX, TY, TZ (COLMAP's cam_from_world)\n"
Record = dict[str, Any]  # what results.json has of a photo


@dataclass(frozen=True)
class PhotoTask:
    """A photo to localise: arguments of `SceneMap.localize_photo`, and the content of what it is localised with."""

    name: str
    photo: Path
    arguments: Mapping[str, Any]
    made_with: Mapping[str, Any]


Attempt = tuple[PhotoTask, Solution | str]  # a photo, and its solution or why it could not be tried


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
    """What to localise a photo with.

    camera, keypoints, solver: as for `SceneMap.localize_photo`. views: those to try by the name of the photo, None for
    the whole map. leave_one_out: the photo is a view of the map and is taken out of it. search: focal_error,
    distortion, ignore_orientation, seed and time_limit.
    Raises ValueError for what is wrong with the photo, its camera, keypoints or views.
    """
    photo_content, source = content_of(photo), "--camera"
    if camera is None or isinstance(camera, SceneMap):
        camera, source = (camera or scene).camera_for(photo, exif=camera is None)
    lens = UNKNOWN if camera is None or isinstance(camera, str) else camera_to_json(camera_from(camera))
    source = "unknown focal length" if lens == UNKNOWN else source
    shown = None if views is None else list(views.get(name, ()))
    if shown is not None and not shown:
        raise ValueError(f"expected views for {name} in the file of views, got none; try without --views")
    points_content = "detected"
    if keypoints is not None:
        keypoints = keypoints.absolute()
        points = photo_keypoints(photo, keypoints, name)
        points_content = fingerprint([points.pixels.tolist(), points.scores.tolist()])
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
    arguments = {"camera": lens, "keypoints": keypoints, "name": name, "solver": solver}
    ignore = {"ignore_orientation": bool(search.get("ignore_orientation"))}
    return PhotoTask(name, photo.absolute(), arguments | shared | ignore, made_with | shared)


def attempt(scene: SceneMap, task: PhotoTask) -> Solution | str:
    """The solution of a photo, or why it could not be tried."""
    try:
        place = scene.without([task.name]) if task.made_with["leave_one_out"] else scene
        return place.localize_photo(task.photo, **task.arguments)
    except (ValueError, OSError) as error:
        return str(error)


def attempts(scene: SceneMap, tasks: Iterable[PhotoTask]) -> Iterator[Attempt]:
    """The photos one after the other."""
    return ((task, attempt(scene, task)) for task in tasks)


@dataclass
class Outcome:
    """Of the photos of a call: those kept as they were, why others were solved again, and why some were not tried."""

    kept: list[str] = field(default_factory=list)
    again: dict[str, str] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)


def localize_photos(
    scene: SceneMap,
    files: Mapping[str, Path],
    folder: "SolutionFolder",
    *,
    attempts: Callable[[SceneMap, Iterable[PhotoTask]], Iterable[Attempt]] = attempts,
    pictures: bool = True,
    done: Callable[[str], None] = lambda name: None,
    **options: Any,
) -> Outcome:
    """Localize photos, by name, into a folder; those that were solved there with the same content and options are kept.

    attempts: what localises them, here or on a cluster. done: called with a few words on each photo. options: as for
    `photo_task`. Each task is made when its turn comes: a photo may be replaced in the meantime.
    """
    outcome = Outcome()

    def failed(name: str, photo: Path, error: Exception) -> None:
        outcome.errors[name] = str(error)
        folder.forget_replaced(name, photo)
        done(f"{name}: could not be tried")

    def tasks() -> Iterator[PhotoTask]:
        for name, photo in files.items():
            try:
                task = photo_task(scene, name, photo, map_content=folder.map_content, **options)
            except (ValueError, OSError) as error:
                failed(name, photo, error)
                continue
            changes = folder.changes(task)
            if changes == []:
                outcome.kept.append(name)
                done(f"{name}: kept, {folder.records[name]['verdict']}")
                continue
            if changes:
                outcome.again[name] = ", ".join(dict.fromkeys(CHANGES.get(key, "other options") for key in changes))
            yield task

    try:
        for task, solution in attempts(scene, tasks()):
            try:
                with delay_interrupts():
                    folder.keep(task, solution, draw_in=scene if pictures else None)
                done(f"{task.name}: {folder.records[task.name]['verdict']}")
            except (ValueError, OSError) as error:
                failed(task.name, task.photo, error)
    finally:
        folder.compare(scene)
        folder.write()
    return outcome


def read_views(path: str | Path) -> dict[str, list[str]]:
    """The views to try for each photo, from a text file of lines `photo view`, as hloc's retrieval writes its pairs.

    Raises ValueError for a file that cannot be read or a line without two names.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"expected a text file of lines `photo view`, got {error}") from error
    views: dict[str, list[str]] = {}
    for number, line in enumerate(lines, 1):
        if not (names := line.split()):
            continue
        if len(names) != 2:
            raise ValueError(f"expected two names, a photo's and a view's, got {line!r} at line {number} of {path}")
        views.setdefault(names[0], []).append(names[1])
    return views


def content_of(*files: Path) -> str:
    """Sizes and a hash of what is in files."""
    digest, sizes = hashlib.blake2b(digest_size=16), []
    for file in files:
        with file.open("rb") as content:
            digest.update(hashlib.file_digest(content, "blake2b").digest())
        sizes.append(str(file.stat().st_size))
    return f"{'+'.join(sizes)} bytes, {digest.hexdigest()}"


def content_of_map(folder: Path) -> str:
    """The same of the files of a COLMAP model."""
    return content_of(*(folder / f"{name}.{model_format(folder)}" for name in FILES))


@dataclass
class SolutionFolder:
    """solutions/<photo>.json, and of all of them together results.json and poses.txt, in the frame of one map."""

    path: Path
    map_content: str
    records: dict[str, Record] = field(default_factory=dict)  # by photo

    def __post_init__(self) -> None:
        folder = self.path / "solutions"
        for file in sorted(folder.rglob("*.json")):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # not whole, or of another version
                self._record(file.relative_to(folder).as_posix().removesuffix(".json"), file.read_text("utf-8"))

    def changes(self, task: PhotoTask) -> list[str] | None:
        """What of the photo's solution was made with something else; None if there is no solution."""
        if task.name not in self.records:
            return None
        before = self.records[task.name][MADE_WITH]
        return [key for key, value in task.made_with.items() if before.get(key) != value]

    def keep(self, task: PhotoTask, solution: Solution | str, *, draw_in: SceneMap | None = None) -> None:
        """Write the solution of a photo, what it was made with, and its picture with a map. Raises ValueError with the
        reason if there is none."""
        if isinstance(solution, str):
            raise ValueError(solution)
        self.picture(task.name).unlink(missing_ok=True)
        if draw_in is not None:
            photo = read_photo(task.photo)
            save_figure(localized_picture(draw_in, solution, photo=photo, title=task.name), self.picture(task.name))
        text = f'{solution.to_json()[:-1]}, "{MADE_WITH}": {json.dumps(task.made_with)}}}'
        write_text(self._file("solutions", task.name, "json"), text + "\n")
        self._record(task.name, text)

    def forget_replaced(self, name: str, photo: Path) -> None:
        """Delete solution and picture of a photo if they are of another one of that name."""
        try:
            content = content_of(photo)
        except OSError:
            return
        if name in self.records and self.records[name][MADE_WITH]["photo"] != content:
            del self.records[name]
            self._file("solutions", name, "json").unlink()
            self.picture(name).unlink(missing_ok=True)

    def picture(self, name: str) -> Path:
        """Return the file of a photo's picture, which has the photo's name and is a PNG."""
        return self._file("pictures", name.removesuffix(".png"), "png")

    def compare(self, scene: SceneMap) -> None:
        """Add to each photo that was left out of this map how far its pose is from that of the map."""
        for name, record in self.records.items():
            known = record["rotation"] is not None and name in scene.view_numbers
            if known and record[MADE_WITH]["leave_one_out"] and record[MADE_WITH]["map"] == self.map_content:
                (view,), rotation = scene.named([name]), np.array(record["rotation"])
                degrees = np.degrees(Rotation.from_matrix(rotation @ view.rotation.T).magnitude())
                shift = np.linalg.norm(rotation.T @ record["translation"] + view.centre)
                record[ERROR] = {"rotation_deg": float(degrees), "centre": float(shift)}

    def of_other_maps(self) -> list[str]:
        """Photos whose solutions are of another map, so that their poses have another frame."""
        return [name for name, record in self.records.items() if record[MADE_WITH]["map"] != self.map_content]

    def write(self) -> None:
        """results.json; and poses.txt, a line for each confident photo of this map, whenever it was solved."""
        photos = dict(sorted(self.records.items()))
        write_text(self.path / "results.json", json.dumps({"map": self.map_content, "photos": photos}, indent=1) + "\n")
        others = self.of_other_maps()
        lines = [POSES_HEADER]
        for name, record in photos.items():
            if record["verdict"] == "confident" and name not in others:
                x, y, z, w = Rotation.from_matrix(record["rotation"]).as_quat(canonical=True).tolist()
                lines.append(f"{name} {' '.join(map(repr, (w, x, y, z, *record['translation'])))}\n")
        write_text(self.path / "poses.txt", "".join(lines))

    def _record(self, name: str, text: str) -> None:
        content = json.loads(text)
        self.records[name] = {key: content[key] for key in REPORTED} | {ERROR: None}

    def _file(self, folder: str, name: str, suffix: str) -> Path:
        return self.path / folder / f"{name}.{suffix}"
