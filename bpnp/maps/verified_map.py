"""Verification of all images of a COLMAP model: records of their verdicts, and a page."""

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.colmap.model_files import read_records
from bpnp.maps.localized_picture import plane_from_above
from bpnp.maps.scene_map import SceneMap
from bpnp.report.templates import render_page
from bpnp.report.terminal import VERDICTS, number
from bpnp.search.solvers import TIME_LIMIT
from bpnp.search.verdict.decide import fits_by_chance

MOST_PAGE_POINTS = 3000  # largest number of map points on a page [points; cost]
DRAWING_SIDE = 1000.0  # side of the drawing on a page [pixels; convention]

UNTESTED = "untested"
MATCHED_ONLY = "Significant on the matched keypoints alone, log10 NFA {0:.1f}, but not on all {2} keypoints, {1:.1f}"
WORST_FIRST = ("failed", "ambiguous", UNTESTED, "confident")


@dataclass(frozen=True)
class VerifiedView:
    """Verdict on the pose of an image of a model."""

    name: str
    verdict: str  # verdict as of `bpnp.verify`, or "untested" if the other images see too few of its points
    reason: str
    points: int = 0  # number of points in view that two other images see
    matches: int = 0  # number of keypoints that one of these points explains
    reprojection_error: float = math.nan  # mean over the matches, pixels; NaN without a match
    log10_false_alarms: float = math.inf  # log10 NFA; infinite if untested
    # Angle from the pose to the optimum of these points, degrees; NaN if untested.
    rotation_change_deg: float = math.nan
    # Distance from its camera centre to that of the optimum, scene units; NaN if untested.
    centre_change: float = math.nan
    other_centre: tuple[float, float, float] | None = None  # camera centre of the best competing pose; None without one

    @property
    def doubtful(self) -> bool:
        return self.verdict != "confident"


def verify_map(
    folder: Path,
    scene: SceneMap,
    *,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
    done: Callable[[str], None] = lambda words: None,
) -> list[VerifiedView]:
    """Verify the pose of each image of a COLMAP model without the image's own observations.

    A pose is judged on all keypoints of the image. If it is significant only on the keypoints that the model matched,
    it is "ambiguous". Thousands of other keypoints may hide a correct pose, and the matched ones alone do not exclude a
    similar building. `time_limit` is in seconds per image, as for `SceneMap.verify_view`; `done` gets a short message
    for each image. Views are sorted by verdict: failed, ambiguous, untested, confident; the largest NFA first. Raise
    ColmapError, a ValueError, if the model cannot be read.
    """
    images = {image.name: image for image in read_records(folder).images}
    verified = []
    for view in scene.views:
        image = images[view.name]
        usable = np.isfinite(image.keypoints).all(-1)
        one = _verify_view(scene, view.name, np.unique(image.keypoints[usable], axis=0), seed, time_limit)
        if one.verdict == "failed" and fits_by_chance(one.log10_false_alarms):
            matched = np.unique(image.keypoints[usable & (image.point_ids >= 0)], axis=0)
            again = _verify_view(scene, view.name, matched, seed, time_limit)
            if again.verdict != "failed":
                reason = MATCHED_ONLY.format(again.log10_false_alarms, one.log10_false_alarms, len(image.keypoints))
                one = replace(again, verdict="ambiguous", reason=reason)
        verified.append(one)
        done(f"{view.name}: {one.verdict}")
    return sorted(verified, key=lambda one: (WORST_FIRST.index(one.verdict), -one.log10_false_alarms, one.name))


