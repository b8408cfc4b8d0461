"""A solution in the files of other programs: COLMAP, nerfstudio, and the viewer rerun.

solution: as `bpnp.solve` returns it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.cameras import Lens, camera_from
from bpnp.files import write_text, written_whole

Array = npt.NDArray[np.float64]
NOMINAL_FOCAL = 1000.0  # pixels, of a solution without a camera
GREY = "128 128 128"


def pose_text(rotation: Array, translation: Array) -> str:
    """A pose as COLMAP's text files have it: qw qx qy qz tx ty tz."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return " ".join(map(repr, (w, x, y, z, *translation.tolist())))


def write_colmap(
    solution: Any, folder: Path, *, camera: Any, name: str, size: tuple[int, int] | None
) -> Path:  # fmt: skip
    """A COLMAP model of one image in text files; see `Solution.to_colmap`."""
    if not name or name.split() != [name]:
        raise ValueError(f"expected a `name` without spaces, which COLMAP's text files do not hold, got {name!r}")
    lens, width, height = _camera_of(solution, camera, size)
    model, parameters = _described(lens)
    pixels = _pixels(solution, lens)
    place = {int(i): k for k, i in enumerate(np.flatnonzero(np.isfinite(pixels).all(-1)))}
    kept = pixels[list(place)]
    ids = np.full(len(kept), -1)
    tracks: dict[int, int] = {}
    for i, j in solution.match_places.tolist():
        if i in place:
            ids[place[i]], tracks[j] = j + 1, place[i]
    pose = pose_text(solution.rotation, solution.translation)
    seen = " ".join(f"{u!r} {v!r} {j}" for (u, v), j in zip(kept.tolist(), ids.tolist(), strict=True))
    errors = _residuals(solution, lens)

    def points() -> Iterator[str]:
        for j, point in enumerate(solution.points3d.tolist()):
            track = f" 1 {tracks[j]}" if j in tracks else ""
            yield f"{j + 1} {' '.join(map(repr, point))} {GREY} {errors.get(j, 0.0)!r}{track}\n"

    with written_whole(folder) as temporary:
        temporary.mkdir()
        (temporary / "cameras.txt").write_text(f"1 {model} {width} {height} {' '.join(map(repr, parameters))}\n")
        (temporary / "images.txt").write_text(f"1 {pose} 1 {name}\n{seen}\n")
        (temporary / "points3D.txt").write_text("".join(points()))
    return folder


def write_nerfstudio(
    solution: Any, path: Path, *, camera: Any, name: str, size: tuple[int, int] | None
) -> Path:  # fmt: skip
    """transforms.json of nerfstudio with one frame; see `Solution.to_nerfstudio`."""
    lens, width, height = _camera_of(solution, camera, size)
    model, parameters = _described(lens)
    fields = {
        "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
        "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
        "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
    }
    if model.startswith("SIMPLE_PINHOLE"):
        model, parameters = "PINHOLE", [parameters[0], *parameters]
    if model not in fields:
        raise ValueError(f"expected a camera model among SIMPLE_PINHOLE, {', '.join(fields)}, got {model}")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = solution.rotation.T, solution.centre
    pose[:3, 1:3] *= -1  # nerfstudio's cameras look along -z with y up
    content = {"camera_model": model if model != "PINHOLE" else "OPENCV", "w": width, "h": height}
    content |= dict(zip(fields[model], parameters, strict=True))
    content |= {"frames": [{"file_path": name, "transform_matrix": pose.tolist()}]}
    return write_text(path, json.dumps(content, indent=1) + "\n")


def log_to_rerun(solution: Any, entity: str, *, camera: Any, size: tuple[int, int] | None) -> None:
    """Points, camera and keypoints in rerun's current recording; see `Solution.to_rerun`."""
    try:
        import rerun
    except ImportError as error:
        raise ValueError("expected the package rerun-sdk, got none; try pip install rerun-sdk") from error
    lens, width, height = _camera_of(solution, camera, size)
    matched = np.zeros(len(solution.points3d), bool)
    matched[solution.match_places[:, 1]] = True
    colours = np.where(matched[:, None], [38, 110, 204], [160, 160, 160]).astype(np.uint8)
    rerun.log(f"{entity}/points", rerun.Points3D(solution.points3d, colors=colours))
    rerun.log(f"{entity}/camera", rerun.Transform3D(translation=solution.centre, mat3x3=solution.rotation.T))
    seen = _pixels(solution, lens)
    (centre,) = lens.project(np.array([[0.0, 0.0, 1.0]])).tolist()  # principal point
    pinhole = rerun.Pinhole(focal_length=lens.focal, principal_point=centre, width=width, height=height)
    rerun.log(f"{entity}/camera/image", pinhole)
    rerun.log(f"{entity}/camera/image/keypoints", rerun.Points2D(seen[np.isfinite(seen).all(-1)]))


def _camera_of(solution: Any, camera: Any, size: tuple[int, int] | None) -> tuple[Lens, int, int]:
    """The camera as one of COLMAP's, and the size of its image, which holds all points where it is not known."""
    if not solution.found:
        raise ValueError(f"expected a solution with a pose to export, got none: {solution.reason}")
    camera = solution.camera if camera is None else camera
    if camera is None:
        seen = solution.points2d[np.isfinite(solution.points2d).all(-1)]
        half = NOMINAL_FOCAL * np.abs(seen).max(0)
        camera = ("PINHOLE", (NOMINAL_FOCAL, NOMINAL_FOCAL, *half.tolist()))
    given = camera_from(camera)
    if not isinstance(given, Lens):
        matrix = given.matrix
        if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
            raise ValueError(f"expected a camera without skew, which COLMAP has none of, got {matrix.tolist()}")
        given = camera_from(("PINHOLE", (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
        assert isinstance(given, Lens)
    if size is None and given.camera.width:
        size = (given.camera.width, given.camera.height)
    if size is None:
        pixels = _pixels(solution, given)
        size = tuple(np.ceil(np.nanmax(pixels, axis=0)).astype(int).tolist())
    assert size is not None
    return given, *size


def _described(lens: Lens) -> tuple[str, list[float]]:
    model = getattr(lens.camera.model, "name", str(lens.camera.model))
    return model, [float(value) for value in lens.camera.params]


def _pixels(solution: Any, lens: Lens) -> Array:
    """The image points (m, 2) as pixels, NaN where a point has none."""
    points = solution.points2d
    return lens.project(np.column_stack([points, np.ones(len(points))]))


def _residuals(solution: Any, lens: Lens) -> dict[int, float]:
    """The reprojection error of each matched 3D point, pixels."""
    i, j = solution.match_places.T
    seen = lens.project(solution.points3d[j] @ solution.rotation.T + solution.translation)
    errors = np.linalg.norm(_pixels(solution, lens)[i] - seen, axis=-1)
    return dict(zip(j.tolist(), np.nan_to_num(errors).tolist(), strict=True))
