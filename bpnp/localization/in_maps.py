"""Photos localised in a map, one after the other, into a folder; an interrupted run resumes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.text import Text

from bpnp.cameras import Lens, camera_from
from bpnp.files import write_text
from bpnp.maps.colmap_database import is_database, read_database
from bpnp.maps.keypoints import Keypoints, detected_keypoints, read_features
from bpnp.maps.photos import camera_from_exif, photo_size
from bpnp.maps.scene_map import SceneMap
from bpnp.report.figures import save_figure
from bpnp.report.palette import VERDICTS
from bpnp.report.photos import read_photo
from bpnp.report.tables.fitted_table import FittedTable
from bpnp.report.tables.rows import number
from bpnp.solving.pictures import pose_text, solution_picture
from bpnp.solving.solution import Solution

# The last four are found too although Pillow may not read them, so that the error names the photo.
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".avif", ".dng"}
Attempt = tuple[str, Solution | str]  # a photo's name, and its solution or why it could not be tried
POSES_HEADER = "# NAME, QW, QX, QY, QZ, TX, TY, TZ (COLMAP's cam_from_world)\n"


@dataclass(frozen=True)
class PhotoOptions:
    """What applies to all photos. camera: as for `bpnp.solve`, None for that of EXIF. pairs: views to try by the name
    of the photo, None for the whole map. features: hloc's HDF5 file or COLMAP's database, None to detect keypoints.
    leave_one_out: the photos are views of the map and are taken out of it."""

    camera: Any = None
    pairs: Mapping[str, Sequence[str]] | None = None
    features: Path | None = None
    leave_one_out: bool = False
    solver: str = "auto"
    seed: int = 0
    time_limit: float | None = None


def photo_files(given: Iterable[Path], besides: Path | None = None) -> dict[str, Path]:
    """Photos by name: the files given, and those in given folders and folders within, named by their path in these.

    besides: a folder within a given one whose files are no photos, such as that of the results.
    Raises ValueError for none, or one name twice.
    """
    files: dict[str, Path] = {}
    for path in given:
        if not path.exists():
            raise ValueError(f"expected a photo or a folder of photos, got {path}, which does not exist")
        for file in _photos_in(path, besides) if path.is_dir() else [path]:
            name = file.relative_to(path).as_posix() if path.is_dir() else file.name
            if files.setdefault(name, file) != file:
                raise ValueError(f"expected photos of different names, got {files[name]} and {file}")
    if not files:
        raise ValueError("expected one or more photos, or folders with some, got none")
    return files


def _photos_in(folder: Path, besides: Path | None) -> list[Path]:
    left_out = None if besides is None else besides.resolve()
    inside = (file for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES)
    return sorted(file for file in inside if left_out not in file.resolve().parents)


def localize_photo(scene: SceneMap, name: str, photo: Path, options: PhotoOptions) -> Solution:
    """One photo. Raises ValueError for what is wrong with it, its camera, its keypoints or its views."""
    size = photo_size(photo)
    if options.leave_one_out:
        scene = scene.without([name])
    camera = camera_from_exif(photo) if options.camera is None else options.camera
    lens = camera_from(camera)
    if options.features is None and isinstance(lens, Lens) and 0 < lens.camera.width != size[0]:
        raise ValueError(
            f"expected photos of {lens.camera.width} x {lens.camera.height} pixels as --camera says, got {name} of "
            f"{size[0]} x {size[1]}; try a camera with the focal length and the centre of this size"
        )
    found = _keypoints(name, photo, options.features, size)
    views = None if options.pairs is None else options.pairs.get(name)
    if options.pairs is not None and not views:
        raise ValueError(f"expected views for {name} among the pairs, got none; try without --views")
    return scene.localize(
        found.pixels, camera, views=views, scores=found.scores, solver=options.solver, seed=options.seed,
        time_limit=options.time_limit,
    )  # fmt: skip


def attempt(scene: SceneMap, name: str, photo: Path, options: PhotoOptions) -> Solution | str:
    """The solution of a photo, or why it could not be tried."""
    try:
        return localize_photo(scene, name, photo, options)
    except (ValueError, OSError) as error:
        return str(error)


def attempts(scene: SceneMap, files: Mapping[str, Path], options: PhotoOptions) -> Iterator[Attempt]:
    """The photos one after the other."""
    for name, photo in files.items():
        yield name, attempt(scene, name, photo, options)


def finished_solutions(folder: Path, names: Iterable[str]) -> dict[str, Solution]:
    """The solutions of an earlier run; of files that are not whole none."""
    done = {}
    for name in names:
        try:
            done[name] = Solution.from_json(_solution_file(folder, name))
        except (ValueError, OSError):
            continue
    return done


def kept(folder: Path, name: str, photo: Path, solution: Solution | str, *, picture: bool) -> Solution:
    """Write solutions/<name>.json and, if wanted, pictures/<name>.png: the matches over the photo.

    Raises ValueError with the reason if there is no solution.
    """
    if isinstance(solution, str):
        raise ValueError(solution)
    if picture:
        figure = solution_picture(solution, title=f"{name}: {solution.view}", photo=read_photo(photo))
        save_figure(figure, folder / "pictures" / f"{name}.png")
    write_text(_solution_file(folder, name), solution.to_json() + "\n")
    return solution


def write_poses(folder: Path, solutions: Mapping[str, Solution]) -> None:
    """poses.txt: a line for each confident photo, in the frame of the map."""
    lines = [
        f"{name} {pose_text(own.rotation, own.translation)}\n"
        for name, own in sorted(solutions.items())
        if own.verdict == "confident"
    ]
    write_text(folder / "poses.txt", POSES_HEADER + "".join(lines))


def photos_table(solutions: Mapping[str, Solution]) -> FittedTable:
    """A row for each photo."""
    rows = []
    for name, solution in solutions.items():
        cells = (str(solution.view), str(solution.inlier_count), number(solution.reprojection_error))
        times = (f"{solution.log10_false_alarms:.0f}", number(solution.seconds))
        rows.append((Text(name), [Text(solution.verdict, VERDICTS[solution.verdict]), *map(Text, (*cells, *times))]))
    return FittedTable("", ("verdict", "view", "matches", "error\npx", "log10\nfalse", "sec"), [rows])


def _keypoints(name: str, photo: Path, features: Path | None, size: tuple[int, int]) -> Keypoints:
    if features is None:
        return detected_keypoints(photo)
    return read_database(features, name, size) if is_database(features) else read_features(features, name, size)


def _solution_file(folder: Path, name: str) -> Path:
    return folder / "solutions" / f"{name}.json"
