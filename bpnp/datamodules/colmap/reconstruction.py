"""From COLMAP models to the 2D and 3D points of every image, as numpy arrays; and from those of an image to a model."""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.cameras import Camera, Lens, camera_from, colmap_camera
from bpnp.datamodules.colmap.model_files import ColmapError, ImageRecord, read_records
from bpnp.files import write_atomically

NEAR = 1e-4  # of the median depth; float32 cannot tell in front from behind much below
NOMINAL_FOCAL = 1000.0  # pixels, of points without a camera
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImagePoints:
    """One registered image; camera = rotation p + translation (cam_from_world), 2D points normalised and undistorted.

    observed: every 3D point the image has a keypoint of, ascending. points2d (k, 2) sees the scene's points3d[seen],
    seen (k,) the observed points that were not dropped, without repetition. clutter2d (c, 2): the keypoints without a
    3D point. The last three are empty where keypoints were not read.
    """

    name: str
    image_id: int
    camera: Camera
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    observed: NDArray[np.int64]
    points2d: NDArray[np.float32]
    seen: NDArray[np.int64]
    clutter2d: NDArray[np.float32]


@dataclass(frozen=True)
class Reconstruction:
    """A COLMAP model: points3d (n, 3) in scene units in the order of their ids, images in the order of their names.

    point_ids: (n,) of the points. lost: how many keypoints, points and images could not be used, by reason.
    """

    name: str
    points3d: NDArray[np.float64]
    images: tuple[ImagePoints, ...]
    lost: Mapping[str, int]
    point_ids: NDArray[np.int64]

    @property
    def notable(self) -> str:
        """What was lost in words, but for repeated keypoints, which are common."""
        return ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if reason != "repeated keypoints")


def read_reconstruction(folder: str | Path, *, name: str | None = None, keypoints: bool = True) -> Reconstruction:
    """Read the COLMAP model in `folder`, undistort its keypoints and match them with their 3D points.

    keypoints: whether to read them at all; without, images know the points that they observe, in a tenth of the time.

    Not used, and counted in `lost`: keypoints whose undistortion does not project back to within 0.01 pixels (outside
    the field of view of the camera model); matches with a point that is not finite, missing from points3D, behind the
    camera, or nearer than 1e-4 of the image's median depth; a second keypoint of the same point (the one of smaller
    reprojection error is kept); images with a broken pose. All but the repeated keypoints, which are common, are
    logged as a warning.

    Raises ColmapError if a file cannot be read, no image is left, or a camera is missing or broken.
    """
    path = Path(folder)
    records = read_records(path)
    order = np.argsort(records.point_ids)
    ids, points3d = records.point_ids[order], records.points3d[order]
    finite = np.isfinite(points3d).all(-1)
    ids, points3d = ids[finite], points3d[finite]
    if not len(ids):
        raise ColmapError(f"expected 3D points in {path}, got none that is finite; try another model")
    lost = Counter({"points that are not finite": int((~finite).sum())})
    cameras: dict[int, Camera] = {}
    images = []
    for record in sorted(records.images, key=lambda image: image.name):
        pose = np.concatenate([record.quaternion, record.translation])
        if not np.isfinite(pose).all() or not record.quaternion.any():
            lost["images with a broken pose"] += 1
            continue
        if record.camera_id not in cameras:
            where = f"camera {record.camera_id} of image {record.name!r} in {path}"
            if record.camera_id not in records.cameras:
                raise ColmapError(f"expected {where}, got no such camera; try another model")
            try:
                cameras[record.camera_id] = colmap_camera(*records.cameras[record.camera_id])
            except ValueError as error:
                raise ColmapError(f"{where}: {error}; try another model") from error
        images.append(_image_points(record, cameras[record.camera_id], ids, points3d, lost, keypoints=keypoints))
    if not images:
        raise ColmapError(f"expected at least one image with a pose in {path}, got none; try another model")
    reconstruction = Reconstruction(path.name if name is None else name, points3d, tuple(images), dict(+lost), ids)
    if reconstruction.notable:
        logger.warning("not used in %s: %s", path, reconstruction.notable)
    return reconstruction


