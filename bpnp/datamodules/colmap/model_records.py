"""What the files of a COLMAP model hold, as plain numpy arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# A point's track of `track_length` (image, keypoint) follows, 8 bytes each.
POINT = np.dtype(
    [("point_id", "<i8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("track_length", "<u8")]
)


class ColmapError(ValueError):
    """A COLMAP folder or file that cannot be used; the message names it."""


@dataclass(frozen=True)
class CameraRecord:
    model: str
    params: NDArray[np.float64]
    size: tuple[int, int]  # width and height of the image, pixels


@dataclass(frozen=True)
class ImageRecord:
    """quaternion (w, x, y, z) and translation are cam_from_world; keypoints (k, 2) pixels; point_ids (k,), -1: none."""

    name: str
    image_id: int
    camera_id: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    point_ids: NDArray[np.int64]


@dataclass(frozen=True)
class ModelRecords:
    """What the three files hold. points3d (n, 3) has the ids `point_ids` and `track_lengths` observations."""

    cameras: dict[int, CameraRecord]
    images: list[ImageRecord]
    point_ids: NDArray[np.int64]
    points3d: NDArray[np.float64]
    track_lengths: NDArray[np.int64]
