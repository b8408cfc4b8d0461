"""`bpnp localize`: where photos were taken, in a map of the place."""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from bpnp.files import lock_folder
from bpnp.report.terminal import console, progress, say

if TYPE_CHECKING:
    from bpnp.maps.many_photos import Outcome, SolutionFolder
    from bpnp.maps.scene_map import SceneMap

CAPTION = (
    "error px: mean distance between the keypoints of the matches and their points. log10 false: how many poses would "
    "fit as well by chance, as a power of ten; smaller is surer."
)
COLUMNS = ("verdict", "view", "matches", "error\npx", "log10\nfalse", "sec")


def localize(
    map: Path,
    photos: list[Path],
    *,
    camera: str | None = None,
    focal_error: float | None = None,
    distortion: bool = False,
    views: Path | None = None,
    keypoints: Path | None = None,
    leave_one_out: bool = False,
    cluster: str | None = None,
    output: Path = Path("runs/localize"),
    no_pictures: bool = False,
    solver: str = "auto",
    time_limit: float | None = None,
    seed: int = 0,
) -> None:
    """Find where photos were taken in a map.

    Writes solutions/<photo>.json, pictures/<photo>.png, and of all that were solved in this folder results.json and
    poses.txt (confident poses in the frame of the map). A photo that was solved there before is kept, unless the photo,
    the map or an option has changed.

    Args:
        map: COLMAP model of the place, such as sparse/0.
        photos: photos, or folders of them; a photo in a folder has its path within it as its name, as in hloc.
        camera: of the photos, a file with a 3x3 matrix or COLMAP's MODEL,PARAMETERS; or a COLMAP model, such as MAP
            itself, for that of its images, scaled to the photo's size; or unknown, to find the focal length with the
            pose. By default that of EXIF, else of images of the map that have the photo's size, else unknown.
        focal_error: relative standard deviation of the focal length of the camera, such as 0.1; it is then found with
            the pose. No effect on photos whose camera is unknown.
        distortion: fit a radial coefficient with an unknown focal length even where it is not significantly better.
        views: text file of lines "photo view", the views of the map to try; the whole map by default.
        keypoints: hloc's HDF5 file of features or COLMAP's database; SIFT is detected by default.
        leave_one_out: the photos are views of the map, and each is taken out of it first.
        cluster: address of a Dask scheduler whose workers localize the photos, or a number of processes here.
        output: folder of the results.
        no_pictures: write no pictures.
        solver: auto, which asks the packaged matcher about a known view when the search is in doubt; search; or a
            checkpoint of a network.
        time_limit: seconds a photo.
        seed: of the search.
    """
    from bpnp.datamodules.colmap.model_files import model_format
    from bpnp.maps.many_photos import SolutionFolder, content_of_map, localize_photos, read_views
    from bpnp.maps.photos import photo_files
    from bpnp.maps.scene_map import SceneMap
    from bpnp.solving.arguments import positive, source_from

    swapped = any(model_format(photo) for photo in photos)
    if map.is_file() or (swapped and not model_format(map)):
        hint = "; are MAP and PHOTO swapped?" if swapped else ""
        raise ValueError(f"expected MAP as the folder of a COLMAP model, got {map}{hint}")
    if keypoints is not None and not keypoints.is_file():
        raise ValueError(f"expected hloc's or COLMAP's file of keypoints, got {keypoints}, which is no file")
    source_from(solver)  # raises, where each photo would
    positive("time_limit", time_limit)
    if focal_error is not None and not 0 < focal_error < 1:
        raise ValueError(f"`focal_error` is {focal_error}; it is a fraction of the focal length, above 0 and below 1")
    files, scene = photo_files(photos, besides=output), SceneMap.from_colmap(map)
    attempts, lens = _attempts(cluster), None if camera is None else _camera(camera, map, scene)
    tried = None if views is None else read_views(views)
    with lock_folder(output), progress() as shown:
        folder, bar = SolutionFolder(output, content_of_map(map)), shown.add_task("localizing", total=len(files))
        outcome = localize_photos(
            scene,
            files,
            folder,
            attempts=attempts,
            pictures=not no_pictures,
            done=lambda name: shown.update(bar, description=f"localized {name}", advance=1),
            camera=lens,
            focal_error=focal_error,
            distortion=distortion or None,
            views=tried,
            keypoints=keypoints,
            leave_one_out=leave_one_out,
            solver=solver,
            seed=seed,
            time_limit=time_limit,
        )
    _report(files, folder, outcome, pictures=not no_pictures)
    if outcome.errors:
        (name, reason), *others = outcome.errors.items()
        for other, why in others:
            say(f"{other}: {why}")
        raise ValueError(f"{len(others) + 1} of {len(files)} photos could not be tried, such as {name}: {reason}")


def _report(files: Mapping[str, Path], folder: "SolutionFolder", outcome: "Outcome", *, pictures: bool) -> None:
    """Say what was found, kept and written."""
    out = console()
    records = {name: folder.records[name] for name in files if name in folder.records and name not in outcome.errors}
    if records:
        out.print(_table(records))
        cameras = Counter(record["made_with"]["camera_from"] for record in records.values())
        say(f"camera: {', '.join(f'{source} ({count})' for source, count in cameras.items())}", to=out)
    if outcome.kept:
        say(f"kept {len(outcome.kept)} of {len(files)} photos, solved before with the same content and options", to=out)
    for name, change in outcome.again.items():
        say(f"solved again, with {change}: {name}", to=out)
    if others := folder.of_other_maps():
        say(f"not in poses.txt: {len(others)} solutions in another map, such as {others[0]}", to=out)
    written = ", solutions/, pictures/" if pictures else ", solutions/"
    say(f"wrote poses.txt, results.json{written if records else ''} in {folder.path}", to=out)


def _camera(text: str, map: Path, scene: "SceneMap") -> Any:
    """The camera of all photos, or the map whose cameras are scaled to each."""
    from bpnp.cameras import camera_from
    from bpnp.commands.point_files import COLMAP_CAMERAS, read_camera
    from bpnp.maps.scene_map import UNKNOWN, SceneMap

    path = Path(text)
    if text == UNKNOWN:
        return UNKNOWN
    if path.is_file() and path.stem == COLMAP_CAMERAS:
        path = path.parent
    if text in ("map", "MAP") or (text and path.is_dir()):
        return scene if not path.is_dir() or path.resolve() == map.resolve() else SceneMap.from_colmap(path)
    return camera_from(read_camera(text))


def _attempts(cluster: str | None) -> Callable[..., Any]:
    """What localises the photos: here, or on the workers of a cluster."""
    if cluster is None:
        from bpnp.maps.many_photos import attempts

        return attempts
    try:
        from bpnp.maps.on_cluster import attempts_on_cluster
    except ImportError as error:
        raise ValueError(f"expected Dask for --cluster, got {error}; try `pip install 'bpnp[cluster]'`") from error
    return partial(attempts_on_cluster, cluster=cluster)


def _table(records: Mapping[str, Mapping[str, Any]]) -> Any:
    """A row for each photo."""
    from bpnp.report.terminal import VERDICTS, SplitTable, number

    rows = []
    for name, record in records.items():
        known = {key: float("nan") if value is None else value for key, value in record.items()}
        figures = number(known["reprojection_error"]), f"{known['log10_false_alarms']:.0f}", number(known["seconds"])
        cells = str(record["view"]), str(record["inlier_count"]), *figures
        rows.append((Text(name), [Text(record["verdict"], VERDICTS[record["verdict"]]), *map(Text, cells)]))
    return SplitTable("", COLUMNS, [rows], CAPTION)