def _image_points(
    record: ImageRecord,
    camera: Camera,
    ids: NDArray[np.int64],
    points3d: NDArray[np.float64],
    lost: Counter[str],
    *,
    keypoints: bool,
) -> ImagePoints:
    rotation = Rotation.from_quat(np.roll(record.quaternion, -1)).as_matrix()
    observed = np.unique(record.point_ids[record.point_ids >= 0])
    place = np.minimum(np.searchsorted(ids, observed), len(ids) - 1)
    observed = place[ids[place] == observed]
    count = None if keypoints else 0
    point_ids, undistorted = record.point_ids[:count], camera.normalise(record.keypoints[:count])
    usable = np.isfinite(undistorted).all(-1)
    lost["keypoints that could not be undistorted"] += int((~usable).sum())

    has_point, place = point_ids >= 0, np.minimum(np.searchsorted(ids, point_ids), len(ids) - 1)
    known = has_point & (ids[place] == point_ids)
    lost["keypoints of a point that is missing"] += int((has_point & ~known).sum())

    matched = np.flatnonzero(known & usable)
    camera_points = points3d[place[matched]] @ rotation.T + record.translation
    depth = camera_points[:, 2]
    in_front = depth > (NEAR * np.median(depth[depth > 0]) if (depth > 0).any() else 0)
    lost["matches with the point behind or in the camera"] += int((~in_front).sum())
    matched, camera_points = matched[in_front], camera_points[in_front]

    error = np.linalg.norm(camera_points[:, :2] / camera_points[:, 2:] - undistorted[matched], axis=-1)
    by_error = np.argsort(error, kind="stable")
    seen, first = np.unique(place[matched[by_error]], return_index=True)
    lost["repeated keypoints"] += len(matched) - len(seen)
    points2d, clutter2d = undistorted[matched[by_error[first]]], undistorted[~has_point & usable]
    pose, sides = (rotation, record.translation), (points2d.astype(np.float32), seen, clutter2d.astype(np.float32))
    return ImagePoints(record.name, record.image_id, camera, *pose, observed, *sides)


def write_image(
    folder: Path,
    points2d: NDArray[np.float64],
    points3d: NDArray[np.float64],
    matches: NDArray[np.int64],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    camera: Any,
    name: str,
    size: tuple[int, int] | None,
) -> Path:
    """Write a COLMAP model of one image in text files: normalised points (m, 2) and (n, 3), places (k, 2) of those that
    match, and rotation and translation; camera, name and size are those of `Solution.to_colmap`."""
    if not name or name.split() != [name]:
        raise ValueError(f"expected a `name` without spaces, which COLMAP's text files do not hold, got {name!r}")
    import pycolmap  # after bpnp.cameras, which loads zlib before it

    lens, (rotation, translation) = _colmap_lens(camera, points2d), pose
    pixels = lens.project(np.column_stack([points2d, np.ones(len(points2d))]))
    model = pycolmap.Reconstruction()
    width, height = size or (lens.camera.width, lens.camera.height)
    if not width:
        width, height = np.ceil(np.nanmax(pixels, axis=0)).astype(int).tolist()
    described = {"model": lens.camera.model, "params": lens.camera.params, "width": width, "height": height}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **described))
    projected = np.flatnonzero(np.isfinite(pixels).all(-1))
    number = {int(i): k for k, i in enumerate(projected)}  # of the 2D points that the image has
    seen = [pycolmap.Point2D(pixel) for pixel in pixels[projected]]
    image = pycolmap.Image(name=name, image_id=1, camera_id=1, points2D=seen)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
    partner = {j: i for i, j in matches.tolist() if i in number}
    reprojected = lens.project(points3d @ rotation.T + translation)
    for j, point in enumerate(points3d):
        track = pycolmap.Track([pycolmap.TrackElement(1, number[partner[j]])] if j in partner else [])
        added = model.add_point3D(point, track, np.full(3, 128, np.uint8))
        if j in partner:
            model.points3D[added].error = float(np.linalg.norm(pixels[partner[j]] - reprojected[j]))
    with write_atomically(folder) as temporary:
        temporary.mkdir()
        model.write_text(temporary)
    return folder


def _colmap_lens(camera: Any, points2d: NDArray[np.float64]) -> Lens:
    """The camera as one of COLMAP's; without one a pinhole of `NOMINAL_FOCAL` pixels that holds all points."""
    if camera is None:
        half = NOMINAL_FOCAL * np.nanmax(np.abs(points2d), axis=0)
        camera = ("PINHOLE", (NOMINAL_FOCAL, NOMINAL_FOCAL, *half.tolist()))
    lens: Camera = camera_from(camera)
    if not isinstance(lens, Lens):
        matrix = lens.matrix
        if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
            raise ValueError(f"expected a camera without skew, which COLMAP has none of, got {matrix.tolist()}")
        lens = camera_from(("PINHOLE", (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
    assert isinstance(lens, Lens)
    return lens
