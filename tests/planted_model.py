"""COLMAP models with known points and poses, written by pycolmap."""

import zlib  # noqa: F401
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 800, 600
PINHOLE = ("PINHOLE", [520.0, 520.0, 400.0, 300.0])
OPENCV = ("OPENCV", [520.0, 500.0, 405.0, 290.0, -0.28, 0.09, 0.004, -0.006])


@dataclass(frozen=True)
class Planted:
    """points3d (n, 3) in the order of their ids; of each image its pose, the points it sees, and where: normalised
    coordinates `points2d`, and the pixels of the keypoints without a point."""

    points3d: NDArray[np.float64]
    rotations: list[NDArray[np.float64]]
    translations: list[NDArray[np.float64]]
    seen: list[NDArray[np.int64]]
    points2d: list[NDArray[np.float64]]
    clutter_px: list[NDArray[np.float64]]


def plant_model(
    folder: Path,
    *,
    camera: tuple[str, list[float]] = OPENCV,
    images: int = 3,
    points: int = 60,
    seen: int = 40,
    clutter: int = 12,
    origin: float = 0.0,
    text: bool = False,
    seed: int = 0,
) -> Planted:
    """Write a noise-free model into `folder`: a unit cube of points around `origin`, seen from 3 units away."""
    rng = np.random.default_rng(seed)
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model=camera[0], width=WIDTH, height=HEIGHT, params=camera[1])
    model.add_camera_with_trivial_rig(lens)
    truth = Planted(rng.uniform(-0.5, 0.5, (points, 3)) + origin, [], [], [], [], [])
    tracks = [pycolmap.Track() for _ in range(points)]
    for i in range(images):
        rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        translation = np.array([0.1, -0.2, 3.0]) - rotation @ np.full(3, origin)
        visible = np.sort(rng.choice(points, seen, replace=False))
        camera_points = truth.points3d[visible] @ rotation.T + translation
        true_px = np.asarray(lens.img_from_cam(camera_points))
        clutter_px = rng.uniform((100, 100), (WIDTH - 100, HEIGHT - 100), (clutter, 2))
        for element, j in enumerate(visible):
            tracks[j].add_element(i + 1, element)
        image = pycolmap.Image(f"photo {i}.jpg", np.concatenate([true_px, clutter_px]), 1, i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        model.add_image_with_trivial_frame(image, pose)
        truth.rotations.append(rotation)
        truth.translations.append(translation)
        truth.seen.append(visible)
        truth.points2d.append(camera_points[:, :2] / camera_points[:, 2:])
        truth.clutter_px.append(clutter_px)
    for point, track in zip(truth.points3d, tracks, strict=True):
        model.add_point3D(point, track)
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(folder)
    return truth


def plant_keypoints(database: Path, truth: Planted, views: dict[str, int]) -> None:
    """Write a new database: photos by name, each taken where a view of the model was, with noise of 0.3 pixels."""
    database.unlink(missing_ok=True)
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(database) as content:
        lens = pycolmap.Camera(camera_id=0, model=PINHOLE[0], width=WIDTH, height=HEIGHT, params=PINHOLE[1])
        camera = content.write_camera(lens)
        for name, k in views.items():
            seen = truth.points3d[truth.seen[k]] @ truth.rotations[k].T + truth.translations[k]
            pixels = 520 * seen[:, :2] / seen[:, 2:] + [400, 300] + 0.3 * rng.normal(size=(len(seen), 2))
            number = content.write_image(pycolmap.Image(name=name, camera_id=camera))
            content.write_keypoints(number, pixels.astype(np.float32))
