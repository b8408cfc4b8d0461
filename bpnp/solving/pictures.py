"""A solution drawn, and as a COLMAP model."""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.cameras import Camera, Lens, camera_from
from bpnp.files import written_whole
from bpnp.report.figures import plot_image, plot_residuals
from bpnp.report.points import ProblemPoints
from bpnp.report.terminal import VERDICTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bpnp.solving.solution import Solution

Array = npt.NDArray[Any]
LINE = 130  # characters of the reason
WIDTH, CLOSE_UP, CAPTIONS = 10.0, 3.5, 1.3  # inches
NOMINAL_FOCAL = 1000.0  # pixels, of a solution without a camera


def solution_points(solution: "Solution", *, title: str | None = None) -> ProblemPoints:
    """The points of a solution, ready to draw; its id is the title, the verdict with its figures, and the reason.

    Raises ValueError if a match has no point.
    """
    shown = "no match"
    if len(solution.matches):
        share, error = f"{100 * solution.inlier_ratio:.0f} %", f"{solution.reprojection_error:.3g} {solution.unit}"
        shown = f"{solution.inlier_count} matches ({share}), mean error {error}"
    matches, points2d, points3d = solution.match_places, solution.points2d, solution.points3d
    assigned = np.full(len(points3d), -1, np.int32)
    if len(matches):
        most = np.max(matches, axis=0)
        if np.min(matches) < 0 or most[0] >= len(points2d) or most[1] >= len(points3d):
            sizes = f"{len(points2d)} 2D and {len(points3d)} 3D points"
            raise ValueError(f"expected `matches` of {sizes}, got indices up to {most.tolist()}")
        assigned[matches[:, 1]] = matches[:, 0]
    lines = [*([] if title is None else [title]), f"{solution.verdict}: {shown}", textwrap.fill(solution.reason, LINE)]
    return ProblemPoints(
        0, "\n".join(lines), points2d, points3d, np.full_like(assigned, -1), assigned,
        estimates={"solution": (solution.rotation, solution.translation / solution.scale)}, camera=solution.camera,
    )  # fmt: skip


def solution_picture(solution: "Solution", *, title: str | None = None, photo: Array | None = None) -> "Figure":
    """The image of a solution and a close-up of its residuals; photo: see `bpnp.report.plot_image`."""
    from matplotlib.figure import Figure

    drawn = solution_points(solution, title=title)
    figure = Figure(layout="constrained")
    axes, close = figure.subplots(1, 2, width_ratios=(WIDTH, CLOSE_UP))
    plot_image(axes, drawn, photo=photo)
    plot_residuals(close, drawn)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    height = float(np.clip(WIDTH * (bottom - top) / (right - left), 3, 10))
    figure.set_size_inches(WIDTH + CLOSE_UP, height + CAPTIONS)
    figure.suptitle(drawn.id.replace("$", r"\$"), fontsize=10, color=VERDICTS[solution.verdict])
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure


def pose_text(rotation: Array, translation: Array) -> str:
    """A pose as COLMAP's text files have it: qw qx qy qz tx ty tz."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return " ".join(map(repr, (w, x, y, z, *translation.tolist())))


def write_colmap(
    solution: "Solution", folder: Path, *, camera: Any, name: str, size: tuple[int, int] | None
) -> Path:  # fmt: skip
    """A COLMAP model of one image in text files; see `Solution.to_colmap`."""
    if not name or name.split() != [name]:
        raise ValueError(f"expected a `name` without spaces, which COLMAP's text files do not hold, got {name!r}")
    if not solution.found:
        raise ValueError(f"expected a solution with a pose to export, got none: {solution.reason}")
    lens = colmap_lens(solution, camera)
    pixels = lens.project(np.column_stack([solution.points2d, np.ones(len(solution.points2d))]))
    import pycolmap  # after bpnp.cameras, which loads zlib before it

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
    translation = solution.translation / solution.scale  # a camera does not see the unit
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(solution.rotation), translation)
    model.add_image_with_trivial_frame(image, pose)
    partner = {j: i for i, j in solution.match_places.tolist() if i in number}
    reprojected = lens.project(solution.points3d @ solution.rotation.T + translation)
    for j, point in enumerate(solution.points3d):
        track = pycolmap.Track([pycolmap.TrackElement(1, number[partner[j]])] if j in partner else [])
        added = model.add_point3D(point, track, np.full(3, 128, np.uint8))
        if j in partner:
            model.points3D[added].error = float(np.linalg.norm(pixels[partner[j]] - reprojected[j]))
    with written_whole(folder) as temporary:
        temporary.mkdir()
        model.write_text(temporary)
    return folder


def colmap_lens(solution: "Solution", camera: Any) -> Lens:
    """The camera as one of COLMAP's: the one given, else the solution's, else a pinhole of `NOMINAL_FOCAL` pixels that
    holds all points. Raises ValueError for a camera with skew, which COLMAP has none of."""
    camera = solution.camera if camera is None else camera
    if camera is None:
        half = NOMINAL_FOCAL * np.nanmax(np.abs(solution.points2d), axis=0)
        camera = ("PINHOLE", (NOMINAL_FOCAL, NOMINAL_FOCAL, *half.tolist()))
    lens: Camera = camera_from(camera)
    if not isinstance(lens, Lens):
        matrix = lens.matrix
        if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
            raise ValueError(f"expected a camera without skew, which COLMAP has none of, got {matrix.tolist()}")
        lens = camera_from(("PINHOLE", (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
    assert isinstance(lens, Lens)
    return lens