def _verify_view(
    scene: SceneMap, name: str, keypoints: NDArray[np.float64], seed: int, time_limit: float
) -> VerifiedView:
    view = scene.named([name])[0]
    try:
        solution = scene.verify_view(name, keypoints, seed=seed, time_limit=time_limit)
    except ValueError as error:
        return VerifiedView(name, UNTESTED, str(error))
    turn = Rotation.from_matrix(solution.rotation @ view.rotation.T).magnitude() if solution.found else math.nan
    others = [tuple(one.centre.tolist()) for one in solution.candidates[1:2]] if solution.verdict != "confident" else []
    return VerifiedView(
        name=name,
        verdict=solution.verdict,
        reason=solution.reason,
        points=len(solution.points3d),
        matches=len(solution.matches),
        reprojection_error=solution.reprojection_error,
        log10_false_alarms=solution.log10_false_alarms,
        rotation_change_deg=math.degrees(turn),
        centre_change=float(np.linalg.norm(solution.centre - view.centre)),
        other_centre=others[0] if others else None,
    )


def summary(verified: Sequence[VerifiedView]) -> str:
    """Return the number of doubtful images as a sentence."""
    count = sum(one.doubtful for one in verified)
    return f"{count} of {len(verified)} images {'is' if count == 1 else 'are'} doubtful."


def as_json(verified: Sequence[VerifiedView], folder: Path) -> str:
    """Return the records as JSON, with null for numbers that are not finite."""
    images = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(one).items()
        }
        for one in verified
    ]
    return json.dumps({"map": str(folder), "images": images}, indent=1)


def as_csv(verified: Sequence[VerifiedView]) -> str:
    """Return the records as comma-separated values with a header; numbers that are not finite are empty."""
    text, columns = io.StringIO(), [key for key in asdict(verified[0]) if key != "other_centre"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns, "other_x", "other_y", "other_z"])
    for one in verified:
        cells = [getattr(one, key) for key in columns]
        cells = ["" if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in cells]
        writer.writerow([*cells, *(one.other_centre or ("", "", ""))])
    return text.getvalue()


def page_html(verified: Sequence[VerifiedView], scene: SceneMap, folder: Path) -> str:
    """Return a self-contained HTML page: the map from above with its views coloured by verdict, and the table."""
    return render_page(
        "verified_map.html",
        colours=VERDICTS,
        title=str(folder),
        summary=summary(verified),
        rows=[(one, *cells(one)) for one in verified],
        drawing=_drawing(verified, scene),
        side=DRAWING_SIDE,
    )


def cells(one: VerifiedView) -> tuple[str, str, str, str, str]:
    """Return the numbers of a record as text: points, matches, error, log10 NFA, rotation change."""
    if one.verdict == UNTESTED:
        return ("-",) * 5
    error, change = (None if math.isnan(x) else x for x in (one.reprojection_error, one.rotation_change_deg))
    return str(one.points), str(one.matches), number(error), f"{one.log10_false_alarms:.0f}", number(change)


def _drawing(verified: Sequence[VerifiedView], scene: SceneMap) -> dict[str, Any]:
    """Return the page coordinates of the points, the views and the competing poses, in a square."""
    plane = plane_from_above(scene.views, scene.views[0].rotation[2]) * np.array([[1.0], [-1.0]])  # y is down
    views = scene.named([one.name for one in verified])
    centres = np.array([view.centre for view in views]) @ plane.T
    points = scene.points3d[:: -(-len(scene.points3d) // MOST_PAGE_POINTS)] @ plane.T
    low, high = np.percentile(np.concatenate([points, centres]), [1, 99], axis=0)
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    scale = 0.92 * DRAWING_SIDE / max(float((high - low).max()), 1e-9)
    size = (high - low) * scale + 0.08 * DRAWING_SIDE

    def to_drawing(values: Any) -> Any:
        return np.round((np.asarray(values) - low) * scale + 0.04 * DRAWING_SIDE, 1).tolist()

    inside = ((points >= low) & (points <= high)).all(-1)
    directions = np.array([view.rotation[2] for view in views]) @ plane.T
    directions /= np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-9)
    others = [
        to_drawing(np.clip(plane @ np.array(one.other_centre), low, high)) if one.other_centre is not None else None
        for one in verified
    ]
    drawn = zip(verified, to_drawing(centres), np.round(24 * directions, 1).tolist(), others, strict=True)
    return {"size": size.round().tolist(), "points": to_drawing(points[inside]), "views": list(drawn)[::-1]}
