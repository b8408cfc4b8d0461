"""The view of one solved pair, and what its picture says of it."""

import textwrap
from typing import Any

import numpy as np

from bpnp.cameras import Camera
from bpnp.report.samples import Array, PairView

LINE = 130  # characters of the reason


def solution_view(solution: Any, *, title: str | None = None) -> PairView:
    """The view of what `bpnp.solve` returns; its id is the title, the verdict with its figures, and the reason."""
    found = "no match"
    if len(solution.matches):
        share, error = f"{100 * solution.inlier_ratio:.0f} %", f"{solution.reprojection_error:.3g} {solution.unit}"
        found = f"{solution.inlier_count} matches ({share}), mean error {error}"
    reason = textwrap.fill(str(solution.reason), LINE)
    said = "\n".join([*([] if title is None else [title]), f"{solution.verdict}: {found}", reason])
    sides = (solution.points2d, solution.points3d, solution.rotation, solution.translation)
    return view_of(*sides, matches=solution.match_places, id=said, camera=solution.camera)


def view_of(
    points2d: Array, points3d: Array, rotation: Array, translation: Array, *, matches: Array | None = None,
    id: str = "", camera: Camera | None = None,
) -> PairView:  # fmt: skip
    """The view of one solved pair: points (m, 2) and (n, 3), pose camera = R p + t, NaN where there is none.

    matches: (k, 2) indices of a 2D and a 3D point. camera: in whose pixels the picture is. Raises ValueError if a match
    has no point.
    """
    assigned = np.full(len(points3d), -1, np.int32)
    if matches is not None and len(matches):
        most = np.max(matches, axis=0)
        if np.min(matches) < 0 or most[0] >= len(points2d) or most[1] >= len(points3d):
            sizes = f"{len(points2d)} 2D and {len(points3d)} 3D points"
            raise ValueError(f"expected `matches` of {sizes}, got indices up to {most.tolist()}")
        assigned[matches[:, 1]] = matches[:, 0]
    estimates = {"solution": (np.asarray(rotation), np.asarray(translation))}
    sides = (np.asarray(points2d), np.asarray(points3d))
    return PairView(0, id, *sides, np.full_like(assigned, -1), assigned, None, estimates, camera=camera)
