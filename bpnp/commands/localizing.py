"""`bpnp localize`: new photos in a map, or the images of a COLMAP model as if their poses were unknown."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from bpnp.commands.output import console, progress, say
from bpnp.files import claimed, interruptions_later, keep_settings


def localize(
    map: Path | None = None,
    photos: list[Path] | None = None,
    *,
    camera: str | None = None,
    views: Path | None = None,
    keypoints: Path | None = None,
    leave_one_out: bool = False,
    cluster: str | None = None,
    model: Path | None = None,
    image: str = "all",
    points: Literal["seen", "clutter", "all"] = "seen",
    clutter: float = 0.25,
    output: Path = Path("runs/localize"),
    no_pictures: bool = False,
    solver: str = "auto",
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
    device: str | None = None,
) -> None:
    """Find where photos were taken in a map, or solve the images of a COLMAP model as if their poses were unknown.

    MAP PHOTO... writes solutions/<photo>.json, pictures/<photo>.png and poses.txt (confident poses in the frame of the
    map); an interrupted run resumes. --model instead turns the scene at random, so that nothing of a pose
    leaks into its search, compares with the model and writes results.json, images.txt and pictures/<image>.png.

    Args:
        map: COLMAP model of the place, such as sparse/0.
        photos: photos, or folders of them; a photo in a folder has its path within it as its name, as in hloc.
        camera: of the photos, a file with a 3x3 matrix or COLMAP's MODEL,PARAMETERS; EXIF by default.
        views: text file of pairs "photo view", the views of the map to try; the whole map by default.
        keypoints: hloc's HDF5 file of features or COLMAP's database; SIFT is detected by default.
        leave_one_out: the photos are views of the map, and each is taken out of it first.
        cluster: address of a Dask scheduler whose workers localize the photos, or a number of processes here.
        model: COLMAP model whose images are solved again, such as sparse/0.
        image: one image, or all.
        points: which 2D and 3D points to solve; "seen", the keypoints with a 3D point and these; "clutter", with
            --clutter of the others on both sides; "all", every keypoint and every 3D point.
        clutter: ratio to the true pairs.
        output: folder of the results.
        no_pictures: write no pictures.
        solver: auto, which asks the packaged matcher about a known view when the search is in doubt; search; or a
            checkpoint of a network.
        inlier_threshold: largest error of a match, pixels.
        time_limit: seconds a pair.
        seed: of the rotation and of the search.
        device: such as cuda; cpu by default.
    """
    if (map is None) == (model is None):
        raise ValueError("expected MAP PHOTO... or --model MODEL, got " + ("neither" if map is None else "both"))
    of_maps = {"camera": camera, "views": views, "keypoints": keypoints, "leave-one-out": leave_one_out}
    of_models = {"image": image != "all", "points": points != "seen", "inlier-threshold": inlier_threshold}
    others = of_maps | {"cluster": cluster} if map is None else of_models | {"device": device}
    if useless := [f"--{name}" for name, value in others.items() if value]:
        raise ValueError(f"expected {', '.join(useless)} with {'MAP PHOTO...' if map is None else '--model'} only")
    shared = {"solver": solver, "seed": seed, "time_limit": time_limit}
    if map is not None:
        given = {"camera": camera, "views": views, "keypoints": keypoints, "leave_one_out": leave_one_out, **shared}
        _localize_photos(map, photos or [], given, output, cluster, pictures=not no_pictures)
    elif model is not None:
        options = {"inlier_threshold": inlier_threshold, "device": device, **shared}
        _localize_images(model, (image, points, clutter), options, output, pictures=not no_pictures)


def _localize_photos(
    place: Path, photos: list[Path], given: Mapping[str, Any], output: Path, cluster: str | None, *, pictures: bool
) -> None:
    """Photos in a map. Raises ValueError in the end if some of them could not be tried, after the others."""
    from bpnp.cameras import camera_from
    from bpnp.localization.in_maps import (
        PhotoOptions,
        attempts,
        finished_solutions,
        kept,
        photo_files,
        photos_table,
        write_poses,
    )
    from bpnp.localization.point_files import read_camera
    from bpnp.maps.regions import read_pairs
    from bpnp.maps.scene_map import SceneMap
    from bpnp.solving.arguments import source_from

    camera, views, features, *rest = given.values()
    known = None if camera is None else camera_from(read_camera(camera))
    if features is not None and not features.is_file():
        raise ValueError(f"expected hloc's or COLMAP's file of keypoints, got {features}, which is no file")
    source_from(given["solver"])  # raises, where each photo would
    options = PhotoOptions(known, None if views is None else read_pairs(views), features, *rest)
    files, scene = photo_files(photos, besides=output), SceneMap.from_colmap(place)
    out, errors = console(), dict[str, str]()
    with claimed(output), progress() as shown:
        if not any((output / "solutions").rglob("*.json")):
            (output / "settings.json").unlink(missing_ok=True)
        keep_settings(output / "settings.json", {"map": place, **given})
        done = finished_solutions(output, files)
        task = shown.add_task("localizing", total=len(files), completed=len(done))
        left = {name: photo for name, photo in files.items() if name not in done}
        try:
            for name, found in (attempts if cluster is None else _attempts_on(cluster))(scene, left, options):
                shown.update(task, description=f"localized {name}", advance=1)
                try:
                    with interruptions_later():
                        done[name] = kept(output, name, files[name], found, picture=pictures)
                except (ValueError, OSError) as error:
                    errors[name] = str(error)
        finally:
            write_poses(output, done)
    if done:
        out.print(photos_table({name: done[name] for name in files if name in done}))
    for name, reason in errors.items():
        say(f"{name}: {reason}", to=out)
    folders = ", solutions/, pictures/" if pictures else ", solutions/"
    say(f"wrote poses.txt{folders if done else ''} in {output}", to=out)
    if errors:
        name, reason = next(iter(errors.items()))
        raise ValueError(f"{len(errors)} of {len(files)} photos could not be tried, such as {name}: {reason}")


def _attempts_on(cluster: str) -> Any:
    """As `attempts`, on the workers of a cluster."""
    from functools import partial

    try:
        from bpnp.localization.on_cluster import attempts_on_cluster
    except ImportError as error:
        raise ValueError(f"expected Dask for --cluster, got {error}; try `pip install 'bpnp[cluster]'`") from error
    return partial(attempts_on_cluster, cluster=cluster)


def _localize_images(
    model: Path, chosen: tuple[str, str, float], options: Mapping[str, Any], output: Path, *, pictures: bool
) -> None:
    """The images of a model. chosen: which, which points, and how much clutter. options: of `bpnp.solve`."""
    from bpnp.localization.from_models import (
        draw_image,
        image_source,
        localize_image,
        localized_table,
        read_model,
        summary,
        write_localized,
    )

    scene, find = read_model(model)
    source = image_source(scene, *chosen, options["seed"])
    settings, done, out = {"model": str(model), "points": chosen[1], "seed": options["seed"]}, [], console()
    with claimed(output), progress() as shown:
        try:
            for index in shown.track(range(len(source.images)), description="localizing"):
                done.append(localize_image(source, index, **options))
                if pictures:
                    draw_image(find, scene, done[-1], output / "pictures")
        finally:
            write_localized(output, done, settings)
    out.print(localized_table(done))
    out.print(summary(done), highlight=False, soft_wrap=True)
    say(f"wrote {', '.join(['results.json', 'images.txt', *['pictures/'] * pictures])} in {output}", to=out)
