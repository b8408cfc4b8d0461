"""`bpnp solve` and `bpnp verify`: the camera pose from a file of image points and a file of scene points."""

import math
import re
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.files import check_outputs, require_new_folder, write_text
from bpnp.report.terminal import console, format_fixed, number, progress, say

if TYPE_CHECKING:
    from bpnp.search.solution import Candidate, Solution


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
    strict: bool = False,
    verbose: bool = False,
    surface: int | None = None,
    prior: Path | None = None,
    prior_degrees: float = 10.0,
    prior_distance: float | None = None,
    up_camera: tuple[float, float, float] | None = None,
    up_scene: tuple[float, float, float] | None = None,
    up_degrees: float = 2.0,
    clutter: float | None = None,
    solver: str = "auto",
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
    device: str | None = None,
) -> int:
    """Find the camera pose from image points and scene points without correspondences.

    The verdict is one of: confident; ambiguous, if another pose may fit as well; failed, and then the pose is a guess.

    Args:
        points2d: .npy, .csv or .txt with columns x y or u v; pixels with --camera or --image_size, else x/z y/z;
            columns named label, and score (probability of a correspondence).
        points3d: .npy, .csv, .txt, .xyz, .pcd, .ply, or a mesh (.obj, .off, .stl, .glb); columns x y z, nx ny nz,
            label, score; or a COLMAP model (its folder, or points3D.bin or .txt). `-` reads standard input, for
            points2d too.
        camera: file with a 3x3 matrix, YAML of ROS (camera_info) or OpenCV, fx,fy,cx,cy, COLMAP's MODEL,PARAMETERS such
            as SIMPLE_PINHOLE,f,cx,cy, or a COLMAP model with one camera (its folder, or cameras.bin or .txt).
        image: name of the image whose camera is used, if the --camera model has several.
        image_size: WIDTH,HEIGHT or WIDTHxHEIGHT of the image in pixels, if its focal length is unknown; it is found
            with the pose.
        focal_error: relative standard deviation of the focal length of --camera, such as 0.1, if it is not exact.
        distortion: fit a radial coefficient with an unknown focal length even where it is not significantly better.
        output: write the solution as JSON.
        picture: write a picture of it as .png, .jpg, .svg or .pdf.
        photo: the photo, of the size of the --camera or smaller, to draw under the points of --picture.
        colmap: write a COLMAP model of this image to this new folder.
        json: print JSON instead of a table.
        quiet: print only errors, and JSON with --json.
        strict: exit with status 1 unless the verdict is confident; the status is 0 by default.
        verbose: print standard deviations and the scores of the next candidates too, and the traceback of an error.
        surface: number of points to draw from a mesh; its vertices by default.
        prior: rough pose, the JSON of a solution; or a network, packaged weights by name or a checkpoint.
        prior_degrees: standard deviation of its rotation, degrees.
        prior_distance: standard deviation of its translation, scene units; unknown by default.
        up_camera: direction up in the camera (x right, y down, z forward), such as 0 -1 0, if gravity is measured.
        up_scene: the same direction in the scene, such as 0 0 1.
        up_degrees: standard deviation of the direction up, degrees.
        clutter: expected fraction of the image points without a correspondence, below 1; unknown by default.
        solver: auto, which also runs a packaged matcher if the search is not confident; search; or a network, packaged
            weights by name or a checkpoint.
        inlier_threshold: largest error of a match, pixels with a camera, else of x/z, y/z; three times the scale of the
            residuals by default.
        time_limit: time limit in seconds, 10 by default; inf for no limit.
        seed: random seed of the search.
        device: torch device such as cuda; cpu by default.
    """
    from bpnp.commands.point_files import read_camera, read_prior

    if (up_camera is None) != (up_scene is None):
        raise ValueError("give --up_camera and --up_scene together")
    for name, up in (("--up_camera", up_camera), ("--up_scene", up_scene)):
        if up is not None and not any(up):
            raise ValueError(f"{name} is 0 0 0; give a direction, such as 0 0 1")
    if prior is not None and up_camera is not None:
        raise ValueError("give --prior, or --up_camera with --up_scene, not both")
    if image is not None and camera is None:
        raise ValueError(f"--image {image!r} needs a COLMAP model as --camera")
    if photo is not None and (picture is None or camera is None):
        raise ValueError("--photo needs --picture and --camera")
    if picture is not None:
        from bpnp.report.figure_files import check_picture_name, save_figure
        from bpnp.report.images import read_photo, size_in_camera

        check_picture_name(picture, "--picture")
    image_points, scene_points, annotations = _read_sides(points2d, points3d, surface, seed)
    lens = None if camera is None else read_camera(camera, image)
    size = None if image_size is None else _size(image_size)
    background = None if photo is None or picture is None else read_photo(photo)
    if background is not None:
        from bpnp.cameras import camera_from

        width, height = size_in_camera(background, camera_from(lens))
        if isinstance(lens, tuple) and isinstance(lens[0], str) and len(lens) == 2:  # (model, parameters)
            lens = lens[0], width, height, lens[1]
    inputs = [points2d, points3d, prior, photo, *(Path(text) for text in (camera, solver) if text is not None)]
    check_outputs([output, picture], inputs)
    if colmap is not None:
        require_new_folder(colmap)
    pose_prior: Any = None if prior is None else read_prior(prior, prior_degrees, prior_distance)

    # All files have been read: only now import the search.
    from bpnp.search.api import solve as find_pose

    if up_camera is not None and up_scene is not None:
        from bpnp.search.starts import GravityPrior

        pose_prior = GravityPrior(up_camera, up_scene, up_degrees)
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
            prior=pose_prior,
            inlier_threshold=inlier_threshold,
            clutter=clutter,
            seed=seed,
            time_limit=time_limit,
            device=device,
            progress=lambda _, batch, __: shown.update(task, description=f"searching the pose, round {batch}"),
        )
    messages = _print_solution(solution, annotations, json=json, quiet=quiet, verbose=verbose, output=output)
    if picture is not None:
        from bpnp.report.solutions import draw_solution

        figure = draw_solution(solution, title=points2d.stem, photo=background)
        say(f"wrote {save_figure(figure, picture)}", to=messages)
    if colmap is not None:
        written = solution.to_colmap(colmap, name="image.jpg" if photo is None else photo.name)
        say(f"wrote {written}", to=messages)
    return exit_status([solution.verdict], strict=strict)


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
    independent: bool = False,
    as_it_is: bool = False,
    output: Path | None = None,
    page: Path | None = None,
    json: bool = False,
    quiet: bool = False,
    strict: bool = False,
    verbose: bool = False,
    surface: int | None = None,
    inlier_threshold: float | None = None,
    time_limit: float | None = None,
    seed: int = 0,
) -> int:
    """Verify a given pose, and estimate its uncertainty.

    The verdict is one of: confident; ambiguous, if another pose may fit as well; failed, if the pose is not significant
    or another pose fits better.

    `bpnp verify MAP`, with only the folder of a COLMAP model, verifies the pose of each of its images without the
    image's own observations, and prints the least certain first. Its options are --output, --page, --json, --quiet,
    --strict, --time_limit (for each image) and --seed.

    Args:
        points2d: as for bpnp solve; or the folder of a COLMAP model, without other arguments.
        points3d: as for bpnp solve.
        pose: JSON with `rotation` and `translation`, such as that of a solution.
        rotation: the nine numbers of R, row by row, in place of the file; camera = R p + t.
        translation: the three numbers of t.
        camera: as for bpnp solve.
        image: as for bpnp solve.
        matches: .npy, .csv or .txt with two columns, indices of a 2D and of a 3D point, counted from 0.
        independent: the pose was not found on these points, but comes from a survey or another sensor.
        as_it_is: do not refine the pose.
        output: write the solution as JSON; for a model, a file that ends in .json or .csv.
        page: for a model, write the table and a drawing of the map as one .html file.
        json: print JSON instead of a table.
        quiet: print only errors, and JSON with --json.
        strict: exit with status 1 unless the verdict, for a model that of each image, is confident.
        verbose: print standard deviations and the scores of the next candidates too, and the traceback of an error.
        surface: number of points to draw from a mesh; its vertices by default.
        inlier_threshold: largest error of a match, pixels with a camera, else of x/z, y/z; three times the scale of the
            residuals by default.
        time_limit: time limit in seconds, 10 by default; inf for no limit.
        seed: random seed of the local search.
    """
    if points3d is None:
        from bpnp.commands.verifying_maps import verify_images

        of_points: dict[str, Any] = {"rotation": rotation, "translation": translation, "camera": camera, "image": image}
        of_points |= {
            "matches": matches,
            "as_it_is": as_it_is or None,
            "independent": independent or None,
            "surface": surface,
        }
        of_points |= {"inlier_threshold": inlier_threshold}
        if wrong := [name for name, value in of_points.items() if value is not None]:
            raise ValueError(
                f"--{wrong[0]} has no effect on the images of a COLMAP model; name points3d, or leave it out"
            )
        verdicts = verify_images(
            points2d, output=output, page=page, json=json, quiet=quiet, time_limit=time_limit, seed=seed
        )
        return exit_status(verdicts, strict=strict)
    if page is not None:
        raise ValueError("--page needs the folder of a COLMAP model alone: bpnp verify MAP --page FILE.html")
    from bpnp.commands.point_files import read_camera, read_pairs, read_pose

    given_pose: tuple[Any, Any]
    if pose is None and rotation is not None and translation is not None:
        given_pose = [rotation[:3], rotation[3:6], rotation[6:]], translation
    elif pose is not None and rotation is None and translation is None:
        given_pose = read_pose(pose)
    else:
        raise ValueError("give the JSON of a pose, or --rotation and --translation")
    inputs = [points2d, points3d, pose, matches, None if camera is None else Path(camera)]
    check_outputs([output], inputs)
    image_points, scene_points, annotations = _read_sides(points2d, points3d, surface, seed)
    lens = None if camera is None else read_camera(camera, image)
    pairs = None if matches is None else read_pairs(matches)

    # All files have been read: only now import the search.
    from bpnp.search.arguments import checked_pose
    from bpnp.search.verify import verify as judge_pose

    if pose is not None:
        given_pose = checked_pose("pose.", *given_pose)
    with progress(items=False, quiet=quiet) as shown:
        shown.add_task("verifying the pose", total=None)
        solution = judge_pose(
            image_points,
            scene_points,
            given_pose[0],
            given_pose[1],
            lens,
            **annotations,
            matches=pairs,
            independent=independent,
            refine=not as_it_is,
            inlier_threshold=inlier_threshold,
            seed=seed,
            time_limit=time_limit,
        )
    _print_solution(solution, annotations, json=json, quiet=quiet, verbose=verbose, output=output)
    return exit_status([solution.verdict], strict=strict)


