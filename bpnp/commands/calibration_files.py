"""Cameras in YAML files: ROS's camera_info, as a file or as a printed topic, and OpenCV's calibration."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bpnp.bounded_files import MOST_YAML, parse_yaml
from bpnp.cameras import opencv_model

MATRIX, DISTORTION = ("camera_matrix", "K", "k"), ("distortion_coefficients", "D", "d")
FISHEYE = ("equidistant", "fisheye")  # names of OpenCV's fisheye model with k1, k2, k3, k4
BROWN = ("plumb_bob", "rational_polynomial")  # names of OpenCV's model with k1, k2, p1, p2, k3, ...
KEY = re.compile(rf"^[\s{{\"']*({'|'.join(MATRIX)})[\"']?\s*:", re.MULTILINE)
SIZES = (("image_width", "image_height"), ("width", "height"))
Calibrated = tuple[str, int, int, list[float]]  # COLMAP model, width, height (0 if unknown), parameters


def is_calibration(text: str) -> bool:
    """Return True for a text with the key of a camera matrix."""
    return KEY.search(text) is not None


def parse_calibration(text: str, *, centre: float = 0.0) -> Calibrated:
    """Parse ROS's camera_info or OpenCV's calibration, YAML or JSON: the camera of the raw image, with its distortion.

    Of several documents, such as the messages of a topic, the first is read. `centre` is the coordinate of the centre
    of the first pixel in the image points; it is 0 in these files. Raise ValueError for no calibrated camera, or an
    unknown distortion.
    """
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    starts = [i for i, line in enumerate(lines) if re.fullmatch(r"(---|\.\.\.)\s*", line)]
    begin = next((i for i, line in enumerate(lines) if i not in starts and line.strip()), 0)
    first = "\n".join(lines[begin : next((i for i in starts if i > begin), None)])
    if len(first) > MOST_YAML:
        raise ValueError(f"it has more than the {MOST_YAML} bytes that are read of a calibration")
    content = parse_yaml(re.sub(r"!!opencv-[a-z-]+", "", first))
    if not isinstance(content, Mapping) or not set(MATRIX) & set(content):
        raise ValueError(f"it has none of the keys {', '.join(MATRIX)}")
    matrix = _numbers(content, MATRIX)
    if matrix.size != 9:
        raise ValueError(f"its camera matrix has {matrix.size} numbers instead of 9")
    matrix = matrix.reshape(3, 3)
    if not matrix[:2].any():
        raise ValueError("its camera is not calibrated: the matrix is 0")
    matrix[:2, 2] += centre
    _check_cropping(content)
    other = [
        key for key in content if str(key).lower().startswith("dist") and key not in (*DISTORTION, "distortion_model")
    ]
    if other and not set(DISTORTION) & set(content):
        raise ValueError(f"it has the key {other[0]}, which is not read; call it distortion_coefficients")
    coefficients = _numbers(content, DISTORTION)
    width, height = next(((content[w], content[h]) for w, h in SIZES if {w, h} <= set(content)), (0, 0))
    if any(isinstance(side, bool) or not isinstance(side, int) for side in (width, height)):
        raise ValueError(f"its image size is {width!r:.20} x {height!r:.20}; whole numbers of pixels are needed")
    model, params = _model(content, matrix, coefficients)
    return model, width, height, params


def _model(content: Mapping[str, Any], matrix: NDArray[np.float64], coefficients: NDArray[np.float64]) -> Any:
    """Return the COLMAP model and its parameters."""
    name = content.get("distortion_model")
    if name is None and content.get("fisheye_model") in (1, True):  # as OpenCV's sample names it
        name = FISHEYE[0]
    if not coefficients.any():
        if matrix[0, 1]:
            raise ValueError(f"its camera matrix has the skew {matrix[0, 1]:g}; write the matrix alone, as three rows")
        if name not in FISHEYE:
            return opencv_model(matrix, None)
    if name in FISHEYE:
        if len(coefficients) > 4 and coefficients[4:].any():
            raise ValueError(f"its distortion_model {name} has {len(coefficients)} coefficients instead of 4")
        if matrix[0, 1]:
            raise ValueError(f"its camera matrix has the skew {matrix[0, 1]:g}, which is not read with a distortion")
        (_, params), values = opencv_model(matrix, None), np.zeros(4)
        values[: len(coefficients[:4])] = coefficients[:4]
        return "OPENCV_FISHEYE", [*params, *values.tolist()]
    if name in BROWN or (name in (None, "") and len(coefficients) > 4):
        return opencv_model(matrix, coefficients)
    known = ", ".join((*BROWN, *FISHEYE))
    if name in (None, ""):
        raise ValueError(f"its {len(coefficients)} distortion coefficients need a distortion_model, one of {known}")
    raise ValueError(f"its distortion_model {name!r:.40} is not known; the models are {known}")


def _check_cropping(content: Mapping[str, Any]) -> None:
    """Raise ValueError for an image that is binned or cropped: the matrix is that of the whole sensor."""
    roi = content.get("roi")
    offsets = [roi.get(key) for key in ("x_offset", "y_offset")] if isinstance(roi, Mapping) else []
    if any(content.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y")) or any(offsets):
        raise ValueError("its image is binned or cropped (binning_x, binning_y, roi); give the camera of that image")


def _numbers(content: Mapping[str, Any], keys: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the numbers of the first of these keys, none without one."""
    key = next((key for key in keys if key in content), None)
    values = None if key is None else content[key]
    values = values.get("data") if isinstance(values, Mapping) else values
    try:
        return np.array([] if values is None else values, np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(f"its {key} is {values!r:.60}; numbers are needed") from error
