"""`bpnp solve` and `bpnp verify`: the pose of a camera from a file of image points and a file of scene points."""

import re
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.files import require_new_folder, write_text
from bpnp.report.terminal import console, fixed, number, progress, say

if TYPE_CHECKING:
    from bpnp.solving.solution import Solution


def solve(
    points2d: Path,
    points3d: Path,
    *,
    camera: str | None = None,
    image: str | None = None,
    image_size: str | None = None,
    focal_error: float | None = None,
    distortion: bool = False,
    output: Path | None = None,
    picture: Path | None = None,
    photo: Path | None = None,
    colmap: Path | None = None,
    json: bool = False,
    quiet: bool = False,
    surface: int | None = None,
    prior: Path | None = None,
    prior_degrees: float = 10.0,
    prior_distance: float | None = None,
    up_camera: tuple[float, float, float] | None = None,
    up_scene: tuple[float, float, float] | None = None,
    up_degrees: float = 2.0,
    clutter: float | None = None,
    at_infinity: bool = False,
    solver: str = "auto",
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
    device: str | None = None,
) -> None:
    """Find the pose of a camera from image points and scene points that nobody has matched.

    The verdict is confident, ambiguous (the other candidates fit about as well), or failed: then the pose is a guess.
    The kinds of files stand under points2d and points3d.

    Args:
        points2d: .npy, .csv or .txt with columns x y or u v; pixels with --camera or --image_size, else x/z y/z; a
            column named label.
        points3d: .npy, .csv, .txt, .ply, or a mesh (.obj, .off, .stl, .glb); columns x y z, nx ny nz, label; or a
            COLMAP model (its folder, or points3D.bin or .txt). `-` reads standard input, here and above.
        camera: file with a 3x3 matrix, COLMAP's MODEL,PARAMETERS such as SIMPLE_PINHOLE,f,cx,cy, or a COLMAP model with
            one camera (its folder, or cameras.bin or .txt).
        image: name of the image whose camera to take, where the --camera model has several.
        image_size: WIDTH,HEIGHT or WIDTHxHEIGHT of the image in pixels, where its focal length is unknown: it is found
            with the pose.
        focal_error: standard deviation of the focal length of --camera where that is rough, as a share of it.
        distortion: fit a radial coefficient with an unknown focal length even where it is not significantly better.
        output: write the solution as JSON.
        picture: draw it as .png, .svg or .pdf.
        photo: the photo, of the size of the --camera or smaller, under the points of --picture.
        colmap: new folder to write, a COLMAP model of this image.
        json: print JSON instead of a table.
        quiet: print nothing but errors, and JSON if asked for.
        surface: points to draw from a mesh; its vertices by default.
        prior: rough pose, the JSON of a solution; or a network, packaged weights by name or a checkpoint.
        prior_degrees: standard deviation of its rotation, degrees.
        prior_distance: standard deviation of its translation, scene units; unknown by default.
        up_camera: direction up in the camera (x right, y down, z forward), such as 0 -1 0, if gravity is known.
        up_scene: the same direction in the scene, such as 0 0 1.
        up_degrees: standard deviation of the direction up, degrees.
        clutter: share of the points without a partner, if known.
        at_infinity: points3d are unit directions, such as of stars; the rotation alone is found.
        solver: auto, which asks a packaged matcher when the search is in doubt; search; or a
            network, packaged weights by name or a checkpoint.
        inlier_threshold: largest error of a match, pixels with a camera, else of x/z, y/z; three
            times the residuals' scale by default.
        time_limit: seconds, 10 by default; inf for no limit.
        seed: of the search.
        device: such as cuda; cpu by default.
    """
    from bpnp.cameras import camera_from
    from bpnp.commands.point_files import read_camera, read_prior
    from bpnp.search.starts import GravityPrior
    from bpnp.solving.solve import solve as find_pose

    if (up_camera is None) != (up_scene is None):
        raise ValueError("expected --up_camera and --up_scene together, got one of them")
    if prior is not None and up_camera is not None:
        raise ValueError("expected --prior or --up_camera with --up_scene, got both")
    if image is not None and camera is None:
        raise ValueError(f"expected --image with a COLMAP model as --camera, got {image!r} alone")
    if photo is not None and (picture is None or camera is None):
        raise ValueError("expected --photo with --picture and --camera, got it without")
    if picture is not None:
        from bpnp.report.figures import (  # matplotlib, where something is drawn
            SUFFIXES,
            read_photo,
            save_figure,
            size_in_camera,
        )
        from bpnp.solving.solution import solution_picture

        if picture.suffix.lower() not in SUFFIXES:
            raise ValueError(f"expected a --picture that ends in {', '.join(SUFFIXES)}, got {picture.name!r}")
    known: Any = None if prior is None else read_prior(prior, prior_degrees, prior_distance)
    if up_camera is not None and up_scene is not None:
        known = GravityPrior(up_camera, up_scene, up_degrees)
    image_points, scene_points, annotations = _read_sides(points2d, points3d, surface, seed)
    lens = None if camera is None else read_camera(camera, image)
    size = None if image_size is None else _size(image_size)
    under = None if photo is None or picture is None else read_photo(photo)
    if under is not None:
        size_in_camera(under, camera_from(lens))
    inputs = [points2d, points3d, prior, photo, *(Path(text) for text in (camera, solver) if text is not None)]
    _check_outputs([output, picture], inputs)
    if colmap is not None:
        require_new_folder(colmap)
    with progress(items=False, quiet=quiet) as shown:
        task = shown.add_task("searching the pose", total=None)
        solution = find_pose(
            image_points,
            scene_points,
            lens,
            image_size=size,
            focal_error=focal_error,
            distortion=distortion,
            **annotations,
            solver=solver,
            prior=known,
            inlier_threshold=inlier_threshold,
            clutter=clutter,
            at_infinity=at_infinity,
            seed=seed,
            time_limit=time_limit,
            device=device,
            progress=lambda _, batch, __: shown.update(task, description=f"searching the pose, round {batch}"),
        )
    said = _tell(solution, annotations, json=json, quiet=quiet, output=output)
    if picture is not None:
        figure = solution_picture(solution, title=points2d.stem, photo=under)
        say(f"wrote {save_figure(figure, picture)}", to=said)
    if colmap is not None:
        written = solution.to_colmap(colmap, name="image.jpg" if photo is None else photo.name)
        say(f"wrote {written}", to=said)


