"""What `bpnp.solve` returns, and its JSON file."""

import base64
import io
import json
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from bpnp.cameras import Camera, camera_from, camera_to_json, in_front
from bpnp.search.evidence.uncertainty import centre_covariance
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.problem import Unit
from bpnp.search.verdict import SearchResult, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bpnp.report.points import ProblemPoints

Array = npt.NDArray[np.float64]
ROTATION = 3  # numbers of a turn: of points at infinity, no more is known
FORMAT = 2  # 2 has the false alarms
LINE = 130  # characters of the reason in a picture


@dataclass(frozen=True, eq=False)
class Candidate:
    """A distinct pose that was found, camera = R p + t.

    score: mean log-likelihood of the bearings, nats; larger is better. inlier_count: one-to-one inliers (paper Eq. 1).
    log10_false_alarms: how likely unrelated points fit as well, see `Solution`; smaller is better. scale: see there.
    """

    rotation: Array
    translation: Array
    score: float
    inlier_count: int
    log10_false_alarms: float
    scale: float = 1.0

    @property
    def centre(self) -> Array:
        """Centre of the camera in the scene, -R^T t / scale."""
        return -self.rotation.T @ self.translation / self.scale


@dataclass(frozen=True)
class SolutionStats:
    """How the search went: rounds (batches of starts), what it left as residual, whether it stopped by itself because
    the evidence was safe; how many 2D points could not be undistorted and were left out, and how many were left to
    other problems of the same image (`solve_many`)."""

    iterations: int = 0
    residual: float = math.nan
    converged: bool = False
    dropped2d: int = 0
    taken2d: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """The pose of one problem, camera = R p + t; without a pose NaN, no matches and the verdict "failed".

    rotation: (3, 3). translation: (3,), scene units.
    matches: (k, 2) places of a 2D and of a 3D point in the arrays that were given; no point is in two of them.
    inlier_count: how many matches there are within `inlier_threshold` (paper Eq. 1), inlier_ratio: of min(m, n).
    inlier_threshold, reprojection_error: in `unit`, pixels with a camera, else normalised image units, or radians for
        bearings; the error is the mean over the matches. reprojection_error_deg: the mean angle.
    covariance: (6, 6) of (w, v), by which the true pose is off: R' = exp([w]x) R, t' = t + v, w in radians in the axes
        of the camera, v in scene units, the first order of

            C = max(H^-1, sum_i d_i d_i^T),  H = -d2 log p(image points | pose) / d(w, v)^2 + prior,

        with the ways d_i to the optimum without each image point, the partners unknown (docs/verdict.md). NaN if the
        verdict is "failed", or the points do not fix the pose. (3, 3) of w for points at infinity; (7, 7) where the
        focal length was not known: the last row and column are its error, pixels; or where the scale of a rig's scene
        was not, for that.
    scale: 1, or what was found with `scale=True`: rig = scale R p + t, with t in the unit of the rig.
    candidates: the distinct poses that were found, best first; the first is this one.
    verdict: "confident"; "ambiguous", it fits better than chance, but another pose may as well; "failed", no pose fits
        better than chance, and this one, if there is one, is a guess. reason: why, in words.
    log10_false_alarms: how many poses are expected to fit as well if the image had nothing to do with the scene
        (docs/verdict.md), as a logarithm to base 10; infinite without a pose.
    seconds: for this problem; a share of the time where many were solved together.
    view, point_ids: of a photo in a `SceneMap`: the view whose points gave the pose, and the ids (n,) of `points3d` in
        the map, to which `matches` then refer; `match_places` are their places. None for points without a map.
    points2d: (m, 2) normalised image coordinates, NaN where a given point has none. points3d: (n, 3) as given.
    normals3d: (n, 3) outward unit normals as given, None without.
    camera: that of the pixels that were given, or was found; None for normalised coordinates and bearings.
    """

    rotation: Array = field(default_factory=lambda: np.full((3, 3), math.nan))
    translation: Array = field(default_factory=lambda: np.full(3, math.nan))
    matches: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    inlier_count: int = 0
    inlier_ratio: float = 0.0
    inlier_threshold: float = math.nan
    reprojection_error: float = math.nan
    reprojection_error_deg: float = math.nan
    unit: Unit
    covariance: Array = field(default_factory=lambda: np.full((6, 6), math.nan), repr=False)
    scale: float = 1.0
    candidates: tuple[Candidate, ...] = ()
    verdict: Verdict
    reason: str
    log10_false_alarms: float = math.inf
    stats: SolutionStats
    seconds: float = 0.0
    points2d: Array = field(repr=False)
    points3d: Array = field(repr=False)
    normals3d: Array | None = field(default=None, repr=False)
    camera: Camera | None = field(default=None, repr=False)
    view: str | None = None
    point_ids: npt.NDArray[np.int64] | None = field(default=None, repr=False)

    @property
    def match_places(self) -> npt.NDArray[np.int64]:
        """(k, 2) places of the matches in `points2d` and `points3d`."""
        if self.point_ids is None:
            return self.matches
        order = np.argsort(self.point_ids)
        place = order[np.searchsorted(self.point_ids, self.matches[:, 1], sorter=order)]
        return np.column_stack([self.matches[:, 0], place])

    @property
    def centre(self) -> Array:
        """Centre of the camera in the scene, -R^T t / scale."""
        return -self.rotation.T @ self.translation / self.scale

    @property
    def rotation_std_deg(self) -> float:
        """Standard deviation of the rotation about its least certain axis, degrees."""
        return math.degrees(_largest(self.covariance[:3, :3]))

    @property
    def centre_std(self) -> float:
        """Standard deviation of `centre` along its least certain axis, scene units; NaN for points at infinity."""
        if len(self.covariance) in (ROTATION, ROTATION + 1):
            return math.nan
        scale = self.scale if self._has_scale else None
        return _largest(centre_covariance(self.covariance, self.translation, scale))

    @property
    def focal_length(self) -> float:
        """Of the camera, pixels: given, or found; NaN without a camera."""
        return math.nan if self.camera is None else self.camera.focal

    @property
    def focal_length_std(self) -> float:
        """Standard deviation of a focal length that was found, pixels; 0 for one that was given."""
        has_focal = len(self.covariance) in (ROTATION + 1, 7) and not self._has_scale
        return math.sqrt(self.covariance[-1, -1]) if has_focal else 0.0

    @property
    def scale_std(self) -> float:
        """Standard deviation of a scale that was found; 0 for one that was not asked for."""
        return math.sqrt(self.covariance[-1, -1]) if self._has_scale else 0.0

    @property
    def _has_scale(self) -> bool:
        return len(self.covariance) == 7 and self.camera is None

    @property
    def found(self) -> bool:
        """Whether there is a pose at all; see `verdict` for whether to trust it."""
        return bool(np.isfinite(self.rotation).all() and np.isfinite(self.translation).all())

    def __bool__(self) -> bool:
        """Return `found`."""
        return self.found

    def __repr__(self) -> str:
        from bpnp.report.terminal import fixed

        rows = "\n            ".join("  ".join(f"{value: .6f}" for value in row) for row in self.rotation)
        return (
            f"Solution({self.verdict}: {self.reason}\n  rotation: {rows}\n"
            f"  translation: {'  '.join(fixed(self.translation.tolist()))}\n"
            f"  centre: {'  '.join(fixed(self.centre.tolist()))}\n"
            f"  matches: {self.inlier_count} of {min(len(self.points2d), len(self.points3d))}, "
            f"mean error {self.reprojection_error:.3g} {self.unit}\n"
            f"  candidates: {len(self.candidates)}, seconds: {self.seconds:.2f})"
        )

    def plot(self, *, photo: Path | str | npt.NDArray[np.uint8] | None = None, camera: Any = None) -> "Figure":
        """The image points and the scene points where the pose puts them, as a matplotlib figure.

        camera: as for `bpnp.solve`, by default the one that was given there; the axes are its pixels, and normalised
        coordinates without a camera. photo: a file or (h, w, 3) uint8 under the points, as it was taken; it needs a
        camera. Raises ValueError for a photo without a camera, and if no image point is in front of the camera.
        """
        from bpnp.report.images import read_photo

        picture = read_photo(photo) if isinstance(photo, (Path, str)) else photo
        drawn = self if camera is None else replace(self, camera=camera_from(camera))
        return solution_picture(drawn, photo=picture)

    def _repr_html_(self) -> str:
        """What a notebook shows: `repr`, and below it the picture if a point is in front of the camera."""
        text = f"<pre style='white-space: pre-wrap'>{escape(repr(self))}</pre>"
        if not np.isfinite(self.points2d).all(-1).any():
            return text
        content = io.BytesIO()
        self.plot().savefig(content, format="png", dpi=80)
        picture = base64.b64encode(content.getvalue()).decode()
        return f'{text}<img style="max-width: 100%" alt="the matches" src="data:image/png;base64,{picture}">'

    def to_colmap(
        self, folder: Path | str, *, camera: Any = None, name: str = "image.jpg", size: tuple[int, int] | None = None
    ) -> Path:
        """A COLMAP model with this image, its matches as tracks, and all 3D points: cameras, images, points3D.txt.

        camera: as for `bpnp.solve`, by default the one that was given there, else a pinhole of 1000 pixels. name: of
        the image file. size: its width and height, pixels; by default the camera's, or what holds the points. Raises
        ValueError without a pose.
        """
        from bpnp.datamodules.colmap.reconstruction import write_image

        if not self.found:
            raise ValueError(f"expected a solution with a pose to export, got none: {self.reason}")
        pose = self.rotation, self.translation / self.scale  # a camera does not see the unit
        lens = self.camera if camera is None else camera
        points = self.points2d, self.points3d, self.match_places
        return write_image(Path(folder), *points, pose, camera=lens, name=name, size=size)

    def to_json(self) -> str:
        """All fields as strict JSON: null for NaN, every digit kept. `bpnp view` draws such a file."""
        pose = {name: getattr(self, name) if self.found else None for name in ("rotation", "translation", "centre")}
        derived = "rotation_std_deg", "centre_std", "focal_length", "focal_length_std", "scale_std"
        content = {"format": FORMAT} | vars(self) | pose | {name: getattr(self, name) for name in derived}
        content |= {"candidates": [vars(candidate) for candidate in self.candidates], "stats": vars(self.stats)}
        return json.dumps(_plain(content), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes | Path) -> "Solution":
        """The solution of `to_json`, or of a file with it. Raises ValueError for anything else."""
        name = f" in {text}" if isinstance(text, Path) else ""
        try:
            content = json.loads(text.read_bytes() if isinstance(text, Path) else text)
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']}, try the bpnp that wrote it")
            if content["verdict"] not in get_args(Verdict):
                raise ValueError(f"verdict {content['verdict']!r}")
            return _read(cls, content)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"expected the JSON of a solution{name}, got {error}") from error


