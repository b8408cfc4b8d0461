"""`bpnp localize`: images of a COLMAP model, solved as if nobody knew where they were taken."""

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.datamodules.colmap.reconstruction import Reconstruction, read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes
from bpnp.localization.from_files import add_search_options, write_text
from bpnp.localization.localized import Localized, images_text, localized, localized_table, summary
from bpnp.localization.slow_progress import SlowProgress
from bpnp.report.figures import save_figure
from bpnp.report.photos import PhotoFinder
from bpnp.report.pictures import picture_box, solution_picture
from bpnp.report.tables import WIDTH
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve

DESCRIPTION = """Solve images of a COLMAP model as if their poses were unknown, and compare with the model's. The scene
is turned at random, so that nothing of a pose leaks into its search."""
EVERYTHING = 1e9  # times the true pairs: all the clutter there is


def localize_command(arguments: Sequence[str], console: Console | None = None) -> None:
    """`bpnp localize --model sparse/0 [--image NAME] [--points seen|clutter|all] [--output FOLDER]`.

    Writes results.json, images.txt (confident poses in the frame of the model) and pictures/<image>.png as it
    goes, so that an interruption loses nothing. Raises ValueError for a model that cannot be read or an unknown image.
    """
    chosen = _parser().parse_args(list(arguments))
    source = image_source(read_reconstruction(chosen.model), chosen.image, chosen.points, chosen.clutter, chosen.seed)
    draw = None if chosen.no_pictures else partial(_draw, *_photos(chosen.model))
    chosen.output.mkdir(parents=True, exist_ok=True)
    done: list[Localized] = []
    with SlowProgress("localizing", total=len(source.images)) as progress:
        for index, (_, image) in enumerate(source.images):
            progress.describe(image.name)
            solution, result = localize_image(source, index, chosen)
            done.append(result)
            _write(chosen.output, done, {"model": str(chosen.model), "points": chosen.points, "seed": chosen.seed})
            if draw is not None:
                draw(solution, result, chosen.output / "pictures")
            progress.advance()
    if console is None:
        console = Console()
        console.width = max(console.width, WIDTH)
    console.print(localized_table(done))
    console.print(summary(done), highlight=False, soft_wrap=True)
    written = ", ".join(["results.json", "images.txt", *([] if draw is None else ["pictures/"])])
    console.print(f"wrote {written} in {chosen.output}", markup=False, highlight=False, soft_wrap=True)


def image_source(scene: Reconstruction, wanted: str, points: str, clutter: float, seed: int) -> ColmapSource:
    """The points of the image `wanted`, or of all: those it sees, these and clutter, or all keypoints and points.

    Raises ValueError if no image, or more than one, has the name or a part of it.
    """
    images = scene.images
    if wanted != "all":
        named = [image for image in images if image.name == wanted] or [im for im in images if wanted in im.name]
        if len(named) != 1:
            some = ", ".join(image.name for image in (named or images)[:10])
            raise ValueError(f"expected the name of one image of {scene.name}, got {wanted!r}; try one of {some}")
        images = tuple(named)
    amount = {"seen": 0.0, "clutter": clutter, "all": EVERYTHING}[points]
    return ColmapSource([replace(scene, images=images)], clutter=amount, rotate=True, seed=seed)


def localize_image(source: ColmapSource, index: int, chosen: argparse.Namespace) -> tuple[Solution, Localized]:
    """Solve an image in its turned scene; what comes back is in the frame of the model."""
    pair, (turn, origin) = source.pair(index, 0), source.frame(index)
    solution = solve(
        pair.focal * pair.points2d.astype(np.float64),
        pair.points3d,
        np.diag([pair.focal, pair.focal, 1.0]),
        solver=chosen.solver,
        inlier_threshold=chosen.inlier_threshold,
        seed=chosen.seed,
        time_limit=chosen.time_limit,
        device=chosen.device,
    )
    return solution, localized(source.images[index][1], pair, solution, turn, origin)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bpnp localize", description=DESCRIPTION, allow_abbrev=False)
    parser.add_argument("--model", type=Path, required=True, metavar="FOLDER", help="COLMAP model, such as sparse/0")
    parser.add_argument("--image", default="all", metavar="NAME", help="one image, or all (default)")
    parser.add_argument(
        "--points",
        choices=("seen", "clutter", "all"),
        default="seen",
        help="which 2D and 3D points to solve: the keypoints with a 3D point and these (default); with --clutter of "
        "the others on both sides; every keypoint and every 3D point",
    )
    parser.add_argument(
        "--clutter", type=float, default=0.25, metavar="RATIO", help="to the true pairs (default: %(default)s)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("runs/localize"), metavar="FOLDER", help="(default: %(default)s)"
    )
    parser.add_argument("--no-pictures", action="store_true", help="write no pictures")
    add_search_options(parser)
    return parser


def _photos(model: Path) -> tuple[str, PhotoFinder]:
    """The name under which the photos of a model are found, and what finds them."""
    (scene,) = (name for models in find_scenes(model).values() for name in models)
    return scene, photo_finder(model)


def _draw(scene: str, find: PhotoFinder, solution: Solution, result: Localized, folder: Path) -> None:
    photo = find(f"{scene}/{result.image}", picture_box(solution.points2d))
    title = f"{result.image}: {result.rotation_error_deg:.3g} deg off"
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", result.image)
    save_figure(solution_picture(solution, title=title, photo=photo), folder / f"{name}.png")


def _write(folder: Path, done: Sequence[Localized], settings: dict[str, object]) -> None:
    content = settings | {"images": [result.as_json() for result in done]}
    write_text(folder / "results.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    write_text(folder / "images.txt", images_text(done))
