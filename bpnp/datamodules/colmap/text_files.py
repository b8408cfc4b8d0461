"""The text form of a COLMAP model: cameras.txt, images.txt and points3D.txt, record by record.

Source: https://colmap.github.io/format.html
"""

import operator
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bpnp.datamodules.colmap.model_records import CameraRecord, ColmapError, ImageRecord


def text_records(path: Path, content: bytes, parse: Callable[[bytes, Iterator[bytes]], Any]) -> Iterator[Any]:
    """Every record of a text file. `parse` gets its first line, and the lines after it to draw from.

    Comments and blank lines between records are skipped. The count in COLMAP's header, where there is one, and the
    line break at the end are what shows that a text file was cut.
    """
    if not content.endswith(b"\n"):
        raise ColmapError(
            f"expected {path} to end with a line break, got {content[-20:]!r}: it looks truncated; try copying the "
            "model again, or add the line break if it is whole"
        )
    lines = content.splitlines()
    rest = iter(lines)
    found = 0
    for line in rest:
        if line.startswith(b"#") or not line.strip():
            continue
        try:
            record = parse(line, rest)
        except (ValueError, OverflowError, StopIteration) as error:
            number = len(lines) - operator.length_hint(rest)
            raise ColmapError(
                f"expected a COLMAP record, got {line[:40]!r} at line {number} of {path} ({error or 'cut short'}); "
                "try copying the model again"
            ) from error
        found += 1
        yield record
    header = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
    if header and int(header[1]) > found:
        raise ColmapError(
            f"expected {int(header[1])} records in {path} as its header says, got {found}: it is truncated; try "
            "copying the model again, or correct the header if records were removed on purpose"
        )


def text_camera(line: bytes, models: Mapping[str, int]) -> tuple[int, CameraRecord]:
    camera_id, name, _, _, *params = line.split()
    model = name.decode(errors="backslashreplace")
    if len(params) != models.get(model):
        raise ValueError(f"{len(params)} parameters, camera model {model} has {models.get(model, 'never been known')}")
    return int(camera_id), CameraRecord(model, np.array(params, dtype=np.float64))


def text_image(line: bytes, rest: Iterator[bytes]) -> ImageRecord:
    image_id, *numbers, camera_id, name = line.split(maxsplit=9)  # a name may have spaces
    pose = np.array(numbers, dtype=np.float64)
    fields = next(rest).split()
    keypoints = np.array(fields, dtype=np.float64).reshape(-1, 3)[:, :2]
    point_ids = np.array(fields[2::3], dtype=np.int64)
    shown = name.rstrip().decode(errors="backslashreplace")
    return ImageRecord(shown, int(image_id), int(camera_id), pose[:4], pose[4:], keypoints, point_ids)


def text_point(line: bytes, rest: Iterator[bytes]) -> tuple:
    del rest
    point_id, x, y, z, *colour, error = (fields := line.split())[:8]
    track = fields[8:]
    if len(colour) != 3 or len(track) % 2:
        raise ValueError(f"{len(fields)} fields, should be 8 and a track of pairs")
    position = float(x), float(y), float(z)
    return int(np.int64(int(point_id))), position, tuple(map(int, colour)), float(error), len(track) // 2