def candidates_of(poses: Hypotheses, counts: Sequence[int]) -> tuple[Candidate, ...]:
    """Return hypotheses as a user gets them.

    Args:
        poses: In the coordinates of the user; translations (c, 4) are homogeneous, the unit of the scene last.
        counts: Inliers of each.
    """
    unit = poses.translation[:, 3:] if poses.translation.shape[1] == 4 else np.ones((len(poses), 1))
    return tuple(
        Candidate(rotation, translation, score, count, alarms, scale)
        for rotation, translation, score, count, alarms, scale in zip(
            poses.rotation,
            poses.translation[:, :3] / unit,
            poses.log_likelihood.tolist(),
            counts,
            poses.log10_false_alarms.tolist(),
            (1 / unit[:, 0]).tolist(),
            strict=True,
        )
    )


def with_pose(
    solution: Solution,
    result: SearchResult,
    poses: Hypotheses,
    counts: Sequence[int],
    matches: npt.NDArray[np.int64],
    errors: Array,
    angles: Array,
    *,
    most: int,
    threshold: float,
    residual: float,
    covariance: Array | None,
) -> Solution:
    """Return a solution with the pose, the verdict and the candidates of a search.

    Args:
        solution: Without a pose.
        result: Verdict of the search.
        poses: Hypotheses in the coordinates of the user, the best first; see `candidates_of`.
        counts: Inliers of each.
        matches: (k, 2) of the first pose.
        errors: (k,) of the matches, in the unit of the solution.
        angles: (k,) of the matches, radians.
        most: Largest possible number of matches.
        threshold: Largest error of an inlier, in the unit of the solution.
        residual: Scale of the residuals, radians.
        covariance: Of the first pose; None keeps that of the solution.
    """
    candidates = candidates_of(poses, counts)
    return replace(
        solution,
        rotation=candidates[0].rotation,
        translation=candidates[0].translation,
        scale=candidates[0].scale,
        matches=matches,
        inlier_count=len(matches),
        inlier_ratio=len(matches) / most,
        inlier_threshold=threshold,
        reprojection_error=float(errors.mean()) if len(matches) else math.nan,
        reprojection_error_deg=float(np.degrees(angles).mean()) if len(matches) else math.nan,
        covariance=solution.covariance if covariance is None else covariance,
        candidates=candidates,
        verdict=result.verdict,
        log10_false_alarms=candidates[0].log10_false_alarms,
        stats=replace(
            solution.stats,
            iterations=result.batches,
            residual=residual,
            converged=result.verdict == "confident",
        ),
    )


