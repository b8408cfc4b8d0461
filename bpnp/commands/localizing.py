"""`bpnp localize`: new photos in a map, or the images of a COLMAP model as if their poses were unknown."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bpnp.commands.output import console
from bpnp.files import claimed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bpnp.localization.in_maps import Attempt, PhotoOptions
    from bpnp.localization.localized import Localized
    from bpnp.maps.scene_map import SceneMap


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
        photos: photos, or folders of them.
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
    if map is not None and model is None:
        from bpnp.localization.in_maps import PhotoOptions
        from bpnp.localization.point_files import read_camera
        from bpnp.maps.regions import read_pairs

        options = PhotoOptions(
            camera=None if camera is None else read_camera(camera),
            pairs=None if views is None else read_pairs(views),
            features=keypoints,
            leave_one_out=leave_one_out,
            solver=solver,
            seed=seed,
            time_limit=time_limit,
        )
        asked = {"map": str(map), "camera": camera, "views": str(views), "keypoints": str(keypoints)}
        asked |= {"leave_one_out": str(leave_one_out), "solver": solver}
        asked |= {"seed": str(seed), "time_limit": str(time_limit)}
        _localize_photos(map, photos or [], options, asked, output, cluster, pictures=not no_pictures)
    elif model is not None and map is None:
        _localize_images(
            model, image, points, clutter, output, no_pictures, solver, inlier_threshold, time_limit, seed, device
        )  # fmt: skip
    else:
        raise ValueError("expected MAP PHOTO... or --model MODEL, got " + ("neither" if map is None else "both"))


def _localize_photos(
    place: Path,
    photos: list[Path],
    options: "PhotoOptions",
    asked: dict[str, str | None],
    output: Path,
    cluster: str | None,
    *,
    pictures: bool,
) -> None:
    """Photos in a map. Raises ValueError in the end if some of them could not be tried, after the others."""
    from bpnp.localization.in_maps import (
        attempts,
        check_settings,
        finished_solution,
        kept,
        photo_files,
        photos_table,
        write_poses,
    )  # fmt: skip
    from bpnp.localization.slow_progress import SlowProgress
    from bpnp.maps.scene_map import SceneMap

    files, scene = photo_files(photos), SceneMap.from_colmap(place)
    with claimed(output), SlowProgress("localizing", total=len(files)) as progress:
        check_settings(output, asked)
        earlier = {name: finished_solution(output, name) for name in files}
        done = {name: solution for name, solution in earlier.items() if solution is not None}
        errors: dict[str, str] = {}
        left = {name: photo for name, photo in files.items() if name not in done}
        progress.advance(len(done))
        found = attempts(scene, left, options) if cluster is None else _on_cluster(scene, left, options, cluster)
        try:
            for name, result in found:
                progress.describe(f"localized {name}")
                try:
                    done[name] = kept(output, name, files[name], result, picture=pictures)
                except (ValueError, OSError) as error:
                    errors[name] = str(error)
                progress.advance()
        finally:
            write_poses(output, done)
    out = console()
    if done:
        out.print(photos_table({name: done[name] for name in files if name in done}))
    for name, reason in errors.items():
        out.print(f"{name}: {reason}", markup=False, highlight=False, soft_wrap=True)
    out.print(f"wrote poses.txt, solutions/ in {output}", markup=False, highlight=False, soft_wrap=True)
    if errors:
        name, reason = next(iter(errors.items()))
        raise ValueError(f"{len(errors)} of {len(files)} photos could not be tried, such as {name}: {reason}")


def _on_cluster(
    scene: "SceneMap", files: dict[str, Path], options: "PhotoOptions", cluster: str
) -> "Iterator[Attempt]":
    try:
        from bpnp.localization.on_cluster import attempts_on_cluster
    except ImportError as error:
        raise ValueError(f"expected Dask for --cluster, got {error}; try `pip install 'bpnp[cluster]'`") from error
    return attempts_on_cluster(scene, files, options, cluster)


def _localize_images(
    model: Path,
    image: str,
    points: Literal["seen", "clutter", "all"],
    clutter: float,
    output: Path,
    no_pictures: bool,
    solver: str,
    inlier_threshold: float | None,
    time_limit: float | None,
    seed: int,
    device: str | None,
) -> None:
    """The images of a model."""
    from bpnp.datamodules.colmap.reconstruction import read_reconstruction
    from bpnp.localization.from_models import draw_image, image_source, localize_image, model_photos, write_localized
    from bpnp.localization.localized import localized_table, summary
    from bpnp.localization.slow_progress import SlowProgress

    source = image_source(read_reconstruction(model), image, points, clutter, seed)
    draw = None if no_pictures else partial(draw_image, *model_photos(model))
    done: list["Localized"] = []
    with claimed(output), SlowProgress("localizing", total=len(source.images)) as progress:
        for index, (_, own) in enumerate(source.images):
            progress.describe(own.name)
            solution, result = localize_image(
                source, index, solver=solver, inlier_threshold=inlier_threshold, seed=seed, time_limit=time_limit,
                device=device,
            )  # fmt: skip
            done.append(result)
            write_localized(output, done, {"model": str(model), "points": points, "seed": seed})
            if draw is not None:
                draw(solution, result, output / "pictures")
            progress.advance()
    out = console()
    out.print(localized_table(done))
    out.print(summary(done), highlight=False, soft_wrap=True)
    written = ", ".join(["results.json", "images.txt", *([] if draw is None else ["pictures/"])])
    out.print(f"wrote {written} in {output}", markup=False, highlight=False, soft_wrap=True)