def verify(
    points2d: Path,
    points3d: Path | None = None,
    pose: Path | None = None,
    *,
    rotation: tuple[float, float, float, float, float, float, float, float, float] | None = None,
    translation: tuple[float, float, float] | None = None,
    camera: str | None = None,
    image: str | None = None,
    matches: Path | None = None,
    as_it_is: bool = False,
    output: Path | None = None,
    page: Path | None = None,
    json: bool = False,
    quiet: bool = False,
    surface: int | None = None,
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
) -> None:
    """Say whether a pose from elsewhere is right, and how well it is known.

    confident; ambiguous (something else may fit as well); or failed: it fits no better than chance, or another pose
    fits better. Files: as for `bpnp solve`.

    `bpnp verify MAP`, with the folder of a COLMAP model alone, verifies the pose of each of its images without the
    image's own observations, and prints the most doubtful first. Its options are --output, --page, --json,
    --quiet, --time_limit (an image) and --seed.

    Args:
        points2d: as for bpnp solve; or the folder of a COLMAP model, without other arguments.
        points3d: as for bpnp solve.
        pose: JSON with `rotation` and `translation`, such as that of a solution.
        rotation: the nine numbers of R, row by row, in place of the file; camera = R p + t.
        translation: the three numbers of t.
        camera: as for bpnp solve.
        image: as for bpnp solve.
        matches: .npy, .csv or .txt with two columns, places of a 2D and of a 3D point, counted from 0.
        as_it_is: do not refine the pose.
        output: write the solution as JSON; of a model a file that ends in .json or .csv.
        page: of a model, write the table and a drawing of the map as one .html file.
        json: print JSON instead of a table.
        quiet: print nothing but errors, and JSON if asked for.
        surface: points to draw from a mesh; its vertices by default.
        inlier_threshold: largest error of a match, pixels with a camera, else of x/z, y/z; three
            times the residuals' scale by default.
        time_limit: seconds, 10 by default; inf for no limit.
        seed: of the search around the pose.
    """
    if points3d is None:
        from bpnp.commands.verifying_maps import verify_images

        of_points: dict[str, Any] = {"rotation": rotation, "translation": translation, "camera": camera, "image": image}
        of_points |= {"matches": matches, "as_it_is": as_it_is or None, "surface": surface}
        of_points |= {"inlier_threshold": inlier_threshold}
        if wrong := [name for name, value in of_points.items() if value is not None]:
            raise ValueError(
                f"--{wrong[0]} has no effect on the images of a COLMAP model; name points3d, or leave it out"
            )
        verify_images(points2d, output=output, page=page, json=json, quiet=quiet, time_limit=time_limit, seed=seed)
        return
    if page is not None:
        raise ValueError("--page needs the folder of a COLMAP model alone: bpnp verify MAP --page FILE.html")
    from bpnp.commands.point_files import read_camera, read_pairs, read_pose
    from bpnp.solving.verify import verify as judge_pose

    judged: tuple[Any, Any]
    if pose is None and rotation is not None and translation is not None:
        judged = [rotation[:3], rotation[3:6], rotation[6:]], translation
    elif pose is not None and rotation is None and translation is None:
        judged = read_pose(pose)
    else:
        raise ValueError("expected the JSON of a pose, or --rotation and --translation")
    inputs = [points2d, points3d, pose, matches, None if camera is None else Path(camera)]
    _check_outputs([output], inputs)
    image_points, scene_points, annotations = _read_sides(points2d, points3d, surface, seed)
    with progress(items=False, quiet=quiet) as shown:
        shown.add_task("looking around the pose", total=None)
        solution = judge_pose(
            image_points,
            scene_points,
            judged[0],
            judged[1],
            None if camera is None else read_camera(camera, image),
            **annotations,
            matches=None if matches is None else read_pairs(matches),
            refine=not as_it_is,
            inlier_threshold=inlier_threshold,
            seed=seed,
            time_limit=time_limit,
        )
    _tell(solution, annotations, json=json, quiet=quiet, output=output)


