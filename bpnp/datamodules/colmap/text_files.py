"""The text form of a COLMAP model, cameras.txt, images.txt and points3D.txt, read by pycolmap.

Source: https://colmap.github.io/format.html
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import read_text_model
from bpnp.datamodules.colmap.model_records import POINT, CameraRecord, ColmapError, ImageRecord

LINES = {"cameras": 1, "images": 2, "points3D": 1}  # of a record


def read_text(
    paths: Sequence[Path], contents: Sequence[bytes]
) -> tuple[dict[int, CameraRecord], list[ImageRecord], NDArray[Any]]:
    """Cameras, images and points in the three files. Raises ColmapError that names the file, or all three."""
    for path, content in zip(paths, contents, strict=True):
        _check_whole(path, content)
    try:
        model = read_text_model(paths[0].parent)
        names = _image_names(contents[1])
        images = [_image(image, names[image.image_id]) for image in model.images.values()]
    except ValueError as error:
        files = f"{paths[0]}, {paths[1].name} and {paths[2].name}"
        raise ColmapError(f"expected a COLMAP model in {files}, got one that pycolmap refuses: {error}") from error
    cameras = {
        key: CameraRecord(camera.model.name, np.array(camera.params), (camera.width, camera.height))
        for key, camera in model.cameras.items()
    }
    points = np.zeros(len(model.points3D), POINT)  # colours and errors stay 0
    found = [(key, point.xyz, point.track.length()) for key, point in model.points3D.items()]
    if found:
        points["point_id"], points["position"], points["track_length"] = zip(*found, strict=True)
    return cameras, images, points


def _check_whole(path: Path, content: bytes) -> None:
    """What pycolmap does not see: that a file was cut between two records, or in the last number.

    The count in COLMAP's header, where there is one, and the line break at the end show it.
    """
    if not content.endswith(b"\n"):
        raise ColmapError(
            f"expected {path} to end with a line break, got {content[-20:]!r}: it looks truncated; try copying the "
            "model again, or add the line break if it is whole"
        )
    header = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
    found = sum(not line.startswith(b"#") for line in content.splitlines()) // LINES[path.stem]
    if header and int(header[1]) > found:
        raise ColmapError(
            f"expected {int(header[1])} records in {path} as its header says, got {found}: it is truncated; try "
            "copying the model again, or correct the header if records were removed on purpose"
        )


def _image_names(content: bytes) -> dict[int, str]:
    """Name of each image by its id; pycolmap 4.2 ends a name at its first space."""
    names = {}
    lines = iter(content.splitlines())
    for line in lines:
        if line.strip() and not line.startswith(b"#"):
            image_id, *_, name = line.split(maxsplit=9)
            names[int(image_id)] = name.rstrip().decode(errors="backslashreplace")
            next(lines, None)  # its keypoints
    return names


def _image(image: Any, name: str) -> ImageRecord:
    pose = image.cam_from_world()
    found = [(point.xy, point.point3D_id) for point in image.points2D]
    keypoints = np.array([xy for xy, _ in found], np.float64).reshape(-1, 2)
    ids = np.array([number for _, number in found], np.uint64).astype(np.int64)  # none: 2^64 - 1
    quaternion = np.roll(pose.rotation.quat, 1)  # pycolmap's has the real part last
    return ImageRecord(name, image.image_id, image.camera_id, quaternion, pose.translation, keypoints, ids)