def solution_points(solution: Solution, *, title: str | None = None) -> "ProblemPoints":
    """Return the points of a solution, ready to draw.

    Its id is the title, the verdict with its figures, none of a failed one, and the reason.

    Raises:
        ValueError: A match has no point.
    """
    from bpnp.report.points import ProblemPoints

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
    verdict = [f"{solution.verdict}: {shown}", solution.reason]
    if solution.verdict == "failed":
        verdict = [f"failed: {solution.reason}"]
    lines = [*([] if title is None else [title]), *(textwrap.fill(line, LINE) for line in verdict)]
    return ProblemPoints(
        0, "\n".join(lines), points2d, points3d, np.full_like(assigned, -1), assigned,
        estimates={"solution": (solution.rotation, solution.translation / solution.scale)}, camera=solution.camera,
        normals3d=solution.normals3d,
    )  # fmt: skip


def competing_points(solution: Solution, points: "ProblemPoints") -> "ProblemPoints | None":
    """Return the points under the next candidate of an ambiguous solution, None if there is none.

    Its matches are the pairs of points that are nearest to each other, within the inlier threshold.
    """
    if solution.verdict != "ambiguous" or len(solution.candidates) < 2:
        return None
    other = solution.candidates[1]
    pose = other.rotation, other.translation / other.scale
    projected, seen = in_front(points.points3d @ pose[0].T + pose[1])[:, :2], points.points2d
    ahead, known = (np.flatnonzero(np.isfinite(side).all(-1)) for side in (projected, seen))
    assigned = np.full(len(projected), -1, np.int32)
    if len(ahead) and len(known):
        reach = solution.inlier_threshold / (1.0 if solution.camera is None else solution.camera.focal)
        distance, nearest = cKDTree(seen[known]).query(projected[ahead], distance_upper_bound=reach)
        back = cKDTree(projected[ahead]).query(seen[known])[1]
        mutual = np.flatnonzero(np.isfinite(distance))
        mutual = mutual[back[nearest[mutual]] == mutual]
        assigned[ahead[mutual]] = known[nearest[mutual]]
    title = f"next candidate: {other.inlier_count} matches"
    return replace(points, id=title, assigned3d=assigned, estimates={"next candidate": pose})


