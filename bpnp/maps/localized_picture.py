"""Figure of a photo that was localised in a map: its matches over the photo, and the map from above with the camera."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bpnp.arrays import AnyArray
from bpnp.cameras import camera_from
from bpnp.report.images import size_in_camera
from bpnp.report.terminal import LIGHT, QUIET, VERDICTS, number
from bpnp.search.solution import Solution
from bpnp.search.verdict.uncertainty import centre_covariance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bpnp.maps.scene_map import SceneMap
    from bpnp.maps.views import View

BOUND = 3.72  # bound of 99.9 % of a plane's normal distribution [standard deviations; derived]
PHOTO_CONTRAST = 0.55  # fraction of the photo's contrast that is kept, so that points stand out [fraction; convention]
SHOWN_PERCENT = 98.0  # fraction of the map's points within the drawing [per cent; convention]
FARTHEST_CAMERA = 4.0  # largest distance of a camera that is drawn in place [extents of the points; convention]
MOST_DRAWN_POINTS = 20_000  # largest number of map points in a picture [points; cost]
FIGURE_WIDTHS = (9.0, 6.0)  # widths of photo and map [inches; convention]


def localized_picture(
    scene: "SceneMap", solution: Solution, *, photo: AnyArray | None = None, title: str | None = None
) -> "Figure":
    """Draw a photo and its pose in a map.

    The left part is the photo (h, w, 3), uint8, with its matches, coloured by their residuals, and the other keypoints
    faint. The right part is the map from above with its views, and the camera with the 99.9 % ellipse of its centre.
    The next candidate of an ambiguous solution is drawn too. A failed solution is drawn without matches and camera,
    since its pose is a guess.
    """
    from matplotlib.figure import Figure

    from bpnp.report.figures import shown_text
    from bpnp.report.solutions import solution_points

    figure = Figure(figsize=(sum(FIGURE_WIDTHS), 6.5), layout="constrained")
    image, above = figure.subplots(1, 2, width_ratios=FIGURE_WIDTHS)
    marks = draw_matches(image, solution, photo=photo)
    if marks is not None:
        figure.colorbar(marks, ax=image, location="bottom", shrink=0.5, aspect=40, label=f"residual, {solution.unit}")
    draw_from_above(above, scene, solution)
    near = "" if solution.view is None or solution.verdict == "failed" else f", found near view {solution.view}"
    text = solution_points(solution, title=None if title is None else title + near).id
    figure.suptitle(shown_text(text), fontsize=10, color=VERDICTS[solution.verdict])
    return figure


def draw_matches(axes: "Axes", solution: Solution, *, photo: AnyArray | None = None) -> Any:
    """Draw keypoints faint and, unless the solution is failed, matches coloured by their reprojection errors.

    Return the coloured lines; None without matches.
    """
    from matplotlib.collections import LineCollection

    camera = camera_from(solution.camera)
    seen = camera.project(np.column_stack([solution.points2d, np.ones(len(solution.points2d))]))
    image, scene = solution.matches.T if solution.verdict != "failed" else solution.matches[:0].T
    reprojected = camera.project(solution.points3d[scene] @ solution.rotation.T + solution.translation)
    residuals = np.linalg.norm(seen[image] - reprojected, axis=-1)
    if photo is not None:
        width, height = size_in_camera(photo, camera)
        faded = (255 - PHOTO_CONTRAST * (255 - photo.astype(float))).astype(np.uint8)
        axes.imshow(faded, extent=(0, width, height, 0), zorder=0)
        axes.set(xlim=(0, width), ylim=(height, 0))
    else:
        axes.invert_yaxis()
    rest = np.delete(seen, image, 0)
    axes.plot(*rest.T, ".", color=QUIET, ms=1.5, alpha=0.35, zorder=1)
    axes.set(aspect="equal", xticks=[], yticks=[])
    matched = "" if solution.verdict == "failed" else f", {len(image)} matched"
    axes.set_title(f"{len(seen)} keypoints{matched}", fontsize=9)
    if not len(image):
        return None
    axes.add_collection(LineCollection(list(np.stack([seen[image], reprojected], 1)), colors="black", linewidths=0.8))
    x, y = seen[image].T
    return axes.scatter(x, y, c=residuals, cmap="plasma", s=14, edgecolors="white", linewidths=0.3, zorder=3)


def plane_from_above(views: "Sequence[View]", forward: AnyArray) -> AnyArray:
    """Return the axes (2, 3) of a drawing of a map from above: right, and ahead along `forward` (3,).

    Photos are assumed upright: down is the mean of their y axes. If these cancel each other, or if `forward` is
    vertical, any direction is taken in its place.
    """
    down = _unit(np.mean([view.rotation[1] for view in views], axis=0), views[0].rotation[1])
    ahead = _unit(forward - down * (forward @ down), np.cross(down, np.eye(3)[np.argmin(np.abs(down))]))
    return np.stack([np.cross(down, ahead), ahead])


def _unit(vector: AnyArray, otherwise: AnyArray) -> AnyArray:
    """Return a vector (3,) of length 1 along another one, or along `otherwise` if that has no length."""
    chosen = vector if np.linalg.norm(vector) > 1e-6 else otherwise
    return np.asarray(chosen / np.linalg.norm(chosen))


def draw_from_above(axes: "Axes", scene: "SceneMap", solution: Solution) -> None:
    """Draw points and views of the map from above, and the camera, which points upwards in the drawing.

    The next candidate of an ambiguous solution is a hollow star; a failed solution has no camera. A camera far outside
    the map is drawn at the edge, with a note in the legend.
    """
    found = solution.verdict != "failed"
    plane = plane_from_above(scene.views, solution.rotation[2] if found else scene.views[0].rotation[2])
    step = -(-len(scene.points3d) // MOST_DRAWN_POINTS)
    points, centres = scene.points3d[::step] @ plane.T, np.array([view.centre for view in scene.views]) @ plane.T
    axes.plot(*points.T, ".", color=QUIET, ms=1, alpha=0.35, zorder=1)
    viewing_axes = np.array([view.rotation[2] for view in scene.views]) @ plane.T
    drawn = [("the photo", solution.centre, solution.rotation)] if found else []
    if solution.verdict == "ambiguous" and len(solution.candidates) > 1:
        drawn.append(("or here", solution.candidates[1].centre, solution.candidates[1].rotation))
    stars = np.array([centre for _, centre, _ in drawn]).reshape(-1, 3) @ plane.T
    low, high = np.percentile(points, [(100 - SHOWN_PERCENT) / 2, (100 + SHOWN_PERCENT) / 2], axis=0)
    farthest = FARTHEST_CAMERA * (high - low)
    placed = np.clip(np.concatenate([centres, stars]), low - farthest, high + farthest)
    low, high = np.minimum(low, placed.min(0)), np.maximum(high, placed.max(0))
    drawing_centre, reach = (low + high) / 2, 0.5 * 1.15 * float((high - low).max())
    axes.quiver(*centres.T, *viewing_axes.T, color=LIGHT[0], width=0.004, scale=25, zorder=2)
    axes.plot(*centres.T, ".", color=LIGHT[0], ms=4, label=f"{len(centres)} views", zorder=2)
    colour, half = VERDICTS[solution.verdict], np.tan(np.nanmax(np.abs(np.arctan(solution.points2d[:, 0]))))
    for (label, _, rotation), star, inside in zip(drawn, stars, placed[len(centres) :], strict=True):
        first = label == drawn[0][0]
        for side in (-half, half):
            edge = plane @ (rotation.T @ np.array([side, 0, 1]))
            ends = np.stack([inside, inside + 0.5 * reach * edge / np.linalg.norm(edge)], 1)
            axes.plot(*ends, color=colour, lw=1, ls="-" if first else ":")
        shown = label if np.allclose(star, inside) else f"{label}, outside of the drawing"
        face, edge_colour = (colour, "white") if first else ("white", colour)
        axes.plot(*inside, "*", color=face, ms=14, mec=edge_colour, label=shown, zorder=4)
    if found:
        draw_ellipse(axes, solution, plane, colour)
    axes.set(xlim=drawing_centre[0] + np.array([-reach, reach]), ylim=drawing_centre[1] + np.array([-reach, reach]))
    axes.set(aspect="equal", xticks=[], yticks=[])
    precision = (
        f"; centre known to {number(solution.centre_std)} scene units" if np.isfinite(solution.centre_std) else ""
    )
    axes.set_title(f"the map from above{precision if found else '; no pose'}", fontsize=9)
    axes.legend(loc="lower right", fontsize=8)


def draw_ellipse(axes: "Axes", solution: Solution, plane: AnyArray, colour: str) -> None:
    """Draw the 99.9 % ellipse of the camera's centre in a plane (2, 3) of the scene, if its covariance is known."""
    from matplotlib.patches import Ellipse

    to_plane = plane @ solution.rotation.T
    spread = to_plane @ centre_covariance(solution.covariance, solution.translation) @ to_plane.T
    if not np.isfinite(spread).all():
        return
    lengths, directions = np.linalg.eigh(spread)
    angle = float(np.degrees(np.arctan2(*directions[::-1, 1])))
    size = 2 * BOUND * np.sqrt(np.maximum(lengths[::-1], 0))
    axes.add_patch(Ellipse(tuple(plane @ solution.centre), *size, angle=angle, fill=False, ec=colour, zorder=5))
