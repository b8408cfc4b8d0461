"""`bpnp solve`: the pose of a camera from a file of image points and a file of scene points."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bpnp.files import written_whole
from bpnp.localization.point_files import read_camera, read_points
from bpnp.localization.slow_progress import SlowProgress
from bpnp.report.figures import SUFFIXES, save_figure
from bpnp.report.pictures import solution_picture
from bpnp.search.starts import PosePrior
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve

DESCRIPTION = """Where was the camera? Finds its pose from image points and scene points that nobody has matched."""
EPILOG = """The verdict is confident, ambiguous (the other candidates fit about as well), or failed: then the pose is a
guess. Files: docs/solve.md."""
COLOURS = {"confident": "green", "ambiguous": "yellow", "failed": "red"}


def solve_command(arguments: Sequence[str], console: Console | None = None) -> None:
    """`bpnp solve POINTS2D POINTS3D [--camera CAMERA] [--output FILE] [--picture FILE] [--json]`.

    Raises ValueError for input that is not usable, OSError for what cannot be read or written.
    """
    chosen = solve_parser().parse_args(list(arguments))
    points2d = read_points(chosen.points2d)
    points3d = read_points(chosen.points3d, 3, surface=chosen.surface, seed=chosen.seed)
    camera = None if chosen.camera is None else read_camera(chosen.camera)
    prior = None if chosen.prior is None else read_prior(chosen.prior, chosen.prior_degrees, chosen.prior_distance)
    _prepare(chosen.output, chosen.picture)
    with SlowProgress("searching the pose") as progress:
        solution = solve(
            points2d,
            points3d,
            camera,
            solver=chosen.solver,
            prior=prior,
            inlier_threshold=chosen.inlier_threshold,
            clutter=chosen.clutter,
            seed=chosen.seed,
            time_limit=chosen.time_limit,
            device=chosen.device,
            progress=lambda _, batch, __: progress.describe(f"searching the pose, round {batch}"),
        )
    console = console or Console()
    if chosen.json:
        console.print(solution.to_json(), markup=False, highlight=False, soft_wrap=True)
    else:
        console.print(solution_table(solution))
    said = Console(stderr=True) if chosen.json else console
    if chosen.output is not None:
        _say(said, write_text(chosen.output, solution.to_json() + "\n"))
    if chosen.picture is not None:
        _say(said, save_figure(solution_picture(solution, title=chosen.points2d.stem), chosen.picture))


def solve_parser() -> argparse.ArgumentParser:
    """The arguments of `bpnp solve`."""
    parser = argparse.ArgumentParser(prog="bpnp solve", description=DESCRIPTION, epilog=EPILOG, allow_abbrev=False)
    parser.add_argument(
        "points2d", type=Path, metavar="POINTS2D", help=".npy, .csv or .txt: pixels with --camera, else x/z y/z"
    )
    parser.add_argument(
        "points3d", type=Path, metavar="POINTS3D", help=".npy, .csv, .txt, .ply, or a mesh (.obj, .off, .stl, .glb)"
    )
    parser.add_argument("--camera", help="file with a 3x3 matrix, or COLMAP's MODEL,PARAMETERS: SIMPLE_PINHOLE,f,cx,cy")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the solution as JSON")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw it: .png, .svg or .pdf")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--surface", type=int, metavar="COUNT", help="points to draw from a mesh; default: its vertices"
    )
    parser.add_argument("--prior", type=Path, metavar="FILE", help="rough pose: JSON of a solution, or a checkpoint")
    parser.add_argument("--prior-degrees", type=float, default=10.0, help="of its rotation (default: %(default)s)")
    parser.add_argument("--prior-distance", type=float, help="of its translation, scene units (default: unknown)")
    parser.add_argument("--clutter", type=float, metavar="SHARE", help="points without a partner, if known")
    add_search_options(parser)
    return parser


def add_search_options(parser: argparse.ArgumentParser) -> None:
    """The options of a search that `bpnp solve` and `bpnp localize` have in common."""
    parser.add_argument(
        "--solver", default="search", help="search, or the checkpoint of a BPnPNet (default: %(default)s)"
    )
    parser.add_argument(
        "--inlier-threshold", "--inlier_threshold", type=float, help="largest error of a match, px with a camera"
    )
    parser.add_argument("--time-limit", "--time_limit", type=float, metavar="SECONDS", help="of a pair")
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--device", help="such as cuda (default: cpu)")


def read_prior(path: Path, degrees: float, distance: float | None) -> Any:
    """The rough pose in a file with `rotation` and `translation`; the path of anything else, a checkpoint."""
    if path.suffix.lower() != ".json":
        return path
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rotation, translation = (np.array(content[name], np.float64) for name in ("rotation", "translation"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"expected JSON with `rotation` and `translation` in {path}, got {error}") from error
    return PosePrior(rotation, translation, degrees, np.inf if distance is None else distance)


def solution_table(solution: Solution) -> Table:
    """A solution as lines of a table."""
    table = Table(box=box.SIMPLE, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    table.add_row("verdict", Text.assemble((solution.verdict, COLOURS[solution.verdict]), f": {solution.reason}"))
    if solution.found:
        for row, name in zip(solution.rotation, ("rotation", "", ""), strict=True):
            table.add_row(name, _numbers(row))
        table.add_row("translation", _numbers(solution.translation))
        table.add_row("camera centre", _numbers(solution.centre))
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


def write_text(path: Path, text: str) -> Path:
    """Write a file whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")
    return path


def _prepare(output: Path | None, picture: Path | None) -> None:
    """What would make the results unwritable is known before they are sought."""
    if picture is not None and picture.suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a --picture that ends in {', '.join(SUFFIXES)}, got {picture.name!r}")
    for path in (output, picture):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)


def _numbers(values: Any) -> str:
    return "  ".join(f"{value:12.6g}" for value in values)


def _say(console: Console, path: Path) -> None:
    console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
