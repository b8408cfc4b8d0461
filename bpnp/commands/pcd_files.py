"""Point clouds of the Point Cloud Library, .pcd."""

import re

import numpy as np
from numpy.typing import NDArray

from bpnp.bounded_files import check_size

KINDS = {"F": "f", "I": "i", "U": "u"}
NAMES = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}
# Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
DATA = re.compile(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n?", re.MULTILINE)
REQUIRED = ("FIELDS", "SIZE", "TYPE", "POINTS")


def parse_pcd(content: bytes) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Parse a point cloud, ASCII or binary, into points (n, 3) in the order of the file and other columns (n,) by name.

    These have one number a point; normals are nx, ny, nz. Raise ValueError for something else, truncated or compressed.
    """
    if (found := DATA.search(content)) is None:
        raise ValueError("its header has no line DATA ascii or DATA binary")
    header: dict[str, list[str]] = {}
    for line in content[: found.start()].decode(errors="replace").splitlines():
        key, *words = line.partition("#")[0].split() or [""]
        header[key] = words
    if missing := [key for key in REQUIRED if not header.get(key)]:
        raise ValueError(f"its header has no line {missing[0]}")
    fields, body, form = header["FIELDS"], content[found.end() :], found[1].decode().lower()
    counts = header.get("COUNT") or ["1"] * len(fields)
    numbers = [*header["SIZE"], *counts, header["POINTS"][0]]
    if not len(fields) == len(header["SIZE"]) == len(header["TYPE"]) == len(counts):
        raise ValueError("its lines FIELDS, SIZE, TYPE and COUNT have different numbers of words")
    if not all(word.isdecimal() and len(word) < 10 for word in numbers) or not set(header["TYPE"]) <= set(KINDS):
        raise ValueError("its lines SIZE, TYPE, COUNT or POINTS hold something else than the format allows")
    points = int(header["POINTS"][0])
    widths = [int(count) for count in counts]
    if form == "ascii":
        table = _ascii(body, points, sum(widths))
    elif form == "binary":
        kinds = [f"<{KINDS[kind]}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        table = _binary(body, points, kinds, widths)
    else:
        raise ValueError(
            f"its data are {form}; write them as ascii, such as by `pcl_convert_pcd_ascii_binary IN OUT 0`"
        )
    starts = np.cumsum([0, *widths])
    columns = {
        NAMES.get(name, name): table[:, start]
        for name, start, width in zip(fields, starts, widths, strict=False)
        if width == 1 and name != "_"
    }
    if not {*"xyz"} <= set(columns):
        raise ValueError(f"it needs the fields x, y, z; its fields are {', '.join(fields)[:80]}")
    return np.stack([columns.pop(name) for name in "xyz"], -1), columns


def _ascii(body: bytes, points: int, width: int) -> NDArray[np.float64]:
    rows = [line for line in body.decode(errors="replace").splitlines() if line.strip()]
    if len(rows) != points:
        raise ValueError(f"its header states {points} points, and it has {len(rows)} rows; copy the file again")
    if not rows:
        raise ValueError("it has 0 points")
    try:
        table = np.loadtxt(rows, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"its rows are not {width} numbers each: {error}") from error
    if table.shape[1] != width:
        raise ValueError(f"its rows have {table.shape[1]} numbers, and its header states {width}")
    return table


def _binary(body: bytes, points: int, kinds: list[str], widths: list[int]) -> NDArray[np.float64]:
    try:
        row = np.dtype([(f"{i}", kind, (width,)) for i, (kind, width) in enumerate(zip(kinds, widths, strict=True))])
    except (TypeError, ValueError) as error:
        raise ValueError(f"its fields have sizes that do not exist: {', '.join(kinds)[:60]}") from error
    if not points:
        raise ValueError("it has 0 points")
    check_size("its header", (points,), row, len(body))
    rows = np.frombuffer(body, row, points)
    return np.concatenate([rows[name].astype(np.float64) for name in row.names or ()], 1)