def exit_status(verdicts: Iterable[str], *, strict: bool) -> int:
    """Return the exit status of a command: 1 with `--strict` if a verdict is not "confident", else 0."""
    return int(strict and any(verdict != "confident" for verdict in verdicts))


def _read_sides(points2d: Path, points3d: Path, surface: int | None, seed: int) -> tuple[Any, Any, dict[str, Any]]:
    """Return image points, scene points, and the normals, labels and scores that their files have."""
    from bpnp.commands.point_files import read_points2d, read_points3d

    image, scene = read_points2d(points2d), read_points3d(points3d, surface=surface, seed=seed)
    annotations = {"normals3d": scene.normals, "labels2d": image.labels, "labels3d": scene.labels}
    return image.points, scene.points, annotations | {"scores2d": image.scores, "scores3d": scene.scores}


def _print_solution(
    solution: "Solution", annotations: Mapping[str, Any], *, json: bool, quiet: bool, verbose: bool, output: Path | None
) -> Console:
    """Print and write a solution, and return the console for further messages."""
    out = console(json=json, quiet=quiet)
    if json:
        say(solution.to_json())
    else:
        out.print(solution_table(solution, annotations, verbose=verbose))
    if output is not None:
        write_text(output, solution.to_json() + "\n")
        say(f"wrote {output}", to=out)
    return out


