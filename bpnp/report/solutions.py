"""Pictures of a `bpnp.Solution`: its points ready to draw, and the figure of `Solution.plot`."""

import base64
import io
import textwrap
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.cameras import check_single_camera, in_front
from bpnp.matching import mutual_nearest
from bpnp.report.figures import plot_matches
from bpnp.report.points import ProblemPoints
from bpnp.report.terminal import VERDICTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Solution = Any  # a `bpnp.Solution`, which imports this part
LINE = 130  # characters per line of the reason in a figure


def solution_points(solution: Solution, *, title: str | None = None) -> ProblemPoints:
    """Return the points of a solution, ready to draw.

    Their id is the caption: title, verdict with its numbers, and reason. A failed solution has no numbers.

    Args:
        solution: Solution.
        title: First line of the caption; None for a caption without title.

    Raises:
        ValueError: A match has no point, or the solution is that of a rig, which has several images.
    """
    check_single_camera(solution.points_per_camera, "a picture of one image")
    shown = "no match"
    if len(solution.matches):
        share, error = f"{100 * solution.inlier_ratio:.0f} %", f"{solution.reprojection_error:.3g} {solution.unit}"
        shown = f"{solution.inlier_count} matches ({share}), mean error {error}"
    matches, points2d, points3d = solution.matches, solution.points2d, solution.points3d
    assigned = np.full(len(points3d), -1, np.int32)
    if len(matches):
        assigned[matches[:, 1]] = matches[:, 0]
    verdict = [f"{solution.verdict}: {shown}", solution.reason]
    if solution.verdict == "failed":
        verdict = [f"failed: {solution.reason}"]
    lines = [*([] if title is None else [title]), *(textwrap.fill(line, LINE) for line in verdict)]
    return ProblemPoints(
        0, "\n".join(lines), points2d, points3d, np.full_like(assigned, -1), assigned,
        estimates={"solution": (solution.rotation, solution.translation / solution.scale)}, camera=solution.camera,
        normals3d=solution.normals3d,
    )  # fmt: skip


def competing_points(solution: Solution, points: ProblemPoints) -> ProblemPoints | None:
    """Return the points under the next candidate of an ambiguous solution; None if there is none.

    The matches are mutual nearest neighbours within the inlier threshold.

    Args:
        solution: Solution.
        points: Points of the solution, from `solution_points`.
    """
    if solution.verdict != "ambiguous" or len(solution.candidates) < 2:
        return None
    other = solution.candidates[1]
    pose = other.rotation, other.translation / other.scale
    projected, seen = in_front(points.points3d @ pose[0].T + pose[1])[:, :2], points.points2d
    known, assigned = np.flatnonzero(np.isfinite(seen).all(-1)), np.full(len(projected), -1, np.int32)
    reach = solution.inlier_threshold / (1.0 if solution.camera is None else solution.camera.focal)
    i, j = mutual_nearest(seen[known], projected, reach).T
    assigned[j] = known[i]
    title = f"next candidate: {other.inlier_count} matches"
    return replace(points, id=title, assigned3d=assigned, estimates={"next candidate": pose})


def draw_solution(solution: Solution, *, title: str | None = None, photo: Any = None) -> "Figure":
    """Draw `solution_points`, a close-up of the residuals, and the next candidate of an ambiguous solution.

    Args:
        solution: Solution to draw.
        title: First line of the caption; None for a caption without title.
        photo: (h, w, 3) uint8, to draw under the points; None for a white background.

    Returns:
        The figure.

    Raises:
        ValueError: The solution is that of a rig, which has several images.
    """
    points, colour = solution_points(solution, title=title), VERDICTS[solution.verdict]
    return plot_matches(points, colour=colour, photo=photo, competing=competing_points(solution, points))


def solution_html(solution: Solution) -> str:
    """Return the text of a solution as HTML, followed by its picture if it has an image point."""
    text = f"<pre style='white-space: pre-wrap'>{escape(repr(solution))}</pre>"
    if solution.points_per_camera is not None or not np.isfinite(solution.points2d).all(-1).any():
        return text
    content = io.BytesIO()
    draw_solution(solution).savefig(content, format="png", dpi=80)
    picture = base64.b64encode(content.getvalue()).decode()
    return f'{text}<img style="max-width: 100%" alt="the matches" src="data:image/png;base64,{picture}">'
