"""Conversion of COLMAP models to the 2D and 3D points of every image, as numpy arrays, and of one image to a model."""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.cameras import Camera, Lens, camera_from, colmap_camera, import_pycolmap
from bpnp.datamodules.colmap.model_files import ColmapError, ImageRecord, read_records
from bpnp.files import require_new_folder, write_atomically

NEAR = 1e-4  # least depth, as a fraction of the median; below, float32 cannot separate in front from behind
NOMINAL_FOCAL = 1000.0  # focal length for points without a camera, pixels
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImagePoints:
    """Registered image with its points; camera = rotation p + translation (cam_from_world).

    The last three attributes are empty if keypoints were not read.
    """

    name: str
    image_id: int
    camera: Camera
    rotation: NDArray[np.float64]  # R (3, 3)
    translation: NDArray[np.float64]  # t (3,), scene units
    observed: NDArray[np.int64]  # indices of all 3D points that have a keypoint in the image, ascending
    points2d: NDArray[np.float32]  # normalised, undistorted keypoints (k, 2) of the scene's points3d[seen]
    seen: NDArray[np.int64]  # indices (k,) of the observed points that were not dropped, without repetition
    clutter2d: NDArray[np.float32]  # normalised, undistorted keypoints without a 3D point (c, 2)


@dataclass(frozen=True)
class Reconstruction:
    """COLMAP model."""

    name: str
    points3d: NDArray[np.float64]  # points (n, 3), scene units, in the order of their ids
    images: tuple[ImagePoints, ...]  # images in the order of their names
    lost: Mapping[str, int]  # numbers of keypoints, points and images that could not be used, by reason
    point_ids: NDArray[np.int64]  # ids of the points (n,)

    @property
    def notable(self) -> str:
        """Text on what was lost, without repeated keypoints, which are common."""
        return ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if reason != "repeated keypoints")


def read_reconstruction(folder: str | Path, *, name: str | None = None, keypoints: bool = True) -> Reconstruction:
    """Read a COLMAP model, undistort its keypoints and match them with their 3D points.

    The following are not used, and counted in `lost`: keypoints whose undistortion does not project back to within 0.01
    pixels (outside the field of view of the camera model); matches with a point that is not finite, missing from
    points3D, behind the camera, or nearer than 1e-4 of the image's median depth; a second keypoint of the same point
    (the one of smaller reprojection error is kept); images with a broken pose. All but the repeated keypoints are
    logged as a warning.

    The default name is that of the folder. Without keypoints, images only have the points that they observe, in a tenth
    of the time. Raise ColmapError if a file cannot be read, no image is left, or a camera is missing or broken.
    """
    path = Path(folder)
    records = read_records(path)
    order = np.argsort(records.point_ids)
    ids, points3d = records.point_ids[order], records.points3d[order]
    finite = np.isfinite(points3d).all(-1)
    ids, points3d = ids[finite], points3d[finite]
    if not len(ids):
        raise ColmapError(f"{path} has no finite 3D points; use another model")
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
                raise ColmapError(f"{where} is missing; use another model")
            try:
                cameras[record.camera_id] = colmap_camera(*records.cameras[record.camera_id])
            except ValueError as error:
                raise ColmapError(f"{where}: {error}; use another model") from error
        images.append(_image_points(record, cameras[record.camera_id], ids, points3d, lost, keypoints=keypoints))
    if not images:
        raise ColmapError(f"{path} has no image with a pose; use another model")
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
    index = np.minimum(np.searchsorted(ids, observed), len(ids) - 1)
    observed = index[ids[index] == observed]
    count = None if keypoints else 0
    point_ids, undistorted = record.point_ids[:count], camera.normalise(record.keypoints[:count])
    usable = np.isfinite(undistorted).all(-1)
    lost["keypoints that could not be undistorted"] += int((~usable).sum())

    has_point, index = point_ids >= 0, np.minimum(np.searchsorted(ids, point_ids), len(ids) - 1)
    exists = has_point & (ids[index] == point_ids)
    lost["keypoints of a point that is missing"] += int((has_point & ~exists).sum())

    matched = np.flatnonzero(exists & usable)
    camera_points = points3d[index[matched]] @ rotation.T + record.translation
    depth = camera_points[:, 2]
    in_front = depth > (NEAR * np.median(depth[depth > 0]) if (depth > 0).any() else 0)
    lost["matches with the point behind or in the camera"] += int((~in_front).sum())
    matched, camera_points = matched[in_front], camera_points[in_front]

    error = np.linalg.norm(camera_points[:, :2] / camera_points[:, 2:] - undistorted[matched], axis=-1)
    by_error = np.argsort(error, kind="stable")
    seen, first = np.unique(index[matched[by_error]], return_index=True)
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
    """Write a COLMAP model of one image in text files into a new or empty folder, and return the folder.

    Image points (m, 2) are normalised, `matches` (k, 2) are their indices and those of scene points (n, 3); the pose is
    R (3, 3) and t (3,), camera = R p + t; `camera` is as in `Solution.to_colmap`; the size is in pixels, None if
    unknown. Raise ValueError if the name contains spaces, the camera has skew, or the folder has files.
    """
    if not name or name.split() != [name]:
        raise ValueError(f"`name` is {name!r}; names in COLMAP's text files have no spaces")
    require_new_folder(folder)
    pycolmap = import_pycolmap()
    lens, (rotation, translation) = _colmap_lens(camera, points2d), pose
    pixels = lens.project(np.column_stack([points2d, np.ones(len(points2d))]))
    model = pycolmap.Reconstruction()
    width, height = size or (lens.camera.width, lens.camera.height)
    if not width:
        width, height = np.ceil(np.nanmax(pixels, axis=0)).astype(int).tolist()
    description = {"model": lens.camera.model, "params": lens.camera.params, "width": width, "height": height}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **description))
    projected = np.flatnonzero(np.isfinite(pixels).all(-1))
    number = {int(i): k for k, i in enumerate(projected)}  # number in the image of each projected 2D point
    keypoints = [pycolmap.Point2D(pixel) for pixel in pixels[projected]]
    image = pycolmap.Image(name=name, image_id=1, camera_id=1, points2D=keypoints)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
    match3d = {j: i for i, j in matches.tolist() if i in number}
    reprojected = lens.project(points3d @ rotation.T + translation)
    for j, point in enumerate(points3d):
        track = pycolmap.Track([pycolmap.TrackElement(1, number[match3d[j]])] if j in match3d else [])
        added = model.add_point3D(point, track, np.full(3, 128, np.uint8))
        if j in match3d:
            model.points3D[added].error = float(np.linalg.norm(pixels[match3d[j]] - reprojected[j]))
    with write_atomically(folder) as temporary:
        temporary.mkdir()
        model.write_text(temporary)
    return folder


def _colmap_lens(camera: Any, points2d: NDArray[np.float64]) -> Lens:
    """Return the camera as one of COLMAP's; for None, a pinhole of `NOMINAL_FOCAL` pixels that holds all points."""
    if camera is None:
        half = NOMINAL_FOCAL * np.nanmax(np.abs(points2d), axis=0)
        camera = ("PINHOLE", (NOMINAL_FOCAL, NOMINAL_FOCAL, *half.tolist()))
    lens: Camera = camera_from(camera)
    if not isinstance(lens, Lens):
        matrix = lens.matrix
        if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
            raise ValueError(f"the camera {matrix.tolist()} has skew, which COLMAP's models do not have")
        lens = camera_from(("PINHOLE", (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
    assert isinstance(lens, Lens)
    return lens