def solution_table(
    solution: "Solution", annotations: Mapping[str, Any] | None = None, *, verbose: bool = False
) -> Table:
    """Return a table of verdict, points with their annotations, pose, matches and next candidates.

    `verbose` adds standard deviations and the mean log-likelihoods of the candidates.
    """
    from bpnp.poses import rotation_angle
    from bpnp.report.terminal import VERDICTS

    table = Table(box=box.SIMPLE, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    table.add_row("verdict", Text.assemble((solution.verdict, VERDICTS[solution.verdict]), f": {solution.reason}"))
    present = [name for name, values in (annotations or {}).items() if values is not None]
    image, scene = (", ".join(name[:-2] for name in present if name.endswith(side)) for side in ("2d", "3d"))
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
                "focal length",
                f"{format_fixed([solution.focal_length])[0]} +- {number(solution.focal_length_std)} px, found",
            )
        smaller = min(len(solution.points2d), len(solution.points3d))
        table.add_row("inliers", f"{solution.inlier_count} of {smaller} ({100 * solution.inlier_ratio:.1f} %)")
        table.add_row(
            "reprojection",
            f"{solution.reprojection_error:.3g} {solution.unit} ({solution.reprojection_error_deg:.3g} deg), "
            f"inliers up to {solution.inlier_threshold:.3g} {solution.unit}",
        )
        if verbose and solution.verdict != "failed":
            deviations = f"{number(solution.rotation_std_deg)} deg, centre {number(solution.centre_std)}"
            table.add_row("std deviation", f"rotation {deviations}, about or along the least certain axis")
        next_ones = solution.candidates[1:4]
        degrees = [math.degrees(rotation_angle(solution.rotation, other.rotation)) for other in next_ones]
        figures = [_figures(other, verbose) for other in next_ones]
        others = [f"{away:.3g} deg away: {text}" for away, text in zip(degrees, figures, strict=True)]
        if verbose:
            others = [f"this: {_figures(solution.candidates[0], verbose)}", *others]
        table.add_row("candidates" if verbose else "next candidates", "; ".join(others) or "none")
    if solution.stats.dropped2d:
        table.add_row("left out", f"{solution.stats.dropped2d} 2D points that could not be undistorted")
    table.add_row("seconds", f"{solution.seconds:.2f}")
    return table


def _figures(candidate: "Candidate", verbose: bool) -> str:
    """Return the figures of a candidate; `verbose` adds its mean log-likelihood."""
    score = f", mean log-likelihood {candidate.score:.3f}" if verbose else ""
    return f"{candidate.inlier_count} inliers, log10 NFA {candidate.log10_false_alarms:.1f}{score}"


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(side) for side in re.split("[,x×]", text))
        return width, height
    except ValueError as error:
        raise ValueError(f"--image_size {text!r} is not WIDTH,HEIGHT in pixels, such as 640,480") from error


def _numbers(values: Any) -> str:
    return "  ".join(f"{text:>12}" for text in format_fixed(values.tolist()))


def warm_up() -> None:
    """Compile the loops of the search, once after an installation, so that no later call waits for it."""
    from bpnp.search.find import warm_up as compile_all

    start = time.perf_counter()
    compile_all()
    say(f"compiled in {time.perf_counter() - start:.1f} s")
