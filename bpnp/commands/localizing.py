"""`bpnp localize`: poses of photos in a COLMAP map."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.commands.solving import exit_status
from bpnp.files import lock_folder
from bpnp.report.terminal import console, count_items, say

if TYPE_CHECKING:
    from bpnp.maps.many_photos import RunSummary, SolutionFolder
    from bpnp.maps.scene_map import SceneMap

CAPTION = (
    "error px: mean distance between matched keypoints and their projected points. log10 false: log10 of the number of "
    "false alarms, the number of poses expected to fit as well by chance."
)
FOCAL = "focal px: estimated focal length."
OFF = "off: difference to the map's own pose of the photo, degrees and scene units."
LEAST = 8  # least width of a name, columns


def localize(
    map: Path,
    photos: list[Path],
    *,
    camera: str | None = None,
    focal_error: float | None = None,
    distortion: bool = False,
    ignore_orientation: bool = False,
    views: Path | None = None,
    keypoints: Path | None = None,
    leave_one_out: bool = False,
    cluster: str | None = None,
    output: Path = Path("runs/localize"),
    no_pictures: bool = False,
    json: bool = False,
    quiet: bool = False,
    strict: bool = False,
    solver: str = "auto",
    time_limit: float | None = None,
    seed: int = 0,
) -> int:
    """Find the poses of photos in a map.

    Writes solutions/<photo>.json and pictures/<photo>.png. results.json and poses.txt (confident poses in the frame of
    the map) cover all photos that were solved in this folder. A photo that was solved there before is kept, unless the
    photo, the map or an option has changed.

    Args:
        map: folder of a COLMAP model, such as sparse/0.
        photos: photos, or folders of them; a photo in a folder is named by its path within it, as in hloc.
        camera: camera of the photos: a file with a 3x3 matrix; YAML of ROS (camera_info) or OpenCV; COLMAP's
            MODEL,PARAMETERS; a COLMAP model, such as MAP itself, for the camera of its images, scaled to the photo's
            size; or unknown, to find the focal length with the pose. By default that of EXIF, else of images of the map
            with the photo's size, else unknown.
        focal_error: relative standard deviation of the focal length of the camera, such as 0.1; it is then found with
            the pose. No effect on photos whose camera is unknown.
        distortion: fit a radial coefficient with an unknown focal length even where it is not significantly better.
        ignore_orientation: do not use the orientation in the EXIF data of a photo. By default the views of the map are
            first tried turned by the quarter turns that make them upright where the photo is.
        views: text file of lines "photo view", the views of the map to try; the whole map by default.
        keypoints: hloc's HDF5 file of features or COLMAP's database; SIFT is detected by default.
        leave_one_out: the photos are views of the map; remove each from the map before it is localized.
        cluster: address of a Dask scheduler whose workers localize the photos, or a number of local processes.
        output: folder of the results.
        no_pictures: write no pictures.
        solver: auto, which also runs the packaged matcher on a view if the search is not confident; search; or a
            checkpoint of a network.
        time_limit: seconds for each photo, 60 by default; inf for no limit.
        seed: random seed of the search.
        json: print JSON instead of a table: the entries of results.json for these photos.
        quiet: print only errors, and JSON with --json.
        strict: exit with status 1 unless the pose of each photo is confident; the status is 0 by default.
    """
    from bpnp.datamodules.colmap.model_files import model_format
    from bpnp.maps.many_photos import SolutionFolder, content_of_map, localize_photos, read_views, results_json
    from bpnp.maps.photos import photo_files
    from bpnp.maps.scene_map import SceneMap
    from bpnp.search.arguments import positive, source_from

    swapped = any(model_format(photo) for photo in photos)
    if map.is_file() or (swapped and not model_format(map)):
        hint = "; are MAP and PHOTO swapped?" if swapped else ""
        raise ValueError(f"MAP {map} is no folder of a COLMAP model{hint}")
    if keypoints is not None and not keypoints.is_file():
        raise ValueError(f"--keypoints {keypoints} does not exist; give hloc's or COLMAP's file of keypoints")
    source_from(solver)  # raise once here, not for each photo
    positive("time_limit", time_limit)
    if focal_error is not None and not 0 < focal_error < 1:
        raise ValueError(f"`focal_error` is {focal_error}; it is a fraction of the focal length, above 0 and below 1")
    files = photo_files(photos, besides=[output / "pictures", output / "solutions"])
    map_content = content_of_map(map)  # before it is read: if it changes afterwards, the next run finds another map
    scene = SceneMap.from_colmap(map)
    attempts, lens = _attempts(cluster), None if camera is None else _camera(camera, map, scene)
    tried = None if views is None else read_views(views)
    with lock_folder(output), count_items("localizing", len(files), quiet=quiet) as done:
        folder = SolutionFolder(output, map_content)
        outcome = localize_photos(
            scene,
            files,
            folder,
            attempts=attempts,
            pictures=not no_pictures,
            done=done,
            camera=lens,
            focal_error=focal_error,
            distortion=distortion or None,
            ignore_orientation=ignore_orientation or None,
            views=tried,
            keypoints=keypoints,
            leave_one_out=leave_one_out,
            solver=solver,
            seed=seed,
            time_limit=time_limit,
        )
    out = console(json=json, quiet=quiet)
    records = {name: folder.records[name] for name in files if name in folder.records and name not in outcome.errors}
    if json:
        say(results_json(folder.map_content, records))
    elif records:
        out.print(_table(records, out.width), Text(_caption(records), "dim italic"))
    _report(files, records, folder, outcome, out)
    if outcome.errors:
        (name, reason), *others = outcome.errors.items()
        for other, why in others:
            say(f"{other}: {why}", to=out)
        raise ValueError(f"{len(others) + 1} of {len(files)} photos could not be tried, such as {name}: {reason}")
    return exit_status([record["verdict"] for record in records.values()], strict=strict)


def _report(
    files: Mapping[str, Path],
    records: Mapping[str, Any],
    folder: "SolutionFolder",
    outcome: "RunSummary",
    out: Console,
) -> None:
    """Print the source of the cameras, and what was kept and written."""
    if records:
        cameras = Counter(record["made_with"]["camera_from"] for record in records.values())
        say(f"camera: {', '.join(f'{source} ({count})' for source, count in cameras.items())}", to=out)
    if outcome.kept:
        say(f"kept {len(outcome.kept)} of {len(files)} photos, solved before with the same content and options", to=out)
    for name, change in outcome.again.items():
        say(f"solved again, with {change}: {name}", to=out)
    if others := folder.of_other_maps():
        say(f"not in poses.txt: {len(others)} solutions in another map, such as {others[0]}", to=out)
    for name, reason in folder.damaged.items():
        say(f"not in results.json: solutions/{name}.json, since {reason}", to=out)
    for name, reason in outcome.not_drawn.items():
        say(f"no picture of {name}: {reason}", to=out)
    written = ["poses.txt", "results.json", *(["solutions/"] if records else [])]
    written += ["pictures/"] if any(folder.picture(name).is_file() for name in records) else []
    say(f"wrote {', '.join(written)} in {folder.path}", to=out)


def _camera(text: str, map: Path, scene: "SceneMap") -> Any:
    """Return the camera of all photos, or the map whose cameras are scaled to each."""
    from bpnp.cameras import CENTRE, camera_from
    from bpnp.commands.point_files import COLMAP_CAMERAS, read_camera
    from bpnp.maps.scene_map import UNKNOWN, SceneMap

    path = Path(text)
    if text == UNKNOWN:
        return UNKNOWN
    if path.is_file() and path.name in COLMAP_CAMERAS:
        path = path.parent
    if text in ("map", "MAP") or (text and path.is_dir()):
        return scene if not path.is_dir() or path.resolve() == map.resolve() else SceneMap.from_colmap(path)
    return camera_from(read_camera(text, centre=CENTRE))


def _attempts(cluster: str | None) -> Callable[..., Any]:
    """Return the function that localizes the photos: in this process, or on the workers of a cluster."""
    if cluster is None:
        from bpnp.maps.many_photos import attempts

        return attempts
    try:
        from bpnp.maps.on_cluster import attempts_on_cluster
    except ImportError as error:
        raise ValueError(f"--cluster needs Dask: {error}; install it with `pip install distributed`") from error
    return partial(attempts_on_cluster, cluster=cluster)


def _table(records: Mapping[str, Mapping[str, Any]], width: int) -> Table:
    """Return a table with a row for each photo; long names of photos and views are shortened to the `width`."""
    from bpnp.maps.many_photos import ERROR
    from bpnp.report.terminal import VERDICTS, number, shorten

    rows = list(records.values())
    found = [row["verdict"] != "failed" for row in rows]

    def cells(values: Iterable[float | None], form: Callable[[float], str] = number) -> list[str]:
        return [form(value) if value is not None and good else "-" for value, good in zip(values, found, strict=True)]

    numbers = {"matches": cells((row["inlier_count"] for row in rows), str)}
    if any(_focal_was_found(row) for row in rows):
        numbers["focal\npx"] = cells((row["focal_length"] for row in rows), "{:.0f}".format)
    numbers["error\npx"] = cells(row["reprojection_error"] for row in rows)
    if any(row[ERROR] for row in rows):
        numbers["off\ndeg"] = cells((row[ERROR] or {}).get("rotation_deg") for row in rows)
        numbers["off\nunits"] = cells((row[ERROR] or {}).get("centre") for row in rows)
    alarms = [row["log10_false_alarms"] for row in rows]
    numbers["log10\nfalse"] = ["-" if value is None else f"{value:.0f}" for value in alarms]
    numbers["sec"] = [number(row["seconds"]) for row in rows]

    names, views, verdicts = [*records], [str(row["view"]) for row in rows], [row["verdict"] for row in rows]
    taken = sum(1 + max(map(len, [*head.split("\n"), *column])) for head, column in numbers.items())
    left = max(width - taken - 1 - max(map(len, verdicts)) - 1, 2 * LEAST)
    longest = [max(map(len, ["photo", *names])), max(map(len, ["view", *views]))]
    if sum(longest) > left:
        longest[1] = min(longest[1], max(left - longest[0], left // 2))
        longest[0] = left - longest[1]
    table = Table(box=box.SIMPLE_HEAD, padding=0, pad_edge=False, show_edge=False)
    table.add_column("photo", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("view", no_wrap=True)
    for head in numbers:
        table.add_column(head, justify="right", no_wrap=True)
    shown = zip(shorten(names, longest[0]), verdicts, shorten(views, longest[1]), *numbers.values(), strict=True)
    for name, verdict, *row in shown:
        table.add_row(Text(name), Text(verdict, VERDICTS[verdict]), *map(Text, row))
    return table


def _caption(records: Mapping[str, Mapping[str, Any]]) -> str:
    from bpnp.maps.many_photos import ERROR

    focal = any(_focal_was_found(record) for record in records.values())
    compared = any(record[ERROR] for record in records.values())
    return " ".join([CAPTION, *([FOCAL] if focal else []), *([OFF] if compared else [])])


def _focal_was_found(record: Mapping[str, Any]) -> bool:
    return bool(record["focal_length_std"])
