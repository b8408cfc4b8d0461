"""Result of `bpnp.solve`, and its JSON file."""

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
ROTATION = 3  # parameters of a rotation: the whole pose of points at infinity
FORMAT = 2  # since 2 with false alarms
LINE = 130  # characters per line of the reason in a figure


@dataclass(frozen=True, eq=False)
class Candidate:
    """A distinct pose that the search found, camera = R p + t.

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation: (3,) translation, scene units.
        score: Mean log-likelihood of the bearings, nats; larger is better.
        inlier_count: Number of one-to-one inliers (paper Eq. 1).
        log10_false_alarms: Expected number of equally good poses for unrelated points, log10; see `Solution`.
        scale: Scale of the scene, rig = scale R p + t; 1 unless it was estimated.
    """

    rotation: Array
    translation: Array
    score: float
    inlier_count: int
    log10_false_alarms: float
    scale: float = 1.0

    @property
    def centre(self) -> Array:
        """Camera centre in the scene, -R^T t / scale."""
        return -self.rotation.T @ self.translation / self.scale


@dataclass(frozen=True)
class SolutionStats:
    """Statistics of the search.

    Attributes:
        iterations: Number of batches of initial poses.
        residual: Scale of the residuals, radians.
        converged: True if the verdict is "confident", so that the search stopped by itself.
        dropped2d: Number of 2D points that could not be undistorted and were dropped.
        taken2d: Number of 2D points that other problems of the same image use (`solve_many`).
    """

    iterations: int = 0
    residual: float = math.nan
    converged: bool = False
    dropped2d: int = 0
    taken2d: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """Pose of one problem, camera = R p + t. Without a pose it is NaN, with no matches and the verdict "failed".

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation: (3,) translation, scene units.
        matches: (k, 2) indices of a 2D and a 3D point in the input arrays; no point is in two matches.
        inlier_count: Number of matches within `inlier_threshold` (paper Eq. 1).
        inlier_ratio: `inlier_count` as a fraction of min(m, n).
        inlier_threshold: Largest reprojection error of a match, in `unit`.
        reprojection_error: Mean reprojection error of the matches, in `unit`.
        reprojection_error_deg: Mean angle between the bearings of the matches, degrees.
        unit: Pixels with a camera, else normalised image units, or radians for bearings.
        covariance: (6, 6) covariance of the pose error (w, v), with R' = exp([w]x) R and t' = t + v. Here w is in
            radians in the camera axes, and v in scene units. It is the first-order estimate

                C = max(H^-1, sum_i d_i d_i^T),  H = -d2 log p(image points | pose) / d(w, v)^2 + prior,

            where d_i is the step to the optimum without image point i, with unknown correspondences (docs/verdict.md).
            NaN if the verdict is "failed" or the points do not fix the pose. (3, 3) of w for points at infinity. An
            estimated focal length (pixels) or scale adds a last row and column.
        scale: Scale of the scene, rig = scale R p + t, with t in the unit of the rig; 1 unless `scale=True`.
        candidates: Distinct poses that the search found, best first; the first is this pose.
        verdict: "confident"; "ambiguous" if the pose is significant but another one may fit as well; "failed" if no
            pose is significant. A pose with the verdict "failed" is a guess.
        reason: Reason of the verdict, a sentence.
        log10_false_alarms: Expected number of poses that fit as well if image and scene were unrelated (NFA), log10;
            infinite without a pose. See docs/verdict.md.
        seconds: Run time of this problem. Problems that were solved together count equal parts of their time.
        view: Name of the view of a `SceneMap` near which the pose was found; None without a map.
        point_ids: (n,) ids of `points3d` in the map, which `matches` then hold instead of indices (see `match_places`);
            None without a map.
        points2d: (m, 2) normalised image coordinates; NaN for an input point that has none.
        points3d: (n, 3) input points.
        normals3d: (n, 3) input normals; None without.
        camera: Input or estimated camera; None for normalised coordinates and bearings.
        stats: Statistics of the search.
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
        """Indices (k, 2) of the matches into `points2d` and `points3d`."""
        if self.point_ids is None:
            return self.matches
        order = np.argsort(self.point_ids)
        place = order[np.searchsorted(self.point_ids, self.matches[:, 1], sorter=order)]
        return np.column_stack([self.matches[:, 0], place])

    @property
    def centre(self) -> Array:
        """Camera centre in the scene, -R^T t / scale."""
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
        """Focal length of the camera, pixels, given or estimated; NaN without a camera."""
        return math.nan if self.camera is None else self.camera.focal

    @property
    def focal_length_std(self) -> float:
        """Standard deviation of an estimated focal length, pixels; 0 for a given one."""
        has_focal = len(self.covariance) in (ROTATION + 1, 7) and not self._has_scale
        return math.sqrt(self.covariance[-1, -1]) if has_focal else 0.0

    @property
    def scale_std(self) -> float:
        """Standard deviation of an estimated scale; 0 if the scale was not estimated."""
        return math.sqrt(self.covariance[-1, -1]) if self._has_scale else 0.0

    @property
    def _has_scale(self) -> bool:
        return len(self.covariance) == 7 and self.camera is None

    @property
    def found(self) -> bool:
        """True if there is a pose; see `verdict` for its reliability."""
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
        """Draw the image points and the projected scene points as a matplotlib figure.

        Args:
            photo: File or (h, w, 3) uint8 image to draw under the points; not undistorted. It needs a camera. None for
                none.
            camera: Camera whose pixels are the axes, as for `bpnp.solve`. Default: `self.camera`; without a camera the
                axes are normalised coordinates.

        Returns:
            The figure.

        Raises:
            ValueError: A photo was given without a camera, or no image point is in front of the camera.
        """
        from bpnp.report.images import read_photo

        picture = read_photo(photo) if isinstance(photo, (Path, str)) else photo
        drawn = self if camera is None else replace(self, camera=camera_from(camera))
        return solution_picture(drawn, photo=picture)

    def _repr_html_(self) -> str:
        """Return `repr` as HTML, followed by the picture if a point is in front of the camera."""
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
        """Write a COLMAP text model with this image, its matches as tracks, and all 3D points.

        Args:
            folder: Folder to write to.
            camera: Camera to write, as for `bpnp.solve`. Default: `self.camera`, else a pinhole camera of 1000 pixels.
            name: Name of the image file, default "image.jpg".
            size: (width, height) of the image, pixels. Default: the size of the camera, else one that holds the points.

        Returns:
            The folder.

        Raises:
            ValueError: The solution has no pose.
        """
        from bpnp.datamodules.colmap.reconstruction import write_image

        if not self.found:
            raise ValueError(f"expected a solution with a pose to export, got none: {self.reason}")
        pose = self.rotation, self.translation / self.scale  # in the unit of the scene
        lens = self.camera if camera is None else camera
        points = self.points2d, self.points3d, self.match_places
        return write_image(Path(folder), *points, pose, camera=lens, name=name, size=size)

    def to_json(self) -> str:
        """Return all fields as strict JSON, with null for NaN and all digits. `bpnp view` draws such a file."""
        pose = {name: getattr(self, name) if self.found else None for name in ("rotation", "translation", "centre")}
        derived = "rotation_std_deg", "centre_std", "focal_length", "focal_length_std", "scale_std"
        content = {"format": FORMAT} | vars(self) | pose | {name: getattr(self, name) for name in derived}
        content |= {"candidates": [vars(candidate) for candidate in self.candidates], "stats": vars(self.stats)}
        return json.dumps(_plain(content), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes | Path) -> "Solution":
        """Read a solution from the text of `to_json`, or from a file with it.

        Args:
            text: JSON text, or the path of a JSON file as a `Path`.

        Raises:
            ValueError: The text is not the JSON of a solution.
        """
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
    """Return hypotheses as `Candidate` objects.

    Args:
        poses: Poses in the user's frame; translations (c, 3), or homogeneous (c, 4) with the unit of the scene last.
        counts: Number of inliers of each pose.
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
        solution: Solution without a pose.
        result: Search result with the verdict.
        poses: Hypotheses in the user's frame, best first; see `candidates_of`.
        counts: Number of inliers of each hypothesis.
        matches: (k, 2) matches of the first pose.
        errors: (k,) reprojection errors of the matches, in the unit of the solution.
        angles: (k,) angular errors of the matches, radians.
        most: Largest possible number of matches.
        threshold: Largest error of an inlier, in the unit of the solution.
        residual: Scale of the residuals, radians.
        covariance: Covariance of the first pose; None keeps that of the solution.
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

    Their id is the caption: title, verdict with its figures, and reason. A failed solution has no figures.

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
    """Return the points under the next candidate of an ambiguous solution; None if there is none.

    The matches are mutual nearest neighbours within the inlier threshold.
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
    """Return the root of the largest eigenvalue; NaN if the covariance is not finite."""
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
    """Build a dataclass from its JSON; fields in `LATER` and fields that default to None may be missing."""
    missing = [field for field in fields(kind) if field.name not in content]
    optional = [field.name for field in missing if field.default is None or field.name in LATER]
    values = {field.name: content[field.name] for field in fields(kind) if field.name not in optional}
    return kind(**{name: READERS[name](value) if name in READERS else value for name, value in values.items()})


def _array(values: Any, *, shape: tuple[int, ...]) -> Array:
    return np.full(shape, math.nan) if values is None else np.array(values, np.float64).reshape(shape)


def _float(value: float | None, *, missing: float = math.nan) -> float:
    return missing if value is None else value


LATER = {"covariance", "scale", "taken2d"}  # fields added after version 0.1.0
READERS: dict[str, Callable[[Any], Any]] = {  # of the fields with another form in JSON
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
