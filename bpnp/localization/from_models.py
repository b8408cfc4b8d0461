"""Images of a COLMAP model, solved as if their poses were unknown."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bpnp.datamodules.augment import Augmentation, augment
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.datamodules.colmap.reconstruction import Reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes
from bpnp.datamodules.keyed_random import row_keys
from bpnp.localization.localized import Localized, images_text, localized
from bpnp.localization.solved import write_text
from bpnp.report.figures import save_figure
from bpnp.report.photos import PhotoFinder, picture_box
from bpnp.report.pictures import solution_picture
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve
from bpnp.types import Batch

EVERYTHING = 1e9  # times the true pairs: all the clutter there is


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
    return ColmapSource([replace(scene, images=images)], clutter=amount, seed=(seed,))


def turned_pair(source: ColmapSource, index: int) -> Batch:
    """The points of an image in random order, in a scene that is turned at random; a batch of one."""
    number = torch.tensor([index])
    return augment(source.batch(number, 0), Augmentation(rotate=True), row_keys(number, *source.seed))


def localize_image(source: ColmapSource, index: int, **options: Any) -> tuple[Solution, Localized]:
    """Solve an image in its turned scene; what comes back is in the frame of the model. options: of `bpnp.solve`."""
    pair, image = turned_pair(source, index), source.images[index][1]
    assert pair.rotation is not None
    focal = float(pair.focal)
    pixels = focal * pair.points2d[0].double().numpy()
    solution = solve(pixels, pair.points3d[0].numpy(), np.diag([focal, focal, 1.0]), **options)
    turn = pair.rotation[0].numpy().T @ image.rotation
    return solution, localized(image, pair, solution, turn, source.origins[index])


def model_photos(model: Path) -> tuple[str, PhotoFinder]:
    """The name under which the photos of a model are found, and what finds them."""
    (scene,) = (name for models in find_scenes(model).values() for name in models)
    return scene, photo_finder(model)


def draw_image(scene: str, find: PhotoFinder, solution: Solution, result: Localized, folder: Path) -> None:
    """Draw <image>.png into the folder, over the photo where there is one."""
    box = picture_box(solution.points2d)
    photo = find(f"{scene}/{result.image}", box)
    title = f"{result.image}: {result.rotation_error_deg:.3g} deg off"
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", result.image)
    save_figure(solution_picture(solution, title=title, photo=photo, box=box), folder / f"{name}.png")


def write_localized(folder: Path, done: Sequence[Localized], settings: dict[str, object]) -> None:
    """Write results.json and images.txt, confident poses in the frame of the model."""
    content = settings | {"images": [result.as_json() for result in done]}
    write_text(folder / "results.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    write_text(folder / "images.txt", images_text(done))
