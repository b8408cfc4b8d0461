"""A photo that was found in a map, drawn: its matches over the photo, and the map from above with the camera."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bpnp.cameras import camera_from
from bpnp.report.figures import size_in_camera
from bpnp.report.terminal import LIGHT, QUIET, VERDICTS
from bpnp.search.evidence.uncertainty import centre_covariance
from bpnp.solving.solution import Solution, solution_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bpnp.maps.scene_map import SceneMap

Array = npt.NDArray[Any]
FADED = 0.55  # of the photo's contrast is taken, so that points stand out
BOUND = 3.72  # standard deviations that hold 99.9 % of a plane's normal distribution
SHOWN = 98.0  # % of the map's points that its drawing holds
MOST_POINTS = 20_000  # of the map that are drawn
WIDTHS = (9.0, 6.0)  # inches, of photo and map


def localized_picture(
    scene: "SceneMap", solution: Solution, *, photo: Array | None = None, title: str | None = None
) -> "Figure":
    """Left the photo (h, w, 3) uint8 with its matches, coloured by their residuals, and the other keypoints faint;
    right the map from above with its views, and the camera with the ellipse that holds its centre at 99.9 %."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sum(WIDTHS), 6.5), layout="constrained")
    image, above = figure.subplots(1, 2, width_ratios=WIDTHS)
    marks = draw_matches(image, solution, photo=photo)
    if marks is not None:
        figure.colorbar(marks, ax=image, location="bottom", shrink=0.5, aspect=40, label=f"residual, {solution.unit}")
    draw_from_above(above, scene, solution)
    text = solution_points(solution, title=title).id.replace("$", r"\$")
    figure.suptitle(text, fontsize=10, color=VERDICTS[solution.verdict])
    return figure


def draw_matches(axes: "Axes", solution: Solution, *, photo: Array | None = None) -> Any:
    """Keypoints faint, matches coloured by the distance to where their scene points are reprojected, a line to it.
    Returns what was coloured, None without a match."""
    from matplotlib.collections import LineCollection

    camera = camera_from(solution.camera)
    seen = camera.project(np.column_stack([solution.points2d, np.ones(len(solution.points2d))]))
    image, scene = solution.match_places.T
    reprojected = camera.project(solution.points3d[scene] @ solution.rotation.T + solution.translation)
    residuals = np.linalg.norm(seen[image] - reprojected, axis=-1)
    if photo is not None:
        width, height = size_in_camera(photo, camera)
        faded = (255 - FADED * (255 - photo.astype(float))).astype(np.uint8)
        axes.imshow(faded, extent=(0, width, height, 0), zorder=0)
        axes.set(xlim=(0, width), ylim=(height, 0))
    else:
        axes.invert_yaxis()
    rest = np.delete(seen, image, 0)
    axes.plot(*rest.T, ".", color=QUIET, ms=1.5, alpha=0.35, zorder=1)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"{len(image)} matches of {len(seen)} keypoints", fontsize=9)
    if not len(image):
        return None
    axes.add_collection(LineCollection(list(np.stack([seen[image], reprojected], 1)), colors="black", linewidths=0.8))
    x, y = seen[image].T
    return axes.scatter(x, y, c=residuals, cmap="plasma", s=14, edgecolors="white", linewidths=0.3, zorder=3)


def draw_from_above(axes: "Axes", scene: "SceneMap", solution: Solution) -> None:
    """Points and views of the map, and the camera, which looks upwards in the drawing, as far as there is a pose."""
    from matplotlib.patches import Ellipse

    down = np.mean([view.rotation[1] for view in scene.views], axis=0)  # of upright photos
    down /= np.linalg.norm(down)
    forward = solution.rotation[2] if solution.found else scene.views[0].rotation[2]
    ahead = forward - down * (forward @ down)
    ahead /= np.linalg.norm(ahead)
    plane = np.stack([np.cross(down, ahead), ahead])  # to the right, ahead
    step = -(-len(scene.points3d) // MOST_POINTS)
    points, centres = scene.points3d[::step] @ plane.T, np.array([view.centre for view in scene.views]) @ plane.T
    axes.plot(*points.T, ".", color=QUIET, ms=1, alpha=0.35, zorder=1)
    looks = np.array([view.rotation[2] for view in scene.views]) @ plane.T
    low, high = np.percentile(points, [(100 - SHOWN) / 2, (100 + SHOWN) / 2], axis=0)
    placed = np.concatenate([centres, (plane @ solution.centre)[None]]) if solution.found else centres
    placed = np.clip(placed, 2 * low - high, 2 * high - low)  # a pose that failed may be anywhere
    low, high = np.minimum(low, placed.min(0)), np.maximum(high, placed.max(0))
    middle, reach = (low + high) / 2, 0.5 * 1.15 * float((high - low).max())
    axes.quiver(*centres.T, *looks.T, color=LIGHT[0], width=0.004, scale=25, zorder=2)
    axes.plot(*centres.T, ".", color=LIGHT[0], ms=4, label=f"{len(centres)} views", zorder=2)
    if solution.found:
        colour, centre = VERDICTS[solution.verdict], plane @ solution.centre
        half = np.tan(np.nanmax(np.abs(np.arctan(solution.points2d[:, 0]))))
        for side in (-half, half):
            edge = plane @ (solution.rotation.T @ np.array([side, 0, 1]))
            axes.plot(*np.stack([centre, centre + 0.5 * reach * edge / np.linalg.norm(edge)], 1), color=colour, lw=1)
        axes.plot(*centre, "*", color=colour, ms=14, mec="white", label="the photo", zorder=4)
        to_plane = plane @ solution.rotation.T
        spread = to_plane @ centre_covariance(solution.covariance, solution.translation) @ to_plane.T
        if np.isfinite(spread).all():
            lengths, axes_of = np.linalg.eigh(spread)
            angle = float(np.degrees(np.arctan2(*axes_of[::-1, 1])))
            size = 2 * BOUND * np.sqrt(np.maximum(lengths[::-1], 0))
            axes.add_patch(Ellipse(tuple(centre), *size, angle=angle, fill=False, ec=colour, zorder=5))
    axes.set(xlim=middle[0] + np.array([-reach, reach]), ylim=middle[1] + np.array([-reach, reach]))
    axes.set(aspect="equal", xticks=[], yticks=[])
    known = f"; the centre is known to {solution.centre_std:.2g} scene units" if solution.found else ""
    axes.set_title(f"the map from above{known}", fontsize=9)
    axes.legend(loc="lower right", fontsize=8)
