"""Images of a COLMAP model, solved as if their poses were unknown and compared with the model."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.text import Text

from bpnp.cameras import Pinhole
from bpnp.datamodules.augment import Augmentation, augment
from bpnp.datamodules.colmap.pairs import ColmapSource
from bpnp.datamodules.colmap.photos import photo_finder
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction, read_reconstruction
from bpnp.datamodules.colmap.scenes import find_scenes
from bpnp.datamodules.keyed_random import row_keys
from bpnp.files import write_text
from bpnp.metrics.errors import centre_error, rotation_error
from bpnp.report.figures import save_figure
from bpnp.report.palette import VERDICTS
from bpnp.report.photos import PhotoFinder, picture_box
from bpnp.report.tables.fitted_table import FittedTable
from bpnp.report.tables.rows import number
from bpnp.solving.pictures import pose_text, solution_picture
from bpnp.solving.solution import Solution
from bpnp.solving.solve import solve
from bpnp.types import Batch

EVERYTHING = 1e9  # times the true pairs: all the clutter there is
RIGHT_DEG = 1.0
HEADER = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
"""


@dataclass(frozen=True)
class Localized:
    """One image, its solution in the turned scene, and the pose in the model's frame: camera = R p + t, NaN if none.

    rotation_error_deg, centre_error (model units): against the model's pose; 180 and infinity without a pose.
    right_matches: share of the matches that are the model's.
    """

    image: ImagePoints
    solution: Solution
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    rotation_error_deg: float
    centre_error: float
    right_matches: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; null for what is not finite."""
        own, image = self.solution, self.image
        rotation, translation = (self.rotation.tolist(), self.translation.tolist()) if own.found else (None, None)
        values = {
            "image": image.name, "image_id": image.image_id, "camera_id": image.camera_id, "verdict": own.verdict,
            "reason": own.reason, "rotation": rotation, "translation": translation,
            "rotation_error_deg": self.rotation_error_deg, "centre_error": self.centre_error,
            "count2d": len(own.points2d), "count3d": len(own.points3d), "inlier_count": own.inlier_count,
            "inlier_ratio": own.inlier_ratio, "right_matches": self.right_matches,
            "reprojection_error_px": own.reprojection_error, "seconds": own.seconds,
        }  # fmt: skip
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def read_model(folder: Path) -> tuple[Reconstruction, PhotoFinder]:
    """A model, or the only one of a scene, and what finds its photos, by the name of the scene and of the image.

    Photos lie beside the model. Raises ValueError for a folder of several models that is none itself.
    """
    names = {path: name for models in find_scenes(folder).values() for name, path in models.items()}
    model = folder.absolute() if folder.absolute() in names else next(iter(names))
    if model != folder.absolute() and len(names) > 1:
        raise ValueError(f"expected one COLMAP model as --model, got {len(names)} below {folder}; try {model}")
    return read_reconstruction(model, name=names[model]), photo_finder(folder)


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


def localize_image(source: ColmapSource, index: int, **options: Any) -> Localized:
    """Solve an image in its turned scene, in which p of the model is turn (p - origin). options: of `bpnp.solve`."""
    pair, image = turned_pair(source, index), source.images[index][1]
    assert pair.rotation is not None
    assert pair.match3d is not None
    undistorted = Pinhole(image.camera.matrix)
    pixels = undistorted.project(np.pad(pair.points2d[0].double().numpy(), ((0, 0), (0, 1)), constant_values=1))
    solution = solve(pixels, pair.points3d[0].numpy(), undistorted, **options)
    rotation = solution.rotation @ pair.rotation[0].numpy().T @ image.rotation
    translation = solution.translation - rotation @ source.origins[index]
    estimate = torch.as_tensor(rotation)[None], torch.as_tensor(translation)[None]
    truth = torch.as_tensor(image.rotation)[None], torch.as_tensor(image.translation)[None]
    right = pair.match3d[0].numpy()[solution.matches[:, 1]] == solution.matches[:, 0]
    return Localized(
        image, solution, rotation, translation, float(rotation_error(estimate[0], truth[0])),
        float(centre_error(*estimate, *truth)), float(right.mean()) if len(right) else 0.0,
    )  # fmt: skip


def draw_image(find: PhotoFinder, scene: Reconstruction, result: Localized, folder: Path) -> None:
    """Draw <image>.png into the folder, over the photo where there is one."""
    name, solution = result.image.name, result.solution
    box = picture_box(solution.points2d)
    title = f"{name}: {result.rotation_error_deg:.3g} deg off"
    figure = solution_picture(solution, title=title, photo=find(f"{scene.name}/{name}", box), box=box)
    save_figure(figure, folder / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', name)}.png")


def write_localized(folder: Path, done: Sequence[Localized], settings: dict[str, object]) -> None:
    """Write results.json, and COLMAP's images.txt with the confident poses in the frame of the model, no keypoints."""
    content = settings | {"images": [result.as_json() for result in done]}
    write_text(folder / "results.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    lines = [
        f"{own.image.image_id} {pose_text(own.rotation, own.translation)} {own.image.camera_id} {own.image.name}\n\n"
        for own in done
        if own.solution.verdict == "confident"
    ]
    write_text(folder / "images.txt", f"{HEADER}# Number of images: {len(lines)}\n{''.join(lines)}")


def localized_table(done: Sequence[Localized]) -> FittedTable:
    """A row per image."""
    headers = ("2D", "3D", "verdict", "rot\ndeg", "centre\nunits", "inlier\n%", "right\n%", "error\npx", "sec")
    rows = []
    for result in done:
        own = result.solution
        counts = (Text(str(len(own.points2d))), Text(str(len(own.points3d))), Text(own.verdict, VERDICTS[own.verdict]))
        errors = (number(result.rotation_error_deg), number(result.centre_error))
        shares = (f"{100 * own.inlier_ratio:.0f}", f"{100 * result.right_matches:.0f}")
        cells = (*errors, *shares, number(own.reprojection_error), number(own.seconds))
        rows.append((Text(result.image.name), [*counts, *map(Text, cells)]))
    return FittedTable("", headers, [rows])


def summary(done: Sequence[Localized]) -> str:
    """How many are right, and how many that claim to be are not."""
    errors = np.array([result.rotation_error_deg for result in done])
    verdicts = np.array([result.solution.verdict for result in done])
    counts = ", ".join(f"{(verdicts == verdict).sum()} {verdict}" for verdict in VERDICTS)
    wrong = int(((errors >= RIGHT_DEG) & (verdicts == "confident")).sum())
    return (
        f"{len(done)} images: {100 * (errors < RIGHT_DEG).mean():.1f} % under {RIGHT_DEG:g} deg, median "
        f"{number(float(np.median(errors)))} deg; {counts}; confident and wrong: {wrong}"
    )
