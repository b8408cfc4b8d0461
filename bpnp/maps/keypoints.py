"""Keypoints of a photo with their strengths: detected, or read from the features that hloc wrote."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CENTRE = 0.5  # of the first pixel in COLMAP's coordinates; OpenCV and hloc count from 0
MOST_DETECTED = 8192
CONTRAST = 0.02  # of three layers together, of 1: COLMAP's peak_threshold of 0.02 / 3; half of OpenCV's default


class Keypoints(NamedTuple):
    """pixels: (m, 2) in COLMAP's coordinates, (0.5, 0.5) the centre of the first pixel. scores: (m,) strength.

    size: width and height of the photo, pixels; None where it is not known.
    """

    pixels: Array
    scores: Array
    size: tuple[int, int] | None


def detected_keypoints(photo: Path, *, most: int = MOST_DETECTED) -> Keypoints:
    """SIFT keypoints of a photo (Lowe 2004, OpenCV's), one for each place, the score its scale in pixels.

    As faint as COLMAP's, and the `most` largest, of which COLMAP's maps are made too. Large ones are seen again from
    other sides and triangulated, so that the scale tells better than the response which have a partner in a map.
    Raises ValueError for a photo that cannot be read or has no keypoints.
    """
    import cv2

    as_stored = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # as COLMAP reads photos
    image = cv2.imread(str(photo), as_stored)
    if image is None:
        raise ValueError(f"expected a photo that OpenCV can read, got {photo}")
    found = cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True).detect(image)
    rows = np.array([(*point.pt, point.size) for point in found], np.float64).reshape(-1, 3)
    rows = rows[np.argsort(-rows[:, 2], kind="stable")[:most]]
    pixels, first = np.unique(rows[:, :2], axis=0, return_index=True)
    if not len(pixels):
        raise ValueError(f"expected a photo with keypoints, got none in {photo}")
    return Keypoints(pixels + CENTRE, rows[first, 2], (image.shape[1], image.shape[0]))


def read_features(file: Path, photo: str, size: tuple[int, int] | None = None) -> Keypoints:
    """The keypoints of a photo in an HDF5 file of hloc: `<photo>/keypoints` (m, 2), `scores` (m,) if there are some.

    size: of the photo in pixels, to check them by; by default `<photo>/image_size`, if the file has it.
    Raises ValueError, naming file and photo, if it is not in the file, of another size, or a keypoint lies outside it.
    """
    h5py = _h5py()
    try:
        with h5py.File(file, "r") as content:
            if photo not in content or "keypoints" not in content[photo]:
                some = ", ".join(list(content)[:5])
                raise ValueError(f"expected keypoints of {photo} in {file}, got {some}")
            group = content[photo]
            pixels = np.asarray(group["keypoints"], np.float64)
            scores = np.asarray(group["scores"], np.float64) if "scores" in group else np.ones(len(pixels))
            own = tuple(int(value) for value in group["image_size"]) if "image_size" in group else None
    except OSError as error:
        raise ValueError(f"expected an HDF5 file of keypoints or a database of COLMAP, got {file}: {error}") from error
    if pixels.ndim != 2 or pixels.shape[1] != 2 or scores.shape != (len(pixels),):
        raise ValueError(
            f"expected keypoints (m, 2) and scores (m,) of {photo} in {file}, got {pixels.shape} and {scores.shape}"
        )
    if own is not None and size is not None and own != size:
        raise ValueError(f"expected keypoints of {photo} at its size {size} in {file}, got them at {own}")
    known = size or own
    check_inside(pixels + CENTRE, known, f"{photo} in {file}")
    return Keypoints(pixels + CENTRE, scores, known)  # type: ignore[arg-type]


def check_inside(pixels: Array, size: tuple[int, ...] | None, where: str) -> None:
    """Raise ValueError if a keypoint lies outside a photo of this width and height."""
    if size is None or not len(pixels):
        return
    outside = ((pixels < 0) | (pixels > np.array(size))).any(-1)
    if outside.any():
        raise ValueError(
            f"expected keypoints inside the {size[0]} x {size[1]} pixels of {where}, got {int(outside.sum())} outside, "
            f"such as {pixels[outside][0].round(1).tolist()}; try the features of this photo at this size"
        )


def _h5py() -> ModuleType:
    try:
        return importlib.import_module("h5py")  # optional
    except ImportError as error:
        raise ValueError("expected the package h5py, to read HDF5 files, got none; try `pip install h5py`") from error