def _check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None]) -> None:
    """Raise ValueError for a file that cannot be written, or that is an input; their folders are made."""
    read = {path.resolve() for path in inputs if path is not None and path.is_file()}
    for path in outputs:
        if path is None:
            continue
        if path.is_dir():
            raise ValueError(f"expected a file to write to, got the folder {path}; try a name in it")
        if path.resolve() in read:
            raise ValueError(f"{path} is an input and would be overwritten; name another file")
        path.parent.mkdir(parents=True, exist_ok=True)


def _read_sides(points2d: Path, points3d: Path, surface: int | None, seed: int) -> tuple[Any, Any, dict[str, Any]]:
    """Image points, scene points, and the normals and labels that their files have."""
    from bpnp.commands.point_files import read_points2d, read_points3d

    seen, labels2d = read_points2d(points2d)
    scene, normals3d, labels3d = read_points3d(points3d, surface=surface, seed=seed)
    return seen, scene, {"normals3d": normals3d, "labels2d": labels2d, "labels3d": labels3d}


def _tell(
    solution: "Solution", annotations: Mapping[str, Any], *, json: bool, quiet: bool, output: Path | None
) -> Console:
    """Print and write a solution, and return the console for what else was written."""
    out = console(json=json, quiet=quiet)
    if json:
        say(solution.to_json())
    else:
        out.print(solution_table(solution, annotations))
    if output is not None:
        write_text(output, solution.to_json() + "\n")
        say(f"wrote {output}", to=out)
    return out


def solution_table(solution: "Solution", annotations: Mapping[str, Any] | None = None) -> Table:
    """Return a table of verdict, pose, matches and next candidates, and of which `annotations` the points have."""
    from bpnp.report.terminal import VERDICTS

    table = Table(box=box.SIMPLE, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    table.add_row("verdict", Text.assemble((solution.verdict, VERDICTS[solution.verdict]), f": {solution.reason}"))
    given = [name for name, values in (annotations or {}).items() if values is not None]
    image, scene = (", ".join(name[:-2] for name in given if name.endswith(side)) for side in ("2d", "3d"))
    counts = f"{len(solution.points2d)} image points", f"{len(solution.points3d)} scene points"
    sides = (f"{count} with {kinds}" if kinds else count for count, kinds in zip(counts, (image, scene), strict=True))
    table.add_row("points", ", ".join(sides))
    if solution.found:
        for name, row in zip(("rotation", "", ""), solution.rotation, strict=True):
            table.add_row(name, "  ".join(f"{value:12.6f}" for value in row))
        table.add_row("translation", _numbers(solution.translation))
        table.add_row("camera centre", _numbers(solution.centre))
        if solution.focal_length_std:
            table.add_row(
                "focal length", f"{fixed([solution.focal_length])[0]} +- {number(solution.focal_length_std)} px, found"
            )
        smaller = min(len(solution.points2d), len(solution.points3d))
        table.add_row("inliers", f"{solution.inlier_count} of {smaller} ({100 * solution.inlier_ratio:.1f} %)")
        table.add_row(
            "reprojection",
            f"{solution.reprojection_error:.3g} {solution.unit} ({solution.reprojection_error_deg:.3g} deg), "
            f"inliers up to {solution.inlier_threshold:.3g} {solution.unit}",
        )
        others = [f"{c.inlier_count} inliers, score {c.score:.3f}" for c in solution.candidates[1:4]]
        table.add_row("next candidates", "; ".join(others) or "none")
    if solution.stats.dropped2d:
        table.add_row("left out", f"{solution.stats.dropped2d} 2D points that could not be undistorted")
    table.add_row("seconds", f"{solution.seconds:.2f}")
    return table


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(side) for side in re.split("[,x×]", text))
        return width, height
    except ValueError as error:
        raise ValueError(f"expected --image_size as WIDTH,HEIGHT in pixels, such as 640,480, got {text!r}") from error


def _numbers(values: Any) -> str:
    return "  ".join(f"{text:>12}" for text in fixed(values.tolist()))


def warm_up() -> None:
    """Compile the loops of the search, once after an installation, so that no later call waits for it."""
    from bpnp.search.search import warm_up as compile_all

    start = time.perf_counter()
    compile_all()
    say(f"compiled in {time.perf_counter() - start:.1f} s")