def solution_picture(solution: Solution, *, title: str | None = None, photo: Any = None) -> "Figure":
    """Draw `solution_points`, a close-up of the residuals, and the next candidate of an ambiguous solution.

    Args:
        solution: What to draw.
        title: First line of the caption.
        photo: (h, w, 3) uint8, to draw under the points.
    """
    from bpnp.report.figures import plot_matches
    from bpnp.report.terminal import VERDICTS

    points, colour = solution_points(solution, title=title), VERDICTS[solution.verdict]
    return plot_matches(points, colour=colour, photo=photo, competing=competing_points(solution, points))


def _largest(covariance: Array) -> float:
    """The root of the largest eigenvalue; NaN if there is none."""
    known = np.isfinite(covariance).all()
    return math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])) if known else math.nan


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Camera):
        return camera_to_json(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _read(kind: type, content: dict[str, Any]) -> Any:
    """A dataclass of this file from its JSON. Files of version 0.1.0 lack fields whose default is None, and `LATER`."""
    missing = [field for field in fields(kind) if field.name not in content]
    optional = [field.name for field in missing if field.default is None or field.name in LATER]
    values = {field.name: content[field.name] for field in fields(kind) if field.name not in optional}
    return kind(**{name: READERS[name](value) if name in READERS else value for name, value in values.items()})


def _array(values: Any, *, shape: tuple[int, ...]) -> Array:
    return np.full(shape, math.nan) if values is None else np.array(values, np.float64).reshape(shape)


def _float(value: float | None, *, missing: float = math.nan) -> float:
    return missing if value is None else value


LATER = {"covariance", "scale", "taken2d"}  # than version 0.1.0
READERS: dict[str, Callable[[Any], Any]] = {  # of the fields that JSON holds in another form
    "rotation": partial(_array, shape=(3, 3)),
    "translation": partial(_array, shape=(3,)),
    "covariance": lambda values: np.array([[_float(x) for x in row] for row in values], np.float64),
    "points2d": partial(_array, shape=(-1, 2)),
    "points3d": partial(_array, shape=(-1, 3)),
    "normals3d": lambda values: None if values is None else _array(values, shape=(-1, 3)),
    "matches": lambda values: np.array(values, np.int64).reshape(-1, 2),
    "camera": lambda value: None if value is None else camera_from(value),
    "point_ids": lambda values: None if values is None else np.array(values, np.int64),
    "log10_false_alarms": partial(_float, missing=math.inf),
    **dict.fromkeys(("inlier_threshold", "reprojection_error", "reprojection_error_deg", "residual", "scale"), _float),
    "candidates": lambda values: tuple(_read(Candidate, value) for value in values),
    "stats": lambda value: _read(SolutionStats, value),
}
